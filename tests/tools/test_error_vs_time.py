"""python -m tools.error_vs_time: its rows, its measures, what it does with failures; no assertion on any time."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ballistic_dataset import MakeConfig, MakeDataset
from network.states import gns_of, network_of, random_grid
from PIL import Image

import datagen.mpm.solver
from datagen.mpm.solver import SceneFailure, Simulated
from hgn.config import MpmConfig
from hgn.data.batch import make_batch
from hgn.data.reader import EpisodeStore
from hgn.runtime.rollouts import RolloutResult, simulate_scenes
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.weights import WeightsInfo, save_weights, shipped_weights
from hgn.scene.distance import share_inside
from hgn.scene.shapes import shape_obstacle
from hgn.schema import ConfigError, from_mapping
from hgn.training.errors import ballistic, frame_batches, one_step_errors
from tools.error_vs_time import score
from tools.error_vs_time.__main__ import fitting_weights, main, network_contenders
from tools.error_vs_time.contenders import BaselineContender, TritonPredictor
from tools.error_vs_time.paired import paired_difference, paired_lines, paired_rows
from tools.error_vs_time.plot import draw_frames, draw_pareto
from tools.error_vs_time.settings import ErrorVsTimeConfig
from tools.error_vs_time.sinkhorn import sinkhorn_divergences
from tools.measures import energies, energy_scale, momentum_error, outside_domain
from tools.solver_rollouts import FrameClock, other_grid

CPU = torch.device("cpu")
FRAMES = 6


def fake_simulate(scenes, config, frames, frame_rate_hz, on_frame=None, colliders=None, stability_fractions=None):
    """Falls a little short of the data; the larger the step, the more; a whole step kills the first scene."""
    results: list[Any] = []
    assert len(colliders) == len(scenes) == len(stability_fractions)
    first = scenes[0].seed
    for scene, step in zip(scenes, stability_fractions, strict=True):
        time_T = np.arange(frames)[:, None, None] / frame_rate_hz
        fall_3 = 0.5 * np.array(scene.gravity) * (1 - 0.1 * step) * (32 / 64 * scene.cell_size * 64)
        path_TN3 = (scene.position_N3 + scene.velocity_N3 * time_T + fall_3 * time_T**2).astype(np.float32)
        failed = step == 1.0 and scene.seed == first
        results.append(SceneFailure("too fast") if failed else Simulated(path_TN3, {}))
    for frame in range(frames):
        if on_frame is not None:
            on_frame(frame)
    return results


def weights_file(path: Path, kind: str) -> Path:
    network = (network_of if kind == "hgn" else gns_of)(torch.float32, width=8, material_embedding=2)
    save_weights(path, network, WeightsInfo(network.config, 60.0, 1 / 64, updates=7))
    return path


@pytest.fixture
def data(make_config: MakeConfig, make_dataset: MakeDataset) -> str:
    return str(make_dataset(make_config(frames=FRAMES)))


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without their figures, which take most of the time."""
    monkeypatch.setattr("tools.error_vs_time.run.draw", lambda *_: [])


def test_the_report(data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """Every contender gets a row with the report's keys on the same scenes; a solver that fails is counted."""
    monkeypatch.setattr(datagen.mpm.solver, "simulate", fake_simulate)
    weights = [str(weights_file(tmp_path / f"{kind}.safetensors", kind)) for kind in ("hgn", "gns")]
    out = tmp_path / "results" / "report"
    options = {"data": data, "out": str(out), "weights": weights, "split": "validation", "frame_stride": 2}
    options |= {
        "mpm_grids": [32, 64],
        "timed_frames": 5,
        "rounds": 1,
        "batch_scenes": 2,
        "timed_batches": [2],
        "timed_scenes": 1,
    }
    options |= {"sinkhorn_points": 8, "device": "cpu"}
    assert main(options) == 0
    report = json.loads(Path(f"{out}.json").read_text())
    assert {"device", "versions", "commit", "date", "command", "convention", "reference"} <= report["meta"].keys()
    rows = report["rows"]
    systems = [row["system"] for row in rows]
    assert systems == ["hgn", "gns", *["baseline"] * 3, *["mpm"] * 4, *["chaos"] * 2]
    keys = {
        "one_step_mse",
        "position_mse",
        "sinkhorn",
        "penetration",
        "ghost",
        "momentum_error",
        "seeds",
    }
    for row in rows:
        assert keys <= row.keys() and len(row["seeds"]) == 2
        assert (row["one_step_mse"] is None) == (row["system"] in ("mpm", "chaos"))
        assert ("ms" in row) == (row["system"] in ("hgn", "gns", "mpm"))
    mpm = {(row["grid"], row["step"]): row for row in rows if row["system"] == "mpm"}
    assert mpm[64, 1.0]["failed_scenes"] == 1 and mpm[64, 1.0]["first_failure"] == "too fast"
    assert mpm[64, 1.0]["scenes_reached"] == {"5": 1} and mpm[64, 0.5]["scenes_reached"] == {"5": 2}
    assert 0 < mpm[64, 0.5]["position_mse"]["5"] < mpm[32, 0.5]["position_mse"]["5"]
    assert report["meta"]["not_run"] == [] and all(row["scoring_s"] >= 0 for row in rows)
    floor = {row["floor"]: row["position_mse"]["5"] for row in rows if row["system"] == "chaos"}
    assert 1e-13 < floor["perturbed by 1e-06"] < 3e-12
    assert floor["twice the step"] == pytest.approx(mpm[64, 0.5]["position_mse"]["5"])
    assert report["meta"]["set"]["drawn"] is None and len(report["meta"]["set"]["not_frozen_before"]) == 2
    assert rows[0]["by_scene"].keys() == {"one-step MSE", "position MSE", "Sinkhorn"} != rows[-1]["by_scene"].keys()
    for row in rows:
        for error, mean in (("position MSE", row["position_mse"]["5"]), ("one-step MSE", row["one_step_mse"])):
            for values in row["by_scene"].get(error, {}).values():
                assert np.mean([value for value in values if value is not None]) == pytest.approx(mean, rel=0.1)
    assert {row["other"].split(",")[0] for row in report["paired"]} == {"GNS M = 3", "MPM 32³", "MPM 64³"}
    for end in ("", "_batched", "_frames"):
        with Image.open(f"{out}{end}.png") as picture:
            assert picture.width > 500
    printed = capsys.readouterr().out
    assert all(
        name in printed for name in ("HGN L = 3, M = 2", "GNS M = 3, torch fp32", "MPM 32³, step 1", "chaos floor")
    )


@pytest.mark.usefixtures("undrawn")
def test_when_time_is_over(data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What has not begun by then is named, and the report is written without it; a shorter rollout of the solver is
    scored as far as it goes, and each setting is simulated once."""
    calls: list[tuple[float, list[float], int]] = []

    def counted(scenes, config, frames, *more, stability_fractions, **others):
        calls.append((scenes[0].cell_size, sorted(set(stability_fractions)), frames))
        return fake_simulate(scenes, config, frames, *more, stability_fractions=stability_fractions, **others)

    monkeypatch.setattr(datagen.mpm.solver, "simulate", counted)
    monkeypatch.setattr("tools.error_vs_time.__main__.shipped_weights", dict)
    out = tmp_path / "report"
    options = {"data": data, "out": str(out), "split": "validation", "device": "cpu", "resimulate": False}
    options |= {
        "mpm_grids": [64],
        "mpm_frames": 3,
        "timed_frames": 5,
        "mpm_timed_frames": 4,
        "timed_batches": [2],
        "rounds": 1,
        "perturbation": 0.0,
    }
    assert main(options) == 0
    assert [call for call in calls if call[2] == 3] == [(1 / 64, [0.5, 1.0], 3)]  # of one grid side by side
    assert {call[2] for call in calls} == {2, 3, 4} and all(len(call[1]) == 1 for call in calls if call[2] != 3)
    rows = json.loads(Path(f"{out}.json").read_text())["rows"]
    assert [row["system"] for row in rows] == ["baseline"] * 3 + ["mpm", "mpm"]
    assert rows[4]["scenes_reached"] == {"5": 0} and rows[4]["failed_scenes"] == 0
    assert main(options | {"seconds": 1e-9}) == 0
    report = json.loads(Path(f"{out}.json").read_text())
    assert [row["system"] for row in report["rows"]] == ["baseline"] * 3 and len(report["meta"]["not_run"]) == 2
    assert all(left["cause"] == "the time was over" for left in report["meta"]["not_run"])


@pytest.mark.usefixtures("undrawn")
def test_the_data_can_be_the_reference(data: str, tmp_path: Path) -> None:
    """Without a solver the data itself is the reference, and what moves like it has no error."""
    out = tmp_path / "report"
    options = {"data": data, "out": str(out), "split": "validation", "resimulate": False, "device": "cpu"}
    assert main(options | {"weights": [], "mpm_grids": [], "perturbation": 0.0}) == 0
    rows = {row["predictor"]: row for row in json.loads(Path(f"{out}.json").read_text())["rows"]}
    assert rows["ballistic motion"]["position_mse"]["5"] < 1e-13 < rows["constant velocity"]["position_mse"]["5"]
    assert rows["ballistic motion"]["one_step_mse"] < 1e-13 < rows["constant velocity"]["one_step_mse"]


def test_baseline_errors_are_those_of_training(data: str) -> None:
    """One-step errors agree with what training measures, at every frame."""
    (episode,) = EpisodeStore(data, "test").episodes
    gravity = BaselineContender("fall", lambda e: 0.9 * np.asarray(e.gravity) / e.frame_rate_hz**2, CPU)
    network = network_of(torch.float32, obstacle_features=False)
    batches = frame_batches([episode], network, 1, 100)
    expected = one_step_errors({"fall": lambda b: 0.9 * ballistic(b)}, batches, CPU, network.config.materials)
    assert gravity.one_step(episode, 1, 0.0).error.mse == pytest.approx(expected["fall"].mse, rel=1e-5)


def test_the_fast_path_tells_its_own_errors(data: str) -> None:
    """One-step errors of backend triton come from its kernels, several frames at once: in float32 they are the plain
    network's; what is captured serves the next frames, and those of fewer particles too."""
    (episode,) = EpisodeStore(data, "test").episodes
    fewer = replace(
        episode,
        key="fewer",
        position_TN3=episode.position_TN3[:, 1:],
        initial_velocity_N3=episode.initial_velocity_N3[1:],
        material_N=episode.material_N[1:],
    )
    network = network_of(torch.float32, width=16, levels=1, message_passing_steps=1)
    predict, made = TritonPredictor(network, "fp32"), []
    with torch.inference_mode():
        for samples in ([(episode, 0), (episode, 2)], [(fewer, 1), (fewer, 3)], [(episode, 3)]):
            batch = make_batch(samples, network.config)
            torch.testing.assert_close(predict(batch), network(batch.state()), rtol=1e-4, atol=1e-8)
            made.append(predict._rollout)
    assert made[0] is made[1] is not made[2]


def test_precisions_that_a_path_does_not_know(data: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The HGN in fp16 on backend torch is left out, and that is said; triton must run where it is asked for."""
    files = [str(weights_file(tmp_path / f"{kind}.safetensors", kind)) for kind in ("hgn", "gns")]
    options = {"data": data, "out": str(tmp_path / "report"), "split": "test", "weights": files}
    config = from_mapping(ErrorVsTimeConfig, options | {"precisions": ["fp32", "fp16"]})
    (episode,) = EpisodeStore(data, "test").episodes
    found = [(c.row["system"], c.row["precision"]) for c in network_contenders(config, CPU, [episode])]
    assert found == [("hgn", "fp32"), ("gns", "fp32"), ("gns", "fp16")]
    assert "left out: hgn.safetensors at fp16" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="backend must be cpu or torch or auto here, got triton"):
        network_contenders(replace(config, backend="triton"), CPU, [episode])


@pytest.mark.usefixtures("undrawn")
def test_what_counts_most_comes_first(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is simulated with the reference, networks at the precision that tells most, coarse grids, then other
    precisions, whose rollouts off backend triton are short; the report keeps its order. What fails is named with the
    cause, the others go on, and only a fault that nobody foresaw makes the exit code 1."""
    monkeypatch.setattr(datagen.mpm.solver, "simulate", fake_simulate)
    monkeypatch.setattr("tools.error_vs_time.__main__.GNS_ORDER", ("fp32", "fp16", "tf32"))
    files = [str(weights_file(tmp_path / f"{kind}.safetensors", kind)) for kind in ("gns", "hgn")]
    order: list[str] = []

    def noted(contender, *more):
        order.append(score.label(contender.row))
        if "48" in order[-1]:
            raise ConfigError("grids of 48 are not liked")
        return score.score(contender, *more)

    monkeypatch.setattr("tools.error_vs_time.run.score", noted)
    options = {"data": data, "out": str(tmp_path / "report"), "split": "validation", "weights": files, "device": "cpu"}
    options |= {
        "frame_stride": 5,
        "timed_frames": 4,
        "rounds": 1,
        "timed_scenes": 1,
        "timed_batches": [2],
        "sinkhorn_scenes": 0,
    }
    options |= {"mpm_grids": [48, 64], "mpm_steps": [0.5], "precisions": ["tf32", "fp32"], "repeated_frames": 3}
    assert main(options) == 0
    assert [name.split(" (")[0] for name in order] == [
        *["constant velocity", "ballistic motion", "mean acceleration"],
        *["MPM 64³, step 0.5", "chaos floor: perturbed by 1e-06", "chaos floor: twice the step"],
        "HGN L = 3, M = 2, cpu tf32",
        "GNS M = 3, torch fp32",
        "MPM 48³, step 0.5",
        "HGN L = 3, M = 2, cpu fp32",
        "GNS M = 3, torch tf32",
    ]
    report = json.loads((tmp_path / "report.json").read_text())
    (left,) = report["meta"]["not_run"]
    assert left["grid"] == 48 and left["cause"] == "grids of 48 are not liked"
    assert report["meta"]["not_timed"] == ["MPM 64³, step 0.5"]  # whose frames come all at once here
    assert "left out: MPM 48³, step 0.5: grids of 48 are not liked" in capsys.readouterr().err
    rows = report["rows"]
    assert [(row["system"], row["precision"]) for row in rows[:4]] == [
        (kind, precision) for kind in ("gns", "hgn") for precision in ("tf32", "fp32")
    ]
    assert [row["scenes_reached"]["5"] for row in rows[:4]] == [0, 2, 2, 0]
    assert all(row["ms"] > 0 and row["failed_scenes"] == 0 for row in rows[:4])


def test_shipped_weights_that_fit(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By default all shipped weights are compared that are for such data; what is left out is said."""
    (episode,) = EpisodeStore(data, "test").episodes
    networks = {
        "a": network_of(levels=3),
        "b": gns_of(),
        "blind": network_of(obstacle_features=False),
        "slow": network_of(),
        "coarse": network_of(),
        "dry": network_of(materials=("snow",)),
    }
    paths = {}
    for name, network in networks.items():
        paths[name] = tmp_path / f"{name}.safetensors"
        cell_size = 1 / 32 if name == "coarse" else random_grid(0, 10).cell_size
        save_weights(paths[name], network, WeightsInfo(network.config, 30.0 if name == "slow" else 60.0, cell_size))
    monkeypatch.setattr("tools.error_vs_time.__main__.shipped_weights", lambda: paths)
    config = ErrorVsTimeConfig(data=data, out="x")
    grid = random_grid(0, 10)
    water = replace(episode, material_N=np.zeros_like(episode.material_N), obstacle_grid=grid)
    assert [file.stem for file in fitting_weights([water])] == ["a", "b"]
    told = capsys.readouterr().err
    assert all(f"shipped weights {name}," in told for name in ("blind", "slow", "coarse", "dry"))
    found = {c.row["weights"]: c.row["levels"] for c in network_contenders(config, CPU, [water])}
    assert found == {"a.safetensors": 3, "b.safetensors": 1}
    assert set(shipped_weights()) >= {"gns", "obstacles", "obstacles_small"}


def test_ghost_acceleration_counts_particles_at_rest(data: str) -> None:
    """Only particles that have not moved count, each with the length of what is predicted for it."""
    (episode,) = EpisodeStore(data, "test").episodes
    position_TN3 = np.repeat(np.array(episode.position_TN3[:1]), 9, axis=0)
    position_TN3[:, 0] += np.arange(9, dtype=np.float32)[:, None] * 0.01
    still = replace(
        episode,
        position_TN3=position_TN3,
        initial_velocity_N3=np.zeros_like(episode.initial_velocity_N3),
        gravity=(0.0, 0.0, 0.0),
    )
    step = BaselineContender("push", lambda e: np.array([3e-3, 0.0, 4e-3]), CPU).one_step(still, 1, 1e-4)
    assert step.rest_count == 8 * (position_TN3.shape[1] - 1)
    assert score.one_step_figures([step])["ghost"] == pytest.approx(5e-3, rel=1e-5)


def test_a_diverging_scene_ends_alone(data: str) -> None:
    """Beside one that diverges a scene goes on to the end; the other is kept as far as it came, with the cause."""
    episodes = EpisodeStore(data, "validation").episodes
    scenes = [InitialState.of_episode(episode) for episode in episodes]
    scenes = [replace(s, material_N=np.full_like(s.material_N, i)) for i, s in enumerate(scenes)]
    simulator = Simulator(network_of(torch.float32), 60.0)
    simulator.backend.predict = lambda state: (state.material_N == 1)[:, None].float().expand(-1, 3)
    through, failed = simulate_scenes(simulator, scenes, 5)
    assert through.cause is None and through.frame_count == 5
    assert failed.cause is not None and "diverged at frame 2" in failed.cause and failed.frame_count == 2
    assert np.isfinite(failed.position_TN3).all()
    assert simulate_scenes(simulator, [], 5) == []


def test_sinkhorn_against_closed_forms() -> None:
    """Zero for a permuted cloud, the square of the shift for a shifted one, NaN where a position is not finite."""

    def sinkhorn_divergence(first: torch.Tensor, second: torch.Tensor, blur: float) -> float:
        return sinkhorn_divergences([(first, second)], blur)[0]

    generator = torch.Generator().manual_seed(0)
    cloud = torch.rand(120, 3, generator=generator)
    shift = torch.tensor([0.1, -0.05, 0.2])
    assert abs(sinkhorn_divergence(cloud, cloud.flip(0), 0.01)) < 1e-9
    assert sinkhorn_divergence(cloud, cloud + shift, 0.01) == pytest.approx(float(shift.square().sum()), rel=1e-4)
    assert sinkhorn_divergence(cloud, cloud + 0.01 * shift, 0.01) == pytest.approx(5.25e-6, rel=1e-3)
    assert sinkhorn_divergence(cloud[:1], cloud[1:2], 0.01) == pytest.approx(
        float((cloud[0] - cloud[1]).square().sum()), rel=1e-5
    )
    others = [(cloud[:50], cloud[50:100] + shift), (cloud[:50], cloud[:50]), (cloud[:3], cloud[3:6])]
    together = sinkhorn_divergences(
        [*others, (cloud[:50] * 0.1, cloud[50:100]), (cloud[:50] * math.nan, cloud[:50])], 0.05
    )
    assert together[:3] == pytest.approx([sinkhorn_divergence(*pair, 0.05) for pair in others], rel=1e-4, abs=1e-9)
    assert together[3] > 0 and math.isnan(together[4])
    cloud[3, 0] = math.nan
    assert math.isnan(sinkhorn_divergence(cloud, cloud, 0.01))


def test_momentum_and_energy_against_closed_forms() -> None:
    """Free fall keeps its energy and gains momentum as gravity says; standing still loses none and gains none."""
    gravity = np.array([0.0, -1e-3, 0.0])
    time = np.arange(20)[:, None, None]
    start = np.random.default_rng(0).random((1, 7, 3))
    fall = start + 0.5 * gravity * time**2
    energy = energies(fall, gravity)
    np.testing.assert_allclose(energy, energy[0], rtol=2e-4)
    still = np.repeat(start, 20, axis=0)
    assert momentum_error(fall, still) == pytest.approx(1e-3 * math.sqrt(np.mean((np.arange(19) + 0.5) ** 2)))
    assert energy_scale(gravity, (1.0, 2.0, 3.0)) == pytest.approx(2e-3) and energy_scale(0 * gravity, (1, 1, 1)) == 1


def test_shares_inside_obstacles_and_outside_of_the_domain() -> None:
    """Closed bodies hold what is within them, sheets nothing; the domain ends at its planes."""
    cone = shape_obstacle("cone", 0.4, (0.5, 0.5, 0.5), np.eye(3), "cone")
    square = shape_obstacle("square", 0.4, (0.5, 0.5, 0.5), np.eye(3), "square")
    point = np.array([[0.5, 0.5, 0.5], [0.9, 0.9, 0.9], [1.1, 0.5, 0.5], [0.5, -0.1, 0.5]])
    assert share_inside(point, [cone]) == 0.25 and share_inside(point, [square]) == 0
    assert outside_domain(point, (1.0, 1.0, 1.0)) == 0.5 and outside_domain(point[:0], (1.0, 1.0, 1.0)) == 0


def test_frames_that_are_told_together_are_timed_together() -> None:
    """The clock counts from the end of the first bunch of frames; with one bunch only it tells nothing."""
    clock = FrameClock()
    clock.ends = [1.0, 1.000001, 1.000002, 1.3, 1.300001, 1.300002]
    assert clock.milliseconds() == pytest.approx(100, rel=1e-3)
    clock.ends = [1.0, 1.1, 1.2]
    assert clock.milliseconds() == pytest.approx(100)
    clock.ends = [1.0, 1.000001]
    assert clock.milliseconds() is None


def test_other_grids_keep_their_walls() -> None:
    """Three nodes of 1/64 are two of 1/32 at the least, and six of 1/128."""
    cells = [other_grid(MpmConfig(), 1 / n, 1 / 64).wall_cells for n in (32, 48, 64, 128)]
    assert cells == [2, 2, 3, 6]


def test_scenes_that_failed_leave_the_means(data: str) -> None:
    """Errors at a frame are means over the scenes that reached it, and say over how many."""
    episodes = list(EpisodeStore(data, "validation").episodes)
    config = ErrorVsTimeConfig(data="d", out="x", sinkhorn_points=4)
    paths = [np.array(episode.position_TN3) for episode in episodes]
    trials = [RolloutResult(paths[0] + np.float32(0.1)), RolloutResult(paths[1][:3] + np.float32(0.2), "why")]
    row = score.rollout_figures(trials, episodes, config, CPU)
    np.testing.assert_allclose(row["curve"], [*[0.075] * 3, *[0.03] * 3], rtol=1e-4)
    assert row["by_scene"]["position MSE"]["5"] == [pytest.approx(0.03, rel=1e-3), None]
    assert row["by_scene"]["Sinkhorn"]["5"][1] is None
    assert row["scenes_reached"] == {"5": 1} and row["first_failure_frame"] == 3 and row["first_failure"] == "why"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mpm_steps": [0.0]}, r"mpm_steps\[0\] must be above 0"),
        ({"weights": ["a/x.safetensors", "b/x.safetensors"]}, "weights must be files of different names"),
        ({"frames": 1}, "frames must be at least 2"),
        ({"precisions": ["fp8"]}, r"precisions\[0\] must be one of fp32, tf32, fp16"),
        ({"split": "all"}, "split must be one of train"),
    ],
)
def test_bad_options(change: dict[str, Any], message: str) -> None:
    """Each wrong option is named before anything is simulated."""
    with pytest.raises(ConfigError, match=message):
        from_mapping(ErrorVsTimeConfig, {"data": "d", "out": "o"} | change)


SHORT = {"split": "validation", "device": "cpu", "frame_stride": 5, "timed_frames": 4, "rounds": 1, "timed_scenes": 1}
SHORT |= {"sinkhorn_points": 8, "batch_scenes": 2, "timed_batches": [2], "mpm_timed_frames": 4, "perturbation": 0.0}


def test_a_report_goes_on_where_it_was_cut_off(data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of an earlier report are neither simulated nor scored again; those without a run time are. Without data they
    are drawn again and nothing else."""
    simulated: list[set[float]] = []

    def noted(scenes, config, *more, stability_fractions, **others):
        simulated.append(set(stability_fractions))
        return fake_simulate(scenes, config, *more, stability_fractions=stability_fractions, **others)

    monkeypatch.setattr(datagen.mpm.solver, "simulate", noted)
    monkeypatch.setattr("tools.error_vs_time.run.draw", lambda *_: [])
    weights = [str(weights_file(tmp_path / f"{kind}.safetensors", kind)) for kind in ("hgn", "gns")]
    first, second = tmp_path / "first", tmp_path / "second"
    options = {"data": data, "weights": weights, "mpm_grids": [64], "mpm_steps": [0.5], **SHORT}
    assert main(options | {"out": str(first)}) == 0
    report = json.loads(Path(f"{first}.json").read_text())
    rows = {row["system"]: row for row in report["rows"]}
    rows["gns"]["ms"], rows["mpm"]["ms"] = None, 9.0  # the stand-in's frames come all at once
    Path(f"{first}.json").write_text(json.dumps(report))
    simulated.clear()
    scored: list[str] = []

    def counted(contender, *more):
        scored.append(contender.row["system"])
        return score.score(contender, *more)

    monkeypatch.setattr("tools.error_vs_time.run.score", counted)
    assert main(options | {"out": str(second), "earlier": [f"{first}.json"]}) == 0
    assert scored == ["gns"] and simulated == [{0.25}]
    again = json.loads(Path(f"{second}.json").read_text())["rows"]
    assert sorted(row["system"] for row in again) == sorted(row["system"] for row in report["rows"])
    assert main({"out": str(tmp_path / "drawn"), "earlier": [f"{second}.json"]}) == 0
    assert json.loads((tmp_path / "drawn.json").read_text())["rows"] == again
    assert (tmp_path / "drawn.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(ConfigError, match=r"earlier\[0\] frames must be 4 as in this report, got 6; take the data"):
        main(options | {"out": str(second), "earlier": [f"{first}.json"], "frames": 4})
    for text, cause in (("{}", "must be JSON that python -m tools.error_vs_time wrote"), (None, "an existing file")):
        other = tmp_path / f"{text is None}.json"
        if text is not None:
            other.write_text(text)
        with pytest.raises(ConfigError, match=rf"earlier\[0\] must be .*{cause}|{cause}"):
            main({"out": "x", "earlier": [str(other)]})


@pytest.mark.usefixtures("undrawn")
def test_what_nobody_foresaw_stops_one_contender(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The others are scored and timed, the fault is printed whole and named in the report, the exit code is 1."""
    weights = [str(weights_file(tmp_path / f"{kind}.safetensors", kind)) for kind in ("hgn", "gns")]

    def failing(contender, *more):
        if contender.row["system"] == "hgn":
            raise RuntimeError("an illegal memory access")
        return score.score(contender, *more)

    monkeypatch.setattr("tools.error_vs_time.run.score", failing)
    options = {"data": data, "weights": weights, "out": str(tmp_path / "report"), "resimulate": False, "mpm_grids": []}
    assert main(options | SHORT) == 1
    report = json.loads((tmp_path / "report.json").read_text())
    assert [row["system"] for row in report["rows"]] == ["gns", *["baseline"] * 3]
    (left,) = report["meta"]["not_run"]
    assert left["cause"] == "RuntimeError: an illegal memory access" and report["rows"][0]["ms"] > 0
    assert "Traceback" in (told := capsys.readouterr().err) and "1 of the measurements failed" in told


@pytest.mark.usefixtures("undrawn")
def test_a_run_that_is_killed_leaves_whole_points(data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After each contender the file holds its errors and its run times."""
    weights = [str(weights_file(tmp_path / f"{kind}.safetensors", kind)) for kind in ("hgn", "gns")]

    def killed(contender, *more):
        if contender.row["system"] == "gns":
            raise KeyboardInterrupt
        return score.score(contender, *more)

    monkeypatch.setattr("tools.error_vs_time.run.score", killed)
    options = {"data": data, "weights": weights, "out": str(tmp_path / "report"), "resimulate": False, "mpm_grids": []}
    with pytest.raises(KeyboardInterrupt):
        main(options | SHORT)
    rows = {row["system"]: row for row in json.loads((tmp_path / "report.json").read_text())["rows"]}
    assert rows["hgn"]["ms"] > 0 and rows["hgn"]["one_step_mse"] > 0 and rows["hgn"]["position_mse"]["5"] > 0


def test_weights_that_do_not_fit_are_told_at_once(data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before anything is simulated: a name that is not shipped, a file that is not there, weights for other data."""
    monkeypatch.delattr(datagen.mpm.solver, "simulate")
    dry = network_of(torch.float32, materials=("snow",))
    for name, change in (("dry", {}), ("slow", {"frame_rate_hz": 30.0}), ("moon", {"gravity": (0.0, -1.6, 0.0)})):
        network = dry if name == "dry" else network_of(torch.float32)
        values = {"frame_rate_hz": 60.0, "obstacle_cell_size": 1 / 64} | change
        save_weights(tmp_path / f"{name}.safetensors", network, WeightsInfo(network.config, **values))
    for name, message in (
        ("obstacle", r"weights\[0\] must be a file or the name of shipped weights \(.*obstacles.*\), got 'obstacle'"),
        (str(tmp_path / "none.safetensors"), r"weights\[0\] must be an existing file, got .*none"),
        (str(tmp_path / "dry.safetensors"), r"weights\[0\] must be for data as this: with .*, not snow alone, got"),
        (str(tmp_path / "slow.safetensors"), "frames at 60 Hz, not 30.*take other weights"),
        (str(tmp_path / "moon.safetensors"), "with the gravity"),
    ):
        with pytest.raises(ConfigError, match=message):
            main({"data": data, "out": str(tmp_path / "report"), "weights": [name]} | SHORT)
    with pytest.raises(ConfigError, match="data must be a data set, got None; make one with python -m datagen, or"):
        main({"out": str(tmp_path / "report")})


@pytest.mark.parametrize("kind", ["hgn", "gns"])
def test_scenes_beside_one_that_diverges_go_their_way(data: str, kind: str) -> None:
    """Off backend triton they are simulated once, as if it had never been there."""
    episodes = EpisodeStore(data, "validation").episodes
    scenes = [InitialState.of_episode(episode) for episode in (*episodes, episodes[0])]
    scenes[1] = replace(scenes[1], velocity_N3=scenes[1].velocity_N3 + np.float32(60.0))
    simulator, calls = Simulator((network_of if kind == "hgn" else gns_of)(torch.float32), 60.0), []
    predict = simulator.backend.predict
    simulator.backend.predict = lambda state: calls.append(len(state.position_N3)) or predict(state)
    first, lost, last = simulate_scenes(simulator, scenes, 5)
    assert lost.cause is not None and f"diverged at frame {lost.frame_count}" in lost.cause and len(calls) == 4
    assert calls[0] > calls[-1]
    for trial, scene in ((first, scenes[0]), (last, scenes[2])):
        (alone,) = simulate_scenes(simulator, [scene], 5)
        assert trial.cause is None
        np.testing.assert_allclose(trial.position_TN3, alone.position_TN3, atol=1e-6)


def report_row(system: str, error: float, ms: float | None, **more: Any) -> dict[str, Any]:
    one_step = None if system in ("mpm", "chaos") else error
    row = {"system": system, "one_step_mse": one_step, "one_step_quartiles": one_step and [0.5 * error, 2 * error]}
    row |= {"one_step_by_material": one_step and {"water": 2 * error}, "position_mse": {"50": error, "299": 2 * error}}
    row |= {"position_quartiles": {"50": [0.5 * error, 2 * error]}, "scenes_reached": {"50": 2, "299": 1}}
    row |= {"seeds": [1, 2], "failed_scenes": 1, "curve": [0.0, error, None], "penetration": 0.01, "sinkhorn": {}}
    row |= {"reference_penetration": 0.005, "ms": ms, "ms_batched": ms, "batch_scenes": 2}
    return (
        row | {"weights": f"{system}.safetensors", "levels": 3, "message_passing_steps": 4, "backend": "triton"} | more
    )


def report_rows() -> list[dict[str, Any]]:
    return [
        report_row("hgn", 1e-7, 0.5, precision="fp16"),
        report_row("hgn", 1e-7, 2.0, precision="fp32"),
        report_row("gns", 2e-7, 5.0, precision="fp16"),
        report_row("gns_particles", 1e3, 50.0, precision="fp16"),
        report_row("baseline", 1e-5, None, predictor="ballistic motion"),
        report_row("mpm", 0.5e-7, 100.0, grid=64, step=0.5, precision="fp32"),
        report_row("mpm", 1e-3, 20.0, grid=32, step=1.0, precision="fp32"),
        report_row("chaos", 1e-9, None, floor="twice the step"),
    ]


def test_paired_differences() -> None:
    """A constant difference is its own interval; noise about zero carries no word; a few scenes far off take the word
    from the mean and leave it to the median; scenes without a value of either do not count."""
    rng = np.random.default_rng(3)
    base = rng.uniform(1, 2, 60)
    lower = paired_difference(base - 0.5, base)
    assert lower is not None and lower["median"] == pytest.approx([-0.5] * 3) == lower["mean"]
    assert lower["median_says"] == lower["mean_says"] == "nearer"
    higher = paired_difference([*(base + 0.5), None, 9.0], [*base, 0.0, None])
    assert higher is not None and higher["mean_says"] == "farther" and higher["scenes"] == 60
    noise = paired_difference(base + rng.normal(0, 1, 60), base)
    assert noise is not None and noise["mean_says"] == noise["median_says"] == "no difference shown"
    _, low, high = noise["mean"]
    assert high - low == pytest.approx(2 * 1.96 / 60**0.5, rel=0.25)
    far = base - 0.1
    far[:2] += 20
    few = paired_difference(far, base)
    assert few is not None and (few["median_says"], few["mean_says"]) == ("nearer", "no difference shown")
    assert paired_difference([1.0], [2.0]) is None


def test_paired_rows_are_told() -> None:
    """A network stands beside GNS and each setting of the solver, in the errors and frames that both have of scenes."""
    rows = report_rows()
    for row, values in ((rows[0], [1.0, 2.0, 3.0]), (rows[2], [2.0, 3.0, 4.0]), (rows[5], [0.0, 2.0, 4.0])):
        row["by_scene"] = {"position MSE": {"50": values}}
    rows[0]["by_scene"]["one-step MSE"] = rows[2]["by_scene"]["one-step MSE"] = {"0": [1.0, 1.0]}
    made = paired_rows(rows)
    of_hgn = [(row["other"].split(",")[0], row["error"]) for row in made if row["one"].startswith("HGN")]
    assert of_hgn == [("GNS M = 4", "one-step MSE"), ("GNS M = 4", "position MSE"), ("MPM 64³", "position MSE")]
    told = "\n".join(paired_lines(made))
    assert "position MSE after 50 frames, 3 scenes: nearer in the median (-1.00e+00, -1.00e+00 to -1.00e+00)" in told
    assert "MPM 64³, step 0.5, position MSE after 50 frames, 3 scenes: no difference shown in the median" in told
    assert paired_lines([]) == []


def test_the_figures_show_what_diverged(tmp_path: Path) -> None:
    """Points beyond the panel, scenes that failed and a report without a single row are drawn too."""
    meta = {"versions": {"torch": "2", "taichi": "1"}, "commit": "c", "date": "2026-01-01", "command": "x " * 200}
    meta |= {"scenes": 2, "split": "test", "data": "d", "device": "a GPU", "reference": "the solver"}
    rows = report_rows()
    rows[2] |= {"position_mse": {"50": 1e-6}, "scenes_reached": {"50": 2, "299": 0}, "failed_scenes": 2}
    for some in (rows, []):
        for picture in (draw_pareto(some, meta), draw_pareto(some, meta, batched=True), draw_frames(some, meta)):
            with Image.open(io.BytesIO(picture)) as image:
                assert image.width > 500
