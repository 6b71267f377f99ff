"""The mean of several networks' weights."""

from dataclasses import replace

import pytest
import torch
from training.test_weights import weights_file

from hgn.average import AverageConfig, average, main
from hgn.runtime.weights import load_weights, save_weights
from hgn.schema import ConfigError


def moved(path, by, updates=7, normaliser=0.0, stored_precision="fp32"):
    """The weights of `weights_file`, each moved by a random number of this size."""
    network, info = load_weights(weights_file(path, "fp32"))
    generator = torch.Generator().manual_seed(updates)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += by * torch.randn(parameter.shape, generator=generator)
        network.normaliser.velocity_std += normaliser
    save_weights(path, network, replace(info, updates=updates, provenance={"part": path.name}), stored_precision)
    return path


@pytest.mark.parametrize(("coefficients", "expected"), [(None, (0.5, 0.5)), ((0.7, 0.3), (0.7, 0.3))])
def test_the_mean(tmp_path, coefficients, expected):
    """Each tensor is the mean of the files' by their coefficients, in float16 where asked; the normaliser stays bit by
    bit, and the file says what it was made of."""
    files = [
        moved(tmp_path / "a.safetensors", 0.1, 5, stored_precision="fp16"),
        moved(tmp_path / "b.safetensors", 0.1, 9),
    ]
    for stored in ("fp32", "fp16"):
        out = tmp_path / "mean.safetensors"
        options = {"coefficients": coefficients, "out": str(out), "stored_precision": stored}
        assert main({"weights": [str(f) for f in files], **options}) == 0
        (first, _), (second, _), (mean, info) = (load_weights(file) for file in (*files, out))
        for name, tensor in mean.state_dict().items():
            a, b = first.state_dict()[name], second.state_dict()[name]
            wanted = a if name.startswith("normaliser.") else expected[0] * a + expected[1] * b
            if stored == "fp16" and not name.startswith("normaliser."):
                wanted = wanted.half().float()
            torch.testing.assert_close(tensor, wanted, rtol=0, atol=1e-3 if stored == "fp16" else 1e-7)
            assert not name.startswith("normaliser.") or torch.equal(tensor, a)
        assert info.updates == 9
        parts = info.provenance["average_of"]
        assert [(p["file"], p["coefficient"], p["updates"]) for p in parts] == [
            ("a.safetensors", expected[0], 5),
            ("b.safetensors", expected[1], 9),
        ]
        assert parts[1]["provenance"] == {"part": "b.safetensors"} and "commit" in info.provenance


@pytest.mark.parametrize(
    ("write", "changes", "rule"),
    [
        (weights_file, {"cell_size": 1 / 32}, r"obstacle_cell_size of weights\[0\]"),
        (weights_file, {"width": 32}, r"network of weights\[0\]"),
        (weights_file, {"rate": 30.0}, r"frame_rate_hz of weights\[0\]"),
        (moved, {"by": 0.1, "normaliser": 0.5}, r"normaliser of weights\[0\] .*init_weights"),
    ],
)
def test_others_are_refused(tmp_path, write, changes, rule):
    """Weights of another network or of other data have no mean with these, nor have those of trainings from nothing on
    data of their own, whose latents have other units; nothing is written."""
    files = [weights_file(tmp_path / "a.safetensors", "fp32"), write(tmp_path / "b.safetensors", **changes)]
    out = tmp_path / "mean.safetensors"
    with pytest.raises(ConfigError, match=rf"weights\[1\] must have the {rule}"):
        average(AverageConfig(tuple(map(str, files)), str(out)))
    assert not out.exists()


def test_a_name_is_needed():
    """An empty name is no file to write."""
    with pytest.raises(ConfigError, match="out must be a file name, got ''"):
        AverageConfig(("a.safetensors",) * 2, "")


@pytest.mark.parametrize(
    ("by", "coefficients", "stored"), [(0.1, (1e39, -1e39, 1.0), "fp32"), (1e6, (0.5, 0.5, 0.0), "fp16")]
)
def test_sums_out_of_range_are_refused(tmp_path, by, coefficients, stored):
    """Terms or a mean beyond the largest number of the file's precision are named; nothing is written."""
    files = tuple(str(moved(tmp_path / f"{name}.safetensors", by)) for name in "abc")
    out = tmp_path / "mean.safetensors"
    with pytest.raises(ConfigError, match=rf"weights tensor .* must be finite in {stored}, got (inf|-inf|nan)"):
        average(AverageConfig(files, str(out), coefficients, stored))
    assert not out.exists()
