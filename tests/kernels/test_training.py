"""The training command on the fast path: counts, logs, checkpoints, resume, and the way back to the plain path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from kernels.engines import device
from training.runs import metrics, train_mapping

from hgn import train
from hgn.config import DatagenConfig, NetworkConfig, TrainingConfig
from hgn.runtime.backend import choose_path, path_on, why_not_fast, why_not_trained_fast
from hgn.schema import ConfigError
from hgn.training.checkpoint import read_checkpoint
from hgn.training.data_module import UPDATES_AT_ONCE, chunk_length

NETWORK = {"width": 16, "levels": 1, "message_passing_steps": 1, "material_embedding": 2, "cell_size": 0.2}


@pytest.fixture
def data(make_config: Callable[..., DatagenConfig], make_dataset: Callable[[DatagenConfig], Path]) -> DatagenConfig:
    config = make_config(training_scenes=2, validation_scenes=1, test_scenes=0)
    make_dataset(config)
    return config


def run_mapping(config: DatagenConfig, run: Path, **training: Any) -> dict[str, Any]:
    values = {"maximum_updates": 4, "log_every": 4, "checkpoint_every": 4, "monitor_every": 4, "monitor_scenes": 1}
    values |= {"path": "fast", "precision": "highest", "monitor_frame_stride": 3, "accelerator": "auto"} | training
    mapping = train_mapping(config, run, **values)
    return mapping | {"network": NETWORK}


def test_fast_training_is_the_plain_one(
    data: DatagenConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without noise and jitter both paths make the same updates: every count and log line is there, weights,
    their average and moments agree; a training may change path at any checkpoint, and ends where the others do."""
    if device().type == "cpu":
        monkeypatch.setattr("hgn.runtime.backend.why_not_fast", lambda *_: None)  # interpreted
    same = {"noise_std": 0.0, "grid_jitter": False, "warmup_updates": 3, "ema_decay": 0.7}
    ends = {}
    for name, parts in {
        "plain": [("plain", 4)],
        "fast": [("fast", 4)],
        "mixed": [("plain", 1), ("fast", 2), ("plain", 4)],
    }.items():
        for path, updates in parts:
            with monkeypatch.context() as patch:
                if updates < 4:
                    stop_at(patch, updates)
                assert train.main(run_mapping(data, tmp_path / name, path=path, **same)) == 0
            ends[name] = read_checkpoint(tmp_path / name / "checkpoints" / "last.ckpt")
            assert ends[name]["hgn"]["updates"] == updates
    assert "training path: fast, precision highest" in capsys.readouterr().err
    for name in ("fast", "mixed"):
        for key in ("lr_schedulers", "hgn"):
            assert ends[name][key] == ends["plain"][key], key
        for key, value in ends["plain"]["state_dict"].items():
            torch.testing.assert_close(ends[name]["state_dict"][key], value, rtol=1e-3, atol=2e-5)
        states, expected = ends[name]["optimizer_states"][0], ends["plain"]["optimizer_states"][0]
        assert states["param_groups"] == expected["param_groups"]
        for parameter, state in expected["state"].items():
            assert float(states["state"][parameter]["step"]) == float(state["step"]) == 4
            torch.testing.assert_close(states["state"][parameter]["exp_avg"], state["exp_avg"], rtol=1e-2, atol=1e-6)
    plain, fast = ([record for record in metrics(tmp_path / name) if "loss" in record] for name in ("plain", "fast"))
    assert [record["update"] for record in fast] == [record["update"] for record in plain] == [4]
    for found, expected in zip(fast, plain, strict=True):
        assert found["learning_rate"] == expected["learning_rate"] and found["skipped_updates"] == 0
        assert found["loss"] == pytest.approx(expected["loss"], rel=1e-4)
        assert found["gradient_norm"] == pytest.approx(expected["gradient_norm"], rel=1e-3)
    monitored = [
        [record["one_step/validation"] for record in metrics(tmp_path / name) if "one_step/validation" in record]
        for name in ("plain", "fast")
    ]
    assert len(monitored[0]) == 1 and monitored[1] == pytest.approx(monitored[0], rel=1e-3)


def test_fast_training_of_gns_is_the_plain_one(
    data: DatagenConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """GNS with Muon and a moving average: a training that takes the fast path from its second update on ends where a
    plain one does, with the same counts and rates."""
    on_cpu = device().type == "cpu"
    if on_cpu:
        monkeypatch.setattr(
            "hgn.training.session.why_not_trained_fast", lambda *_: None
        )  # kernels run in the interpreter
    same = {"noise_std": 0.0, "grid_jitter": False, "optimizer": "muon", "ema_decay": 0.7, "maximum_updates": 3}
    same |= {"log_every": 3, "checkpoint_every": 3, "monitor_every": 3, "precision": "highest" if on_cpu else "half"}
    ends = {}
    for name, parts in {"plain": [("plain", 3)], "mixed": [("plain", 1), ("fast", 3)]}.items():
        for path, updates in parts:
            mapping = run_mapping(data, tmp_path / name, path=path, **same)
            with monkeypatch.context() as patch:
                if updates < 3:
                    stop_at(patch, updates)
                assert train.main(mapping | {"network": NETWORK | {"kind": "gns"}}) == 0
        ends[name] = read_checkpoint(tmp_path / name / "checkpoints" / "last.ckpt")
        assert ends[name]["hgn"]["updates"] == 3
    assert "training path: fast" in (said := capsys.readouterr().err) and "gradients within" in said
    assert ends["mixed"]["lr_schedulers"] == ends["plain"]["lr_schedulers"]
    tolerance = {"rtol": 1e-3, "atol": 2e-5} if on_cpu else {"rtol": 5e-2, "atol": 6e-3}
    for key, value in ends["plain"]["state_dict"].items():
        torch.testing.assert_close(ends["mixed"]["state_dict"][key], value, **tolerance)
    states, expected = ends["mixed"]["optimizer_states"][0], ends["plain"]["optimizer_states"][0]
    assert all(float(states["state"][i]["step"]) == float(state["step"]) == 3 for i, state in expected["state"].items())
    lines = [[line for line in metrics(tmp_path / name) if "one_step/validation" in line][-1] for name in ends]
    assert lines[0]["update"] == lines[1]["update"] == 3
    assert lines[1]["one_step/validation"] == pytest.approx(
        lines[0]["one_step/validation"], rel=1e-2 if on_cpu else 0.2
    )


def stop_at(monkeypatch: pytest.MonkeyPatch, update: int) -> None:
    """Lets the next training end once it has made that many updates, or just after."""
    from hgn.training.callbacks import Stopper

    original = Stopper.on_train_batch_end

    def on_train_batch_end(self, trainer, *arguments):
        trainer.should_stop = trainer.global_step >= update
        return original(self, trainer, *arguments)

    monkeypatch.setattr(Stopper, "on_train_batch_end", on_train_batch_end)


def test_chunks_end_where_something_is_due() -> None:
    """Chunks meet every multiple of the log, checkpoint, monitor and rollout intervals and the last update, whatever
    update a training begins at, and the first ones are short."""
    training = TrainingConfig(
        maximum_updates=1000, log_every=50, checkpoint_every=70, monitor_every=300, rollout_share=0.2, rollout_every=32
    )
    for begun in (0, 37, 999):
        update, ends = begun, []
        while update < 1000:
            count = chunk_length(training, begun, update)
            assert 1 <= count <= UPDATES_AT_ONCE
            update += count
            ends.append(update)
        due = {n for every in (50, 70, 300, 32) for n in range(every, 1001, every) if n > begun} | {1000}
        assert due <= set(ends) and ends[-1] == 1000 and ends[0] == begun + 1
    assert chunk_length(training, 0, 1000) >= 1


@pytest.mark.parametrize(
    ("path", "precision", "reason", "expected"),
    [
        ("auto", "high", None, ("fast", "training path: fast, precision high")),
        ("plain", "high", None, ("plain", "training path: plain, precision high")),
        ("auto", "high", "it needs gold", ("plain", "training path: plain (it needs gold), precision high")),
        ("fast", "high", "it needs gold", "training.path must be plain or auto here, got fast: it needs gold"),
        ("auto", "half", "it needs gold", "precision must be high or highest on the plain path, got half"),
        ("plain", "half", None, "got half; training.path=plain was asked for"),
    ],
)
def test_the_path_is_chosen_and_said(path: str, precision: str, reason: str | None, expected: Any) -> None:
    """auto takes the fast path where it runs and says so; what cannot be had is refused, never replaced silently."""
    if isinstance(expected, tuple):
        assert choose_path("training.path", path, precision, reason) == expected
    else:
        with pytest.raises(ConfigError, match=expected):
            choose_path("training.path", path, precision, reason)


def test_gns_has_half_precision_on_the_plain_path() -> None:
    """What other networks are refused there."""
    assert choose_path("path", "auto", "half", "it computes hgn", True)[0] == "plain"
    assert path_on(torch.device("cpu"), NetworkConfig(kind="gns", levels=1), "auto", "half")[0] == "plain"
    with pytest.raises(ConfigError, match="got half; it needs a CUDA device"):
        path_on(torch.device("cpu"), NetworkConfig(), "auto", "half")


def test_why_gns_is_not_trained_on_the_fast_path() -> None:
    """Another device, precision or width, static particles, a limit of neighbours and own states are each named."""
    gpu, gns = torch.device("cuda"), NetworkConfig(kind="gns", levels=1)
    assert why_not_trained_fast(gpu, gns, "half") is None and why_not_trained_fast(gpu, NetworkConfig(), "high") is None
    assert "not cpu" in str(why_not_trained_fast(torch.device("cpu"), gns, "half"))
    assert "not high" in str(why_not_trained_fast(gpu, gns, "high"))
    assert "not 48" in str(why_not_trained_fast(gpu, replace(gns, width=48), "half"))
    assert "not 128" in str(why_not_trained_fast(gpu, replace(gns, maximum_neighbours=128), "half"))
    assert "true states" in str(why_not_trained_fast(gpu, gns, "half", own_states=True))
    static = NetworkConfig(kind="gns_particles", levels=1, obstacle_features=False)
    assert "not gns_particles" in str(why_not_trained_fast(gpu, static, "half"))


def test_why_the_fast_path_does_not_run() -> None:
    """A CPU, GNS, an odd width and too many levels are each named."""
    gpu, hgn = torch.device("cuda"), NetworkConfig()
    assert why_not_fast(gpu, hgn) is None
    assert "not cpu" in str(why_not_fast(torch.device("cpu"), hgn))
    assert "not gns" in str(why_not_fast(gpu, NetworkConfig(kind="gns", levels=1)))
    assert "not 48" in str(why_not_fast(gpu, NetworkConfig(width=48)))
    assert "widths up to 64, not 128" in str(why_not_fast(gpu, hgn, "highest"))
    assert "at most 8" in str(why_not_fast(gpu, NetworkConfig(levels=9)))
