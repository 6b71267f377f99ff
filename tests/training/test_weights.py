"""Tests the initial weights of a run, the warm-up, and the moving average at the end."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from training.runs import NETWORK, TRAINING, metrics, train_mapping

from hgn import train
from hgn.config import NetworkConfig, TrainConfig, TrainingConfig
from hgn.data.reader import EpisodeStore, first_episodes
from hgn.evaluate import EvaluateConfig, one_step_rows
from hgn.export import export
from hgn.export import main as export_main
from hgn.network.build import build_network
from hgn.runtime.torch_backend import Backend
from hgn.runtime.weights import WeightsInfo, find_weights, load_weights, save_weights
from hgn.schema import ConfigError
from hgn.step_config import StepConfig
from hgn.training.checkpoint import network_of_checkpoint, network_of_weights, read_checkpoint
from hgn.training.muon import Muon
from hgn.training.schedule import learning_rate
from hgn.training.torch_updates import TorchUpdates
from hgn.training.updates import build_optimizer


@pytest.fixture
def data(make_config, make_dataset):
    config = make_config(training_scenes=2, validation_scenes=1, test_scenes=0)
    make_dataset(config)
    return config


def weights_file(path, stored_precision="fp16", rate=60.0, cell_size=1 / 64, **network):
    torch.manual_seed(3)
    config = NetworkConfig(**NETWORK | network)
    built = build_network(config)
    for quantity in ("velocity", "acceleration"):
        built.normaliser.set(quantity, torch.tensor([0.1, 0.2, 0.3]), torch.tensor([1.5, 2.5, 3.5]), 0.0)
    save_weights(path, built, WeightsInfo(config, rate, cell_size), stored_precision)
    return path


def evaluate(data, weights):
    mapping = {
        "weights": str(weights),
        "data": data.dataset.folder,
        "rollout_frames": 0,
        "device": "cpu",
        "frame_stride": 4,
    }
    config = EvaluateConfig(**mapping)
    episodes = first_episodes(EpisodeStore(config.data, config.split), 5)
    rows = one_step_rows(Backend(load_weights(weights)[0]), episodes, config)
    return next(row["one_step_mse"] for row in rows if row["system"] == "network")


def last(run):
    return read_checkpoint(run / "checkpoints" / "last.ckpt")


def test_a_run_begins_with_weights(data, tmp_path, capsys):
    """A new run starts with the file's parameters and normaliser. A resumed run uses its checkpoint, even if the file
    is missing, and prints this."""
    file = weights_file(tmp_path / "begin.safetensors")
    tiny = {"learning_rate": 1e-12, "final_learning_rate": 1e-12, "maximum_updates": 1}
    mapping = train_mapping(data, tmp_path / "run", init_weights=str(file), **tiny)
    assert train.main(mapping) == 0
    assert "starting with the weights" in capsys.readouterr().err
    begun, _ = load_weights(file)
    for name, tensor in network_of_checkpoint(last(tmp_path / "run"), tmp_path).state_dict().items():
        torch.testing.assert_close(tensor, begun.state_dict()[name], rtol=0, atol=1e-10)
    file.unlink()
    again = train_mapping(data, tmp_path / "run", init_weights=str(file), **tiny | {"maximum_updates": 2})
    assert train.main(again) == 0
    assert "is not read: the run continues from" in capsys.readouterr().err
    assert last(tmp_path / "run")["hgn"]["updates"] == 2


def test_materials_of_the_first_weights_are_kept(make_config, make_dataset, tmp_path):
    """A run has the materials of the data of its first weights and of its own data, also after it was resumed."""
    config, path = make_config(training_scenes=2, validation_scenes=0, test_scenes=0), tmp_path / "first.safetensors"
    config = replace(config, scene=replace(config.scene, materials=("sand",)))
    make_dataset(config)
    network, info = load_weights(weights_file(path))
    for given, expected in ((("snow",), ["snow", "sand"]), ((), [*network.config.materials])):
        save_weights(path, network, replace(info, materials=given))
        for updates in (1, 2):
            mapping = train_mapping(config, tmp_path / f"run{len(given)}", init_weights=str(path))
            mapping["training"]["maximum_updates"] = updates
            assert train.main(mapping) == 0
            assert last(tmp_path / f"run{len(given)}")["hgn"]["data"]["materials"] == expected


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ({"width": 16}, r"network.width must be 16, as in training.init_weights .*, got 8; use that value, or"),
        ({"materials": ("water",)}, r"network.materials must be \['water'\], as in training.init_weights"),
        ({"rate": 30.0}, r"dataset.frame_rate_hz must be 30.0, as in training.init_weights .*, got 60.0; use"),
        ({"cell_size": 0.02}, r"scene.cell_size must be 0.02, as in training.init_weights .*, got 0.015625; use"),
        (None, r"training.init_weights must be an existing file, got .*; write one with python -m hgn.export"),
    ],
)
def test_other_weights_are_refused(data, tmp_path, file, message):
    """Another structure, other materials, frame rates and cells are refused by name before anything is written."""
    path = tmp_path / "other.safetensors"
    if file is not None:
        weights_file(path, **file)
    with pytest.raises(ConfigError, match=message):
        train.main(train_mapping(data, tmp_path / "run", init_weights=str(path)))
    assert {path.name for path in (tmp_path / "run").rglob("*")} <= {".lock"}


def test_other_constraints_are_taken(tmp_path):
    """Weights of relative inputs without rest, walls and obstacles' clearance begin a network of local inputs with
    these: the same tensors."""
    path = weights_file(tmp_path / "own.safetensors", "fp32", inputs="relative")
    wanted, step = NetworkConfig(**NETWORK | {"inputs": "local"}), StepConfig(0.1, (0.02, 0.04), 1e-3)
    config = TrainConfig(network=wanted, step=step, training=TrainingConfig(init_weights=str(path)))
    (network, _), (own, info) = network_of_weights(config), load_weights(path)
    assert (network.config, network.step, info.step) == (wanted, step, StepConfig())
    theirs = own.state_dict()
    assert all(torch.equal(tensor, theirs[name]) for name, tensor in network.state_dict().items())
    with pytest.raises(ConfigError, match=r"network.cell_size must be .*, as in"):
        network_of_weights(replace(config, network=replace(wanted, cell_size=0.05)))


@pytest.mark.parametrize("updates", [1, 4, 60, 100, 1499, 1500, 75_000])
def test_warm_up(updates):
    """The rate grows linearly over the first updates, at most a fifth of all, and then equals the rate without warm-up.
    A warm-up of 300 updates does not keep the rate of 100 updates below a tenth of it."""
    values = {"learning_rate": 1e-3, "final_learning_rate": 1e-5, "maximum_updates": updates}
    warm, cold = (TrainingConfig(**values, warmup_updates=n) for n in (300, 0))
    factors = [learning_rate(warm, update) / learning_rate(cold, update) for update in range(min(updates, 400))]
    length = min(300, updates // 5)
    assert factors[length:] == [1.0] * len(factors[length:])
    assert factors[:length] == pytest.approx([(update + 1) / length for update in range(length)])
    assert learning_rate(cold, 0) == 1e-3 and learning_rate(warm, updates) == pytest.approx(1e-5)


@pytest.mark.parametrize(("name", "kind"), [("adam", torch.optim.Adam), ("muon", Muon)])
def test_the_optimiser_is_the_configured_one(name, kind):
    """Both optimisers are fused, because only fused ones can skip a step themselves."""
    optimizer = build_optimizer(build_network(NetworkConfig(**NETWORK)), TrainingConfig(optimizer=name))
    assert type(optimizer) is kind and optimizer.param_groups[0]["fused"]


def test_an_export_sets_rest_walls_and_obstacles(finished, tmp_path):
    """Exports change constraints of checkpoints, weights files (also in place) and shipped weights. Tensors, updates
    and other metadata stay. The provenance names the changes and the file, and contains the file's own provenance.
    Networks with absolute inputs refuse rest_threshold. Changes without an output file are refused."""
    checkpoint, out = str(finished[1] / "checkpoints" / "last.ckpt"), str(tmp_path / "out.safetensors")
    file = weights_file(tmp_path / "trained.safetensors", inputs="relative")
    network, info = load_weights(file)
    save_weights(file, network, replace(info, updates=7, provenance={"commit": "abc"}), "fp16")
    kept = str(tmp_path / "kept.safetensors")
    assert export_main({"checkpoint": checkpoint, "out": kept}) == 0
    for origin, before, options in (
        ({"checkpoint": checkpoint}, kept, {"wall_clearance": (0.02, 0.04)}),
        ({"weights": str(file)}, file, {"rest_threshold": 0.1}),
        ({"weights": str(file)}, file, {"obstacle_clearance": 1e-3}),
        ({"weights": "obstacles_small"}, "obstacles_small", {"obstacle_clearance": 5e-4}),
    ):
        (first, was), place = load_weights(find_weights(str(before))), out
        if origin == {"weights": str(file)}:
            place = str(file) if "obstacle_clearance" in options else out
            origin = origin | {"stored_precision": "fp16"}
        assert export_main(origin | options | {"out": place}) == 0
        changed, after = load_weights(Path(place))
        assert after.step == StepConfig(**options) == changed.step and after.network == was.network
        assert (after.updates, after.frame_rate_hz, after.gravity) == (was.updates, was.frame_rate_hz, was.gravity)
        if origin.get("weights") == str(file):
            told = {"file": file.name, "step": options, "provenance": {"commit": "abc"}}
            assert after.provenance["changed"] == told and after.updates == 7
        assert all(torch.equal(tensor, changed.state_dict()[name]) for name, tensor in first.state_dict().items())
    bytes_before, step = file.read_bytes(), str(tmp_path / "step.onnx")
    absolute = r"rest_threshold must be 0 with inputs=absolute, got 0\.1"
    given = (("rest_threshold", 0.1), ("wall_clearance", [0.02, 0.04]), ("obstacle_clearance", 1e-3))
    for options, message in (
        ({"checkpoint": checkpoint, "out": out, "rest_threshold": 0.1}, absolute),
        ({"weights": kept, "out": kept, "rest_threshold": 0.1}, absolute),
        ({"checkpoint": checkpoint, "out": out, "wall_clearance": [0.1, -0.1]}, r"wall_clearance\[1\] must be from 0"),
        *(({"weights": str(file), "onnx": step, name: value}, f"{name} must be null without out, the file that it")
          for name, value in given),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=message):
            export_main(options)
    assert file.read_bytes() == bytes_before


def test_the_average_is_what_is_measured_and_exported(data, tmp_path, monkeypatch):
    """The average follows its definition over all updates. It is exported and monitored."""
    seen: list[dict[str, torch.Tensor]] = []
    original = TorchUpdates.step

    def step(updates, update):
        network = updates.trained.network
        if not seen:
            seen.append({name: p.detach().clone() for name, p in network.named_parameters()})
        original(updates, update)
        seen.append({name: p.detach().clone() for name, p in network.named_parameters()})

    monkeypatch.setattr(TorchUpdates, "step", step)
    mapping = train_mapping(data, tmp_path / "run", ema_decay=0.6, learning_rate=1e-2)
    assert train.main(mapping) == 0
    assert len(seen) == TRAINING["maximum_updates"] + 1
    expected = {name: tensor.double() for name, tensor in seen[0].items()}
    for update, weights in enumerate(seen[1:]):
        decay = min(0.6, (1 + update) / (10 + update))
        expected = {name: decay * mean + (1 - decay) * weights[name].double() for name, mean in expected.items()}
    export(tmp_path / "run" / "checkpoints" / "last.ckpt", tmp_path / "out.safetensors")
    exported, _ = load_weights(tmp_path / "out.safetensors")
    for name, parameter in exported.named_parameters():
        torch.testing.assert_close(parameter.double(), expected[name], rtol=1e-5, atol=1e-7)
    assert any(not torch.equal(exported.get_parameter(name), tensor) for name, tensor in seen[-1].items())
    records = [record for record in metrics(tmp_path / "run") if "one_step/validation" in record]
    measured = {record["update"]: record["one_step/validation"] for record in records}
    assert measured[12] == pytest.approx(evaluate(data, tmp_path / "out.safetensors"), rel=1e-4)
    checkpoint = last(tmp_path / "run")
    checkpoint["state_dict"] = {k: v for k, v in checkpoint["state_dict"].items() if not k.startswith("averaged.")}
    torch.save(checkpoint, tmp_path / "run" / "checkpoints" / "last.ckpt")
    # begun anew at the checkpoint's weights, where it had none; and left out where it is no longer wanted
    for decay, updates in ((0.6, 13), (0.0, 14), (0.6, 15)):
        mapping = train_mapping(data, tmp_path / "run", ema_decay=decay, learning_rate=1e-2, maximum_updates=updates)
        assert train.main(mapping) == 0
        assert any(name.startswith("averaged.") for name in last(tmp_path / "run")["state_dict"]) == (decay > 0)
