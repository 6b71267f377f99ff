"""Tests inference weights: loading inverts saving, and files of other programs are refused."""

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from network.states import network_of, random_state
from safetensors import safe_open
from safetensors.torch import save_file

from hgn.config import NetworkConfig
from hgn.export import export
from hgn.runtime.weights import WeightsInfo, load_weights, save_weights
from hgn.schema import ConfigError
from hgn.step_config import StepConfig
from hgn.training.checkpoint import network_of_checkpoint, read_checkpoint

STATE = random_state((70, 30), dtype=torch.float32)


@pytest.fixture
def weights(tmp_path):
    """The weights file of a small network."""
    network = network_of(torch.float32)
    path = tmp_path / "weights.safetensors"
    save_weights(path, network, WeightsInfo(network.config, 60.0, 1 / 64, updates=7))
    return path


def content(path):
    """The tensors and the declared structure of a weights file."""
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        return tensors, json.loads(file.metadata()["hgn"])


def rewrite(path, change, structure=None):
    """Changes a weights file; `structure` replaces the declared one."""
    tensors, mapping = content(path)
    change(tensors, mapping)
    save_file(tensors, path, metadata={"hgn": json.dumps(mapping) if structure is None else structure})


def test_exported_checkpoint_is_the_trained_network(finished_once, tmp_path):
    """A checkpoint of the trainer, exported and loaded, predicts the same as the checkpoint's network (to 1e-6), and
    contains the properties of its data."""
    checkpoint, path = finished_once[1] / "checkpoints" / "last.ckpt", tmp_path / "shipped" / "weights.safetensors"
    export(checkpoint, path)
    loaded, info = load_weights(path)
    expected = network_of_checkpoint(read_checkpoint(checkpoint), checkpoint)
    assert expected.normaliser.velocity_std.min() > 0.001  # the data's, no longer the identity
    with torch.no_grad():
        torch.testing.assert_close(loaded(STATE), expected(STATE), rtol=1e-6, atol=1e-6)
    assert (info.updates, info.frame_rate_hz, info.obstacle_cell_size) == (12, 60.0, 1 / 64)
    assert info.network == expected.config and info.provenance["checkpoint"] == "last.ckpt"
    assert [file.name for file in path.parent.iterdir()] == ["weights.safetensors"]


def test_roundtrip_keeps_every_bit(weights, tmp_path):
    """Saved and loaded, every tensor is bitwise the same, normaliser included; the network is ready to predict. A file
    depends on nothing but the network and its other metadata; structure and constraints are the network's."""
    expected = network_of(torch.float32)
    loaded, info = load_weights(weights)
    assert not loaded.training and info == WeightsInfo(expected.config, 60.0, 1 / 64, updates=7)
    found = loaded.state_dict()
    assert found.keys() == expected.state_dict().keys()
    assert all(torch.equal(found[name], tensor) for name, tensor in expected.state_dict().items())
    for given in (info, replace(info, step=StepConfig(obstacle_clearance=1e-3), network=NetworkConfig())):
        save_weights(tmp_path / "again.safetensors", loaded, given)
        assert (tmp_path / "again.safetensors").read_bytes() == weights.read_bytes()


def test_half_precision(weights, tmp_path):
    """fp16 rounds each learned tensor to float16 and halves the file; the normaliser keeps its float32 values, and
    the network computes in float32 again."""
    network, info = load_weights(weights)
    path = tmp_path / "fp16.safetensors"
    save_weights(path, network, info, stored_precision="fp16")
    tensors, _ = content(path)
    for name, tensor in network.state_dict().items():
        kept = name.startswith("normaliser.")
        assert tensors[name].dtype == (torch.float32 if kept else torch.float16)
        assert torch.equal(tensors[name], tensor if kept else tensor.half()), name
    assert path.stat().st_size < 0.6 * weights.stat().st_size
    loaded, _ = load_weights(path)
    assert all(tensor.dtype == torch.float32 for tensor in loaded.state_dict().values())
    with torch.no_grad():
        difference, size = loaded(STATE) - network(STATE), network(STATE)
    assert 0 < float(difference.abs().max()) < 0.02 * float(size.abs().max())


def structure(text):
    return lambda file: rewrite(file, lambda tensors, mapping: None, text)


def network(**changes):
    return lambda file: rewrite(file, lambda tensors, mapping: mapping["network"].update(changes))


def stored(name, value, kind=torch.float32):
    """The first number of a tensor is another one."""

    def change(tensors, _):
        tensors[name] = tensors[name].to(kind)
        tensors[name].view(-1)[0] = value

    return lambda file: rewrite(file, change)


def info(**changes):
    return lambda file: rewrite(file, lambda tensors, mapping: mapping.update(changes))


def inserted(before, text):
    """A text in the header, whose length is adjusted."""

    def change(file):
        data = file.read_bytes()
        head, rest = data[8 : 8 + int.from_bytes(data[:8], "little")], data[8 + int.from_bytes(data[:8], "little") :]
        assert head.count(before) == 1
        head = head.replace(before, text + before)
        file.write_bytes(len(head).to_bytes(8, "little") + head + rest)

    return change


def cut(kept):
    return lambda file: file.write_bytes(file.read_bytes()[: int(kept * file.stat().st_size)])


@pytest.mark.parametrize("size", [0, 100, -4, -4000])
def test_a_file_that_is_cut_while_it_is_read(weights, monkeypatch, size):
    """It is refused in one line. It is read, not mapped: a map's pages would end the process with SIGBUS."""
    monkeypatch.setattr("hgn.runtime.weights.safe_open", lambda *_, **__: pytest.fail("mapped"), raising=False)
    whole = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: whole(path)[: size % path.stat().st_size])
    with pytest.raises(ConfigError, match="weights must be a safetensors file, got "):
        load_weights(weights)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (Path.unlink, r"weights must be an existing file, got .*weights\.safetensors; write one with"),
        *((lambda file, data=data: file.write_bytes(data), "weights must be a safetensors file, got")
          for data in (b"", b"no weights at all", b"PK\x03\x04" + bytes(64))),
        *((cut(kept), "weights must be a safetensors file, got") for kept in (0.01, 0.5, 0.999)),
        (lambda file: save_file(content(file)[0], file), r"file of python -m hgn\.export, got .* without its struct"),
        (lambda file: rewrite(file, lambda tensors, _: tensors.update(a=torch.zeros(1, dtype=torch.complex64))),
         "weights tensor a must be of float16, bfloat16, float32 or float64, got 'torch.complex64'"),
        *((stored(name, 1.0, kind), rf"tensor {name} must be of float16, .* or float64, got '{kind}'; export again")
          for name in ("normaliser.velocity_std", "normaliser.acceleration_mean", "embedding.weight")
          for kind in (torch.float8_e4m3fn, torch.float8_e5m2, torch.int64, torch.bool)),
        (structure("{not json"), "weights must declare their structure as JSON"),
        (structure("[1, 2]"), "weights format_version must be 1, got None"),
        (structure('{"format_version": 1}'), r"weights\.network is missing"),
        (lambda file: rewrite(file, lambda _, mapping: mapping.update(format_version=2, invented_later=True)),
         r"weights format_version must be 1, got 2 in .*; export again"),
        (network(width=0), r"weights\.network\.width must be a finite number > 0, got 0"),
        (network(width="wide"), r"weights\.network\.width must be a whole number, got 'wide'"),
        (network(wdith=16), r"weights\.network\.wdith is not a known key; did you mean width"),
        (network(materials=["water", "La va", "snow"]), r"weights\.network\.materials\[1\] must be a name .*'La va'"),
        (network(width=8), r"weights tensor .* must have shape .* got .*; these are the weights of another network"),
        (network(levels=4), r"weights tensor .* must have shape .* got none in"),
        (network(levels=2), r"weights tensor .* must have shape none for the declared network, got"),
        (lambda file: rewrite(file, lambda tensors, _: tensors.update({"surplus.weight": torch.zeros(3)})),
         "weights tensor surplus.weight must have shape"),
        (lambda file: rewrite(file, lambda tensors, _: tensors.pop("embedding.weight")),
         "weights tensor embedding.weight must have shape"),
        *((stored("embedding.weight", value, kind),
           rf"tensor embedding.weight must be finite in fp32, got {got}; .*weights.safetensors is .*; use another")
          for value, kind, got in ((math.nan, torch.float32, "nan"), (math.inf, torch.float16, "inf"),
                                   (-math.inf, torch.bfloat16, "-inf"), (1e300, torch.float64, "inf"))),
        (stored("normaliser.velocity_std", math.nan), "tensor normaliser.velocity_std must be finite in fp32, got nan"),
        *((stored(f"normaliser.{name}_std", value, kind), rf"normaliser.{name}_std must be at least 1e-30, got {got}")
          for name, value, kind, got in (
              ("velocity", 0.0, torch.float32, "0.0"), ("acceleration", -0.5, torch.float16, "-0.5"),
              ("velocity", 1e-300, torch.float64, "0.0"), ("acceleration", 1e-46, torch.float64, "0.0"),
              ("acceleration", 2e-31, torch.bfloat16, ".*e-31"), ("velocity", 1e-31, torch.float32, "9.9.*e-32"))),
        *((info(**{name: value}), rf"weights\.{name}{at} must be {rule}, got {got}")
          for name, value, at, rule, got in (
              ("updates", -1, "", "a finite number >= 0", "-1"),
              ("gravity", [0, 1e300, 0], r"\[1\]", "at most 1e15 in size", "1e.300"),
              ("gravity", [0, 0, math.nan], r"\[2\]", "finite", "nan"),
              ("frame_rate_hz", 0, "", "from 1e-9 to 1e9", "0"),
              ("obstacle_cell_size", math.nan, "", "from 1e-9 to 1e9", "nan"),
              ("maximum_initial_speed", -1, "", "a finite number >= 0", "-1"),
              *(("own_ranges", {"moving": [0, 1], "friction": ends}, r"\.friction", ".* the smaller one first", r"\(")
                for ends in ([2, 1], [math.nan, 1], [0, math.nan], [0, 1e300], [-math.inf, 1])))),
        (inserted(b'"hgn":', b'"hgn":"{}",'), "must be a safetensors file, got .*: the key hgn is given twice"),
        (inserted(b'"embedding.weight":', b'"embedding.weight":{"dtype":"F32","shape":[0],"data_offsets":[0,0]},'),
         "must be a safetensors file, got .*: the key embedding.weight is given twice"),
        (structure('{"format_version": 1, "format_version": 1}'),
         "must declare their structure as JSON, got .*: the key format_version is given twice"),
    ],
)  # fmt: skip
def test_what_is_no_such_file_is_refused(weights, change, message):
    """None, another format, a cut one, one without a structure, of another version or network: by what is wrong, the
    key or the tensor; and the file stays as it was."""
    change(weights)
    before = weights.read_bytes() if weights.exists() else None
    with pytest.raises(ConfigError, match=message):
        load_weights(weights)
    assert before == (weights.read_bytes() if weights.exists() else None)


@pytest.mark.parametrize("size", [2**31 + 1, 10**11])
def test_a_file_larger_than_any_network(weights, monkeypatch, size):
    """It is refused before it is read: a sparse file of any size takes no space on a disk. None is written."""
    network, info = load_weights(weights)
    os.truncate(weights, size)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_bytes", lambda path: pytest.fail("read"))
        with pytest.raises(ConfigError, match=f"weights must be a file of at most 2147483648 bytes, got {size}; exp"):
            load_weights(weights)
    monkeypatch.setattr("hgn.runtime.weights.MOST_BYTES", 1000)
    with pytest.raises(ConfigError, match=r"weights must be a file of at most 1000 bytes, got \d+; use a smaller netw"):
        save_weights(weights.with_name("new.safetensors"), network, info)
    assert not weights.with_name("new.safetensors").exists()


def test_numbers_that_are_not_finite_are_not_written(weights):
    """A number beyond the largest of the file's precision is named; the earlier file stays."""
    (network, info), before = load_weights(weights), weights.read_bytes()
    with torch.no_grad():
        network.embedding.weight.fill_(-1e6)
    with pytest.raises(ConfigError, match=r"weights tensor embedding\.weight must be finite in fp16, got -inf"):
        save_weights(weights, network, info, stored_precision="fp16")
    assert weights.read_bytes() == before


def test_failed_save_leaves_the_old_file(weights, monkeypatch):
    """If the disk is full during a write, the earlier file stays whole, and no other file remains."""
    network, info = load_weights(weights)
    before = weights.read_bytes()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hgn.system.files.os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        save_weights(weights, network, info, stored_precision="fp16")
    assert weights.read_bytes() == before
    assert [file.name for file in weights.parent.iterdir()] == [weights.name]
