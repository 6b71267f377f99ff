"""tools.studies.drift: departures are what they are called, floors have the size asked for, failures are told."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from network.states import gns_of, network_of
from PIL import Image

import datagen.mpm.solver
from datagen.mpm.solver import Simulated
from hgn.config import DatagenConfig
from hgn.data.reader import EpisodeStore
from hgn.runtime.rollouts import RolloutResult
from hgn.runtime.simulator import InitialState
from hgn.runtime.weights import WeightsInfo, save_weights
from hgn.schema import ConfigError
from tools.studies.drift import Run, departure, displaced, main, median_so_far, runs, table

FRAMES = 6


@pytest.fixture
def data(make_config: Callable[..., DatagenConfig], make_dataset: Callable[[DatagenConfig], Path]) -> str:
    return str(make_dataset(make_config(frames=FRAMES)))


@pytest.fixture
def weights(tmp_path: Path) -> str:
    network = network_of(torch.float32, width=8, material_embedding=2)
    save_weights(tmp_path / "tiny.safetensors", network, WeightsInfo(network.config, 60.0, 1 / 64, updates=7))
    return str(tmp_path / "tiny.safetensors")


def falling(scenes, config, frames, frame_rate_hz, on_frame=None, colliders=None, stability_fractions=None):
    """Free fall, a hundredth of the step too slow."""
    results: list[Any] = []
    for scene, step in zip(scenes, stability_fractions, strict=True):
        time_T = np.arange(frames)[:, None, None] / frame_rate_hz
        fall_3 = 0.5 * np.array(scene.gravity) * (1 - 0.01 * step)
        results.append(Simulated((scene.position_N3 + fall_3 * time_T**2).astype(np.float32), {}))
    return results


def test_the_report(
    data: str, weights: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """A row for each thing that is set beside another: floors as large as asked for, and the solver's by its steps."""
    monkeypatch.setattr(datagen.mpm.solver, "simulate", falling)
    out = tmp_path / "results" / "drift"
    options = {"data": data, "out": str(out), "weights": weights, "split": "validation", "device": "cpu"}
    assert main(options | {"displacements": [1e-3, 2e-3]}) == 0
    report = json.loads(Path(f"{out}.json").read_text())
    rows = {(row["system"], row["name"]): row for row in report["rows"]}
    assert len(report["meta"]["episodes"]) == 2 and report["meta"]["frames"] == FRAMES
    assert [name for system, name in rows if system == "network"] == [
        *("error: from the data", "torch, fp32, once more", "displaced by 0.001", "displaced by 0.002")
    ]
    assert rows["network", "error: from the data"]["mean"]["5"] > 1e-8
    assert all(value < 1e-10 for value in rows["network", "torch, fp32, once more"]["curves"]["mean"])
    for system in ("network", "solver"):
        small, large = (rows[system, f"displaced by {size}"]["curves"]["mean"] for size in (0.001, 0.002))
        assert small[0] == pytest.approx(1e-6, rel=0.2) and large[0] == pytest.approx(4e-6, rel=0.2)
        assert len(small) == FRAMES
    step = EpisodeStore(data, "validation").manifest.config["mpm"]["stability_fraction"]
    fall = 0.5 * 9.8 * 0.01 * (step / 2) * (5 / 60) ** 2
    assert rows["solver", "half the step"]["mean"]["5"] == pytest.approx(fall**2, rel=1e-2)
    for row in report["rows"]:
        assert row["failed_scenes"] == 0 and len(row["scenes"]["5"]) == 2
        assert row["median"]["5"] == row["curves"]["median"][5] and len(row["curves"]["median"]) == FRAMES
        assert row["mean"]["5"] == pytest.approx(np.mean(row["scenes"]["5"]), rel=1e-3, abs=1e-20)
    with Image.open(f"{out}.png") as picture:
        assert picture.width > 500
    assert table(report["rows"]) in capsys.readouterr().out


def test_a_scene_that_diverges_is_told(
    data: str, weights: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It counts as far as both came, and the row names the first cause."""
    here = tmp_path / "here.json"
    monkeypatch.setattr("tools.studies.drift.displaced", lambda episode, size: flung(displaced(episode, 0), size))
    options = {"data": data, "out": str(tmp_path / "drift"), "weights": weights, "split": "validation", "device": "cpu"}
    assert main(options | {"displacements": [1e-3], "solver": False, "json": str(here)}) == 0
    assert not (tmp_path / "drift.json").exists()
    row = next(row for row in json.loads(here.read_text())["rows"] if row["name"] == "displaced by 0.001")
    assert row["failed_scenes"] == 2 and "diverged at frame 2" in row["first_failure"]
    assert row["mean"]["1"] > 0.1 and row["mean"]["5"] is None and row["scenes"]["5"] == [None, None]


def flung(scene: InitialState, size: float) -> InitialState:
    """So fast that two frames take it out of the domain by its own size."""
    return replace(scene, velocity_N3=scene.velocity_N3 + 60.0) if size else scene


def test_displaced_alike_whenever_asked_for(data: str) -> None:
    """The same numbers for a scene, other ones for another, each coordinate by at most the size."""
    first, second = EpisodeStore(data, "validation").episodes[:2]
    moves = [displaced(e, 1e-3).position_N3 - e.position_TN3[0] for e in (first, first, second)]
    assert (moves[0] == moves[1]).all() and moves[0].dtype == np.float32
    count = min(len(moves[0]), len(moves[2]))
    assert (moves[0][:count] != moves[2][:count]).any()
    assert 0.9e-3 < np.abs(moves[0]).max() < 1.001e-3
    assert (displaced(first, 0.0).position_N3 == first.position_TN3[0]).all()


def test_what_a_device_takes() -> None:
    """On a GPU every path and precision that simulates the network; on a CPU, where all products are float32's, none
    but the floors."""
    wide, gns = network_of(width=128).config, gns_of(width=128).config
    floors = [Run("torch", "fp32"), Run("torch", "fp32", 1e-6)]
    cuda, cpu = torch.device("cuda"), torch.device("cpu")
    fast = [Run("torch", "tf32"), Run("triton", "tf32"), Run("triton", "fp16")]
    assert runs(cuda, wide, [1e-6]) == [*floors, *fast]
    assert runs(cuda, gns, [1e-6]) == [*floors, Run("torch", "tf32"), Run("triton", "fp16")]
    assert runs(cpu, wide, [1e-6]) == floors


def test_departures_end_where_either_does() -> None:
    """Means and medians are over the scenes that came so far."""
    path = np.zeros((4, 2, 3), np.float32)
    trials = [RolloutResult(path + 1), RolloutResult(path[:2] + 2, "left")]
    mse_ST = departure(trials, [RolloutResult(path[:3]), RolloutResult(path)], 5)
    expected = [[3, 3, 3, np.nan, np.nan], [12, 12, np.nan, np.nan, np.nan]]
    assert np.array_equal(mse_ST, expected, equal_nan=True)
    assert np.array_equal(median_so_far(mse_ST), [7.5, 7.5, 3, np.nan, np.nan], equal_nan=True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": 1}, "frames must be at least 2"),
        ({"displacements": [0.0]}, r"displacements\[0\] must be above 0"),
        ({"displacements": [1e-6, 1e-6]}, r"displacements\[1\] must be named once"),
        ({"split": "best"}, "split must be one of"),
        ({"out": ""}, "out must be"),
    ],
)
def test_refused(options: dict[str, Any], message: str) -> None:
    """Before anything is read."""
    with pytest.raises(ConfigError, match=message):
        main({"data": "nowhere", "out": "drift"} | options)
