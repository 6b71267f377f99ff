"""The training command: from shards to checkpoints, resume, stop, and every refusal."""

import math
import os
import signal
import zipfile
from contextlib import suppress
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from training.runs import metrics, train_mapping

from hgn import train
from hgn.config import TrainConfig
from hgn.data.manifest import Manifest
from hgn.export import export
from hgn.runtime.rollouts import RolloutResult
from hgn.schema import ConfigError, from_mapping
from hgn.system import signals
from hgn.system.locks import locked
from hgn.training import callbacks, gradients, monitor, session
from hgn.training.callbacks import LogLines
from hgn.training.checkpoint import LAST_NAMES, read_checkpoint
from hgn.training.stop import StopRequest
from hgn.training.torch_updates import TorchUpdates


@pytest.fixture
def run(tmp_path):
    return tmp_path / "run"


def weights(path):
    return read_checkpoint(path)["state_dict"]


def test_a_run_leaves_what_it_promises(finished_once):
    """Checkpoints, metrics with one-step and rollout errors of both splits, pictures, the resolved config; and in
    TensorBoard loss, errors by material, rate, gradient norm, speed, waiting, shards, pictures, hyper-parameters."""
    _, run, output = finished_once
    assert "best.ckpt" not in output
    checkpoint = read_checkpoint(run / "checkpoints" / "last.ckpt")
    assert checkpoint["hgn"]["updates"] == 12 and (run / "checkpoints" / "best.ckpt").is_file()
    records = metrics(run)
    keys = set().union(*records)
    materials = [key.removeprefix("one_step/validation_") for key in keys if key.startswith("one_step/validation_")]
    assert materials and set(materials) <= {"water", "sand", "snow"}
    for split in ("training", "validation"):
        assert {f"one_step/{split}", f"baseline/{split}_ballistic_motion", f"baseline_ratio/{split}"} <= keys
    scalars = {"loss", "learning_rate", "gradient_norm", "skipped_updates", "scenes_per_second", "data_wait_fraction"}
    scalars |= {"shards", "episodes", "updates_per_second", "rollout/finished", "rollout/mse"}
    scalars |= {f"rollout/mse_{name}" for name in materials}
    assert scalars <= keys
    lines = [record for record in records if "loss" in record]
    assert [line["learning_rate"] for line in lines] == pytest.approx([1e-3 * 0.1 ** (n / 12) for n in (4, 8, 12)])
    assert all(0 < line["gradient_norm"] < 1e3 and 0 <= line["data_wait_fraction"] <= 1 for line in lines)
    assert all(line["shards"] == 4 and line["skipped_updates"] == 0 for line in lines)
    stored = yaml.safe_load((run / "config.yaml").read_text())
    assert stored["training"]["maximum_updates"] == 12 and stored["provenance"]["data_schema_version"] == 1

    shown = EventAccumulator(str(run / "tensorboard"), size_guidance={"images": 0})
    shown.Reload()
    assert scalars | {f"one_step/validation_{name}" for name in materials} <= set(shown.Tags()["scalars"])
    assert "final/one_step/validation" in shown.Tags()["scalars"]
    assert set(shown.Tags()["images"]) == {"rollout/picture", "rollout/animation", "rollout/error_over_time"}
    (_, animation) = shown.Images("rollout/animation")
    assert animation.step == 12 and animation.encoded_image_string.startswith(b"GIF89a")
    kinds = (("error", "png"), ("rollout", "gif"), ("rollout", "png"))
    expected = {f"{kind}_{step:09d}.{ending}" for kind, ending in kinds for step in (6, 12)}
    assert {path.name for path in (run / "pictures").iterdir()} == expected
    content = shown.PluginTagToContent("hparams")
    session = HParamsPluginData.FromString(content["_hparams_/session_start_info"]).session_start_info
    assert session.hparams["training/learning_rate"].number_value == 1e-3
    assert session.hparams["network/width"].number_value == 8


def test_relative_inputs_train_as_all_others(data, run):
    """With all symmetries, noise, pushforward and a moving average: the normaliser has no means and one scale, the
    data's with the noise."""
    options = {"symmetry": "gravity", "pushforward_fraction": 0.5, "pushforward_frames": 2}
    mapping = train_mapping(data, run, **options, pushforward_every=4, pushforward_scenes=2, ema_decay=0.9)
    assert train.main(mapping | {"network": mapping["network"] | {"inputs": "relative"}}) == 0
    state = weights(run / "checkpoints" / "last.ckpt")
    std_3 = torch.tensor(Manifest.load(data.dataset.folder).statistics("train").acceleration.std)
    expected = float((std_3.square().mean() + 0.000848528**2).sqrt())
    for name in ("network", "averaged"):
        assert state[f"{name}.normaliser.acceleration_std"].tolist() == pytest.approx([expected] * 3)
        assert state[f"{name}.normaliser.velocity_std"].tolist() == pytest.approx([expected] * 3)
        assert not state[f"{name}.normaliser.acceleration_mean"].any()
    values = {name: value for record in metrics(run) for name, value in record.items()}
    assert math.isfinite(values["one_step/validation"]) and values["pushforward/windows"] > 0


def gradients_with_faults(monkeypatch, faulty):
    """Puts one NaN into the gradient of some updates, before the callbacks see it."""
    original = TorchUpdates.step

    def step(updates, number):
        if number in faulty:
            next(iter(updates.trained.network.parameters())).grad.view(-1)[0] = float("nan")
        original(updates, number)

    monkeypatch.setattr(TorchUpdates, "step", step)


def test_a_scene_that_diverges_leaves_the_others_measured(data, run, monkeypatch):
    """Its frames count as far as it came, it is told how many came to the end, and pictures are made."""
    real = monitor.simulate_scenes

    def cut_short(*arguments):
        first, *others = real(*arguments)
        return [RolloutResult(first.position_TN3[:2], "diverged"), *others]

    monkeypatch.setattr(monitor, "simulate_scenes", cut_short)
    assert train.main(train_mapping(data, run, monitor_rollout_frames=4, maximum_updates=1)) == 0
    (last,) = [record for record in metrics(run) if "rollout/finished" in record]
    assert (last["rollout/finished"], last["rollout/frames"]) == (0.5, 2.0)
    assert all(math.isfinite(value) for name, value in last.items() if name.startswith("rollout/mse"))
    assert (run / "pictures" / "rollout_000000001.png").is_file()


def test_the_end_of_a_diverged_run_is_reported(make_config, run, capsys):
    """Where the last measurement gave no ratio, the report names none."""
    mapping = train_mapping(make_config(), run)
    mapping.pop("name")
    config = from_mapping(TrainConfig, mapping)
    session._report(config, 3, {"one_step/validation": math.inf}, trained=True, stopped=False)
    assert "one-step validation MSE inf" in capsys.readouterr().out


def test_updates_without_a_finite_gradient_are_skipped(data, run, monkeypatch):
    """One NaN in a gradient leaves parameters and moments bitwise unchanged and is counted, and the training continues.
    At the limit of skipped updates in a row it ends with a message, and the stored parameters are finite."""
    before: dict[int, dict[str, torch.Tensor]] = {}
    original = TorchUpdates.run

    def remember(updates, chunk, first):
        before[first] = {name: tensor.clone() for name, tensor in updates.trained.network.state_dict().items()}
        return original(updates, chunk, first)

    monkeypatch.setattr(TorchUpdates, "run", remember)
    gradients_with_faults(monkeypatch, {2, 3, 9, *range(12, 100)})
    monkeypatch.setattr(gradients, "MAXIMUM_SKIPPED", 5)
    with pytest.raises(ConfigError, match="gradients must be finite, got others in 8 updates in a row"):
        train.main(train_mapping(data, run, maximum_updates=30))
    changed = [
        any(not torch.equal(before[n][name], before[n + 1][name]) for name in before[n]) for n in range(len(before) - 1)
    ]
    assert [n for n, moved in enumerate(changed[:12]) if not moved] == [2, 3, 9] and not any(changed[12:])
    lines = [record for record in metrics(run) if "loss" in record]
    assert [line["skipped_updates"] for line in lines] == [2, 2, 3, 7]
    assert all(np.isfinite(line["gradient_norm"]) for line in lines[:3])
    assert all(np.isfinite(line["loss"]) for line in lines)
    stored = read_checkpoint(run / "checkpoints" / "last.ckpt")
    assert (stored["hgn"]["updates"], stored["hgn"]["skipped"]) == (15, 6)
    assert {int(entry["step"]) for entry in stored["optimizer_states"][0]["state"].values()} == {9}
    assert all(tensor.isfinite().all() for tensor in stored["state_dict"].values())


@pytest.mark.parametrize(
    ("number", "place", "updates"),
    [
        *((number, (TorchUpdates, "step"), 3) for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGINT)),
        (signal.SIGTERM, (LogLines, "on_train_start"), 1),  # while Lightning's own handler is in place
    ],
)
def test_signals_end_the_run_after_a_checkpoint(data, run, monkeypatch, capsys, number, place, updates):
    """A real signal in the middle of an update, or before the first, ends the run at that update, with a checkpoint and
    128 + its number. The time of the remaining updates is not estimated then."""
    original = getattr(*place)
    monkeypatch.setattr(callbacks, "ESTIMATE_AFTER_S", 0.0)

    def signalled(*arguments):
        if updates == 1 or arguments[1] == 2:
            os.kill(os.getpid(), number)
        original(*arguments)

    monkeypatch.setattr(*place, signalled)
    assert train.main(train_mapping(data, run)) == 128 + number
    assert "for the remaining updates" not in capsys.readouterr().err
    assert read_checkpoint(run / "checkpoints" / "last.ckpt")["hgn"]["updates"] == updates


@pytest.mark.parametrize("later", [True, False])
def test_a_second_interrupt(finished, monkeypatch, later):
    """A second Ctrl-C within an update ends the command immediately, by an interrupt as in every command. If it is a
    repetition of the first one, as launchers send it, the update is saved."""
    (data, run), step = finished, TorchUpdates.step

    def signalled(updates, update):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        step(updates, update)

    monkeypatch.setattr(TorchUpdates, "step", signalled)
    if later:
        monkeypatch.setattr(signals, "ONE_REQUEST_S", -1.0)
    code = None
    with suppress(KeyboardInterrupt):
        code = train.main(train_mapping(data, run, maximum_updates=14))
    assert code == (None if later else 130)
    assert read_checkpoint(run / "checkpoints" / "last.ckpt")["hgn"]["updates"] == (12 if later else 13)


@pytest.mark.parametrize("updates", [12, 5])
def test_a_finished_run_stays_finished(finished, capsys, updates):
    """A second start of a finished run, also with fewer updates, changes none of its results and prints how to continue
    it. Incomplete files of a crash are removed. While another training uses the run, a start is refused."""
    data, run = finished
    kept = [run / "metrics.jsonl", *sorted((run / "checkpoints").iterdir())]
    before = [path.read_bytes() for path in kept]
    (run / "checkpoints" / ".last.ckpt.1.partial").write_bytes(b"half")
    with locked(run / ".lock", "run", ""), pytest.raises(ConfigError, match="run must be a folder of its own, got"):
        train.main(train_mapping(data, run))
    assert train.main(train_mapping(data, run, maximum_updates=updates)) == 0
    printed = capsys.readouterr().out
    assert printed == f"{run} is finished: 12 updates; training.maximum_updates above 12 continues it\n"
    assert {path.name for path in (run / "checkpoints").iterdir()} == {*LAST_NAMES, "best.ckpt"}
    assert [path.read_bytes() for path in kept] == before


def test_the_best_network_is_remembered(data, run, monkeypatch):
    """A measurement at the end, after a checkpoint of the same update, is the bound for later starts, so that
    `best.ckpt` is never replaced by a worse one. An unused GPU with training.device=cpu causes no warning."""
    monkeypatch.setattr("lightning.pytorch.trainer.setup.CUDAAccelerator.is_available", lambda: True)
    assert train.main(train_mapping(data, run, maximum_updates=5, monitor_every=1000)) == 0
    (error,) = (record["one_step/validation"] for record in metrics(run) if "one_step/validation" in record)
    stored = read_checkpoint(run / "checkpoints" / "last.ckpt")["callbacks"]["Checkpoints"]
    assert stored == {"best_error": error, "measured_update": 5}


def test_without_validation_scenes_there_is_no_best(make_config, make_dataset, tmp_path, capsys):
    """Without validation scenes the start prints that there is no best checkpoint. The end, and an export of the
    missing file, name the checkpoint to export instead."""
    config, run = make_config(validation_scenes=0), tmp_path / "run"
    make_dataset(config)
    assert train.main(train_mapping(config, run, maximum_updates=2)) == 0
    said, last = capsys.readouterr(), run / "checkpoints" / "last.ckpt"
    assert "no validation scenes, so no best.ckpt, validation errors or pictures are written" in said.err
    assert f"no best.ckpt, because no validation scene was measured; export {last}" in said.out
    missing = run / "checkpoints" / "best.ckpt"
    assert last.is_file() and not missing.exists()
    with pytest.raises(ConfigError, match=rf"got {missing}; no validation scene was measured, so use {last}"):
        export(missing, tmp_path / "out.safetensors")
    export(last, tmp_path / "out.safetensors")
    with pytest.raises(ConfigError, match=r"got .*other.ckpt; hgn.train writes one"):
        export(tmp_path / "other.ckpt", tmp_path / "out.safetensors")


def test_a_finished_run_can_go_on(finished):
    """With more updates, and with settings that need not be the same, here the learning rate. Where a full disk cut the
    last record of the metrics, the next one is written on a line of its own."""
    data, run = finished
    whole = metrics(run)
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"update": 8, "ti')
    assert train.main(train_mapping(data, run, learning_rate=5e-4, maximum_updates=20)) == 0
    records = metrics(run)
    assert records[: len(whole)] == whole
    rates = {record["update"]: record["learning_rate"] for record in records if "loss" in record}
    assert [rates[n] for n in (16, 20)] == pytest.approx([5e-4 * 0.2 ** (n / 20) for n in (16, 20)])


def test_training_learns(make_config, make_dataset, run):
    """On free fall with strong velocity noise, 80 updates learn to undo a good part of the noise."""
    config = make_config(training_scenes=6, frames=30)
    make_dataset(config)
    changes = {"maximum_updates": 80, "batch_scenes": 16, "learning_rate": 2e-2, "noise_std": 0.02}
    train.main(train_mapping(config, run, **changes, monitor_every=1000, checkpoint_every=1000))
    losses = [record["loss"] for record in metrics(run) if "loss" in record]
    assert sum(losses[-4:]) < 0.8 * sum(losses[:4])


def test_damaged_checkpoints_are_refused(finished, capsys):
    """A training resumes from the newest intact one of the last three checkpoints. A cut or altered one is named and
    stays. If none is intact, the training ends with a message."""
    data, run = finished
    paths = [run / "checkpoints" / name for name in LAST_NAMES]
    assert [read_checkpoint(path)["hgn"]["updates"] for path in paths] == [12, 10, 5]
    contents = [path.read_bytes() for path in paths]
    with zipfile.ZipFile(paths[0]) as records:
        largest = max((i for i in records.infolist() if "/data/" in i.filename), key=lambda info: info.file_size)
    flipped = bytearray(contents[0])
    flipped[largest.header_offset + 200] ^= 1
    paths[0].write_bytes(flipped)
    paths[1].write_bytes(contents[1][:1000])
    torch.load(paths[0], weights_only=True)  # which does not see it
    mapping = train_mapping(data, run)
    config = from_mapping(TrainConfig, {name: value for name, value in mapping.items() if name != "name"})
    resume = train._checkpoint_to_resume(config, paths[0].parent)
    errors = capsys.readouterr().err
    assert resume is not None and resume.path == paths[2]
    assert resume.progress.sampler_state.position == 10 and errors.count("must be a complete checkpoint file") == 2
    assert "has a wrong CRC; trying the previous one" in errors
    paths[2].write_bytes(b"")
    with pytest.raises(ConfigError, match=r"last\.ckpt: .* has a wrong CRC"):
        train.main(mapping)
    assert paths[0].read_bytes() == flipped


@pytest.mark.parametrize("order", list(permutations((signal.SIGTERM, signal.SIGUSR1))))
def test_signals_of_a_scheduler(order, capfd, monkeypatch):
    """SIGUSR1, which requeues a job, determines the exit code, whatever signals come before or after it. The first rank
    prints once that the training ends."""
    for rank, lines in (("0", 1), ("1", 0)):
        monkeypatch.setenv("RANK", rank)
        stop = StopRequest()
        for number in order:
            stop._receive(number, None)
        told = "completed and saved; Ctrl-C (SIGINT) then ends the command at once\n"
        assert stop.exit_code == 138 and capfd.readouterr().err.count(told) == lines


@pytest.mark.parametrize(
    ("changes", "training", "message"),
    [
        ({}, {"more_data": ["nowhere"]}, r"nowhere/manifest\.json must be the manifest of a data set"),
        ({}, {"more_data": ["DATA"]}, r"more_data\[0\] must be a data set that is not among the others"),
        ({"dataset": {"training_scenes": 0}}, {}, r"more_data\[0\] must be a data set with training episodes"),
        ({"dataset": {"frame_rate_hz": 30.0}}, {}, r"more_data\[0\] must be data with 60 frames per second, got 30"),
        ({"scene": {"cell_size": 1 / 32}}, {}, r"more_data\[0\] must be data with cells of 0.015625, got 0.03125"),
        ({"scene": {"gravity": (0.0, -1.0, 0.0)}}, {}, r"more_data\[0\] must be data with the settings' gravity if"),
        ({"mpm": {"poisson_ratio": 0.3}}, {}, r"data with the same mpm settings, got .*mpm.poisson_ratio is 0.3 there"),
    ],
)
def test_data_that_do_not_go_together(data, make_config, make_dataset, tmp_path, changes, training, message):
    """Data sets that do not fit each other are refused before anything starts, and the message names the difference."""
    training = dict(training)
    dataset = {"frames": 9} | changes.get("dataset", {})
    config = make_config(folder=str(tmp_path / "other"), seed=1, **dataset)
    for section in ("scene", "mpm"):
        config = replace(config, **{section: replace(getattr(config, section), **changes.get(section, {}))})
    make_dataset(config)
    folders = training.pop("more_data", [config.dataset.folder])
    folders = [data.dataset.folder if folder == "DATA" else folder for folder in folders]
    with pytest.raises(ConfigError, match=message):
        train.main(train_mapping(data, tmp_path / "run", more_data=folders, **training))
    assert not (tmp_path / "run").exists()
