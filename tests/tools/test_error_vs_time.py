"""python -m tools.error_vs_time: its rows, its order and its failures; no assertion on any time."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from data.foreign_writers import metadata, write
from network.states import gns_of, network_of, random_grid

import datagen.mpm.solver
from datagen.mpm.solver import SceneFailure, Simulated
from hgn.data.foreign.dataset import import_set
from hgn.data.foreign.settings import ImportConfig
from hgn.data.reader import EpisodeStore
from hgn.runtime.weights import WeightsInfo, save_weights
from hgn.schema import ConfigError
from tools import timing
from tools.error_vs_time import plot, run, score
from tools.error_vs_time.command import fitting_weights, main, network_contenders
from tools.error_vs_time.contenders import FallingContender
from tools.error_vs_time.settings import ErrorVsTimeConfig
from tools.timing import Stopwatch

SHORT = {"split": "validation", "device": "cpu", "perturbation": 0.0}
CPU = torch.device("cpu")
RESULTS = Path(__file__).resolve().parents[2] / "results"


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Few frames and scenes."""
    for module, values in (
        (timing, {"SCENES": 1, "BATCHES": (2,), "FRAMES": 4, "SOLVER_FRAMES": 4}),
        (score, {"FRAME_STRIDE": 5, "BATCH_SCENES": 2}),
        (run, {"ROUNDS": 1}),
    ):
        for name, value in values.items():
            monkeypatch.setattr(module, name, value)


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


@pytest.fixture
def simulated(monkeypatch):
    """The stand-in for the solver: cells a unit, particles of the scenes, steps and frames of its calls."""
    calls: list[SimpleNamespace] = []

    def noted(scenes, config, frames, *more, stability_fractions, **others):
        cells, particles = round(1 / scenes[0].cell_size), [scene.particle_count for scene in scenes]
        steps = sorted(set(stability_fractions))
        calls.append(SimpleNamespace(cells=cells, particles=particles, steps=steps, frames=frames))
        return fake_simulate(scenes, config, frames, *more, stability_fractions=stability_fractions, **others)

    monkeypatch.setattr(datagen.mpm.solver, "simulate", noted)
    return calls


@pytest.fixture
def one_step(monkeypatch):
    """The solver is compared at one size of its step."""
    monkeypatch.setattr("tools.error_vs_time.command.STEPS", (0.5,))


def weights_file(path, kind):
    network = (network_of if kind == "hgn" else gns_of)(torch.float32, width=8)
    save_weights(path, network, WeightsInfo(network.config, 60.0, 1 / 64, updates=7))
    return path


@pytest.fixture
def both(tmp_path):
    """Weights of an HGN and of a GNS."""
    return [str(weights_file(tmp_path / f"{kind}.safetensors", kind)) for kind in ("hgn", "gns")]


@pytest.fixture
def data(small_dataset):
    return str(small_dataset)


@pytest.fixture
def compare(data, both, tmp_path):
    """Runs the command and returns its report; `code` is the expected exit code."""

    def compare(name="report", code=0, **options):
        out = tmp_path / name
        assert main(SHORT | {"data": data, "out": str(out), "weights": both, "mpm_grids": []} | options) == code
        return json.loads(Path(f"{out}.json").read_text())

    return compare


@pytest.fixture
def undrawn(monkeypatch):
    """Skips figures, which take most of the time."""
    monkeypatch.setattr("tools.error_vs_time.run.draw", lambda *_: [])


@pytest.fixture
def on_score(monkeypatch):
    """Calls a function with the row of each contender that is about to be scored."""

    def on_score(action):
        monkeypatch.setattr("tools.error_vs_time.run.score", lambda c, *more: action(c.row) or score.score(c, *more))

    return on_score


def systems(report):
    return [row["system"] for row in report["rows"]]


@pytest.mark.usefixtures("simulated")
def test_the_report(compare, tmp_path, monkeypatch, capsys):
    """Every contender gets a row with the report's keys on the same scenes; failed scenes are counted."""
    monkeypatch.setattr(timing, "SOLVER_FRAMES", 300)
    drawn: set[str] = set()
    monkeypatch.setattr(run, "draw", lambda out, *_: drawn.add(out))
    report = compare("results/report", mpm_grids=[32, 64], perturbation=1e-6)
    assert drawn == {str(tmp_path / "results/report")}
    assert {"device", "versions", "commit", "date", "command", "convention", "reference"} <= report["meta"].keys()
    rows = report["rows"]
    assert systems(report) == ["hgn", "gns", *["baseline"] * 4, *["mpm"] * 4, *["chaos"] * 2]
    keys = {"one_step_mse", "position_mse", "sinkhorn", "penetration", "ghost", "momentum_error", "seeds"}
    for row in rows:
        assert keys <= row.keys() and len(row["seeds"]) == 2
        falling = row.get("predictor") == "fall and stop at the floor"
        assert (row["one_step_mse"] is None) == (falling or row["system"] in ("mpm", "chaos"))
        assert ("ms" in row) == (row["system"] in ("hgn", "gns", "mpm"))
        for error, mean in (("position MSE", row["position_mse"]["5"]), ("one-step MSE", row["one_step_mse"])):
            for values in row["by_scene"].get(error, {}).values():
                assert np.mean([value for value in values if value is not None]) == pytest.approx(mean, rel=0.1)
    mpm = {(row["grid"], row["step"]): row for row in rows if row["system"] == "mpm"}
    assert mpm[64, 1.0]["failed_scenes"] == 1 and mpm[64, 1.0]["first_failure"] == "too fast"
    assert mpm[64, 1.0]["scenes_reached"] == {"5": 1} and mpm[64, 0.5]["scenes_reached"] == {"5": 2}
    assert 0 < mpm[64, 0.5]["position_mse"]["5"] < mpm[32, 0.5]["position_mse"]["5"]
    floor = {row["floor"]: row["position_mse"]["5"] for row in rows if row["system"] == "chaos"}
    assert 1e-13 < floor["perturbed by 1e-06"] < 3e-12
    assert floor["twice the step"] == pytest.approx(mpm[64, 0.5]["position_mse"]["5"])
    assert report["meta"]["set"]["drawn"] is None and len(report["meta"]["set"]["not_frozen_before"]) == 2
    assert report["meta"]["not_run"] == []
    assert rows[0]["by_scene"].keys() == {"one-step MSE", "position MSE", "Sinkhorn"} != rows[-1]["by_scene"].keys()
    assert {row["other"].split(",")[0] for row in report["paired"]} == {"GNS M = 3", "MPM 32³", "MPM 64³"}
    printed = capsys.readouterr().out
    names = ("HGN L = 3, M = 2", "GNS M = 3, torch fp32", "MPM 32³, step 1", "chaos floor", "95% interval")
    assert all(word in printed for name in names for word in name.split())
    assert max(len(line) for line in printed.splitlines() if line.startswith("|")) <= 100


def test_labels_of_the_figures_lie_side_by_side(monkeypatch):
    """No label of a panel reaches into the next one's, nor out of the figure."""
    report = json.loads((RESULTS / "error_vs_time" / "obstacles.json").read_text())
    figures: list[Any] = []
    monkeypatch.setattr("tools.error_vs_time.plot.as_png", lambda figure, dpi: figures.append(figure) or b"")
    plot.draw_pareto(report["rows"], report["meta"], batched=True)
    (figure,) = figures
    figure.draw_without_rendering()
    spans = [panel.xaxis.label.get_window_extent() for panel in figure.axes]
    edges = [0.0, *(edge for span in spans for edge in (span.x0, span.x1)), figure.bbox.width]
    assert len(spans) == 3 and edges == sorted(edges)


@pytest.mark.usefixtures("undrawn", "one_step")
def test_a_reference_of_a_finer_grid(make_config, make_dataset, compare, simulated):
    """Data of a finer grid is the reference, and is not simulated again on its own. Solvers on finer grids get the
    children of the visible particles, and are scored by the first ones; the floor is another draw of the reference.
    """
    folder = make_dataset(make_config(reference_cells=128))
    report = compare(data=str(folder), weights=[], mpm_grids=[48, 96], perturbation=1e-6)
    assert report["meta"]["reference"] == "the data: 128 cells a unit, 8 particles for each visible one"
    visible = [len(episode.material_N) for episode in EpisodeStore(folder, "validation")]
    particles = {call.cells: call.particles for call in simulated if len(call.particles) == len(visible)}
    assert particles == {48: visible, 96: [3 * count for count in visible], 128: [8 * count for count in visible]}
    assert systems(report) == [*["baseline"] * 4, "mpm", "mpm", "chaos"]
    assert all(row["failed_scenes"] == 0 and row["position_mse"]["5"] < 1e-3 for row in report["rows"][4:])


def test_fall_and_stop(data):
    """The baseline is exact in free flight, and stays where it meets a wall."""
    (episode,) = EpisodeStore(data, "test")
    contender = FallingContender(1 / 32)
    (free,) = contender.trials([episode], 6, None)
    assert np.abs(free.position_TN3 - episode.position_TN3).max() < 1e-6
    (long,) = contender.trials([episode], 200, None)
    assert (long.position_TN3[-1] == long.position_TN3[-2]).all()
    assert long.position_TN3.min() >= 1 / 32 - 1e-7 and long.position_TN3.max() <= 31 / 32 + 1e-7
    assert ((long.position_TN3[-1] < 1 / 32 + 1e-6) | (long.position_TN3[-1] > 31 / 32 - 1e-6)).any(axis=1).all()


@pytest.mark.usefixtures("undrawn", "one_step", "simulated")
def test_failures_are_named(compare, both, monkeypatch, on_score, capsys):
    """A contender that fails is named with the cause, and the others go on; an unexpected error is printed, and the
    exit code is 1."""
    monkeypatch.setattr(score, "SINKHORN_SCENES", 0)
    order: list[str] = []

    def noted(row):
        order.append(score.label(row).split(" (")[0])
        if "48" in order[-1]:
            raise ConfigError("grids of 48 are not liked")
        if order[-1] == "mean acceleration":
            raise RuntimeError("an illegal memory access")

    on_score(noted)
    options = {"weights": both[::-1], "perturbation": 1e-6, "mpm_grids": [48, 64]}
    report = compare(code=1, precisions=["tf32", "fp32", "fp16"], **options)
    assert order == [
        *["GNS M = 3, torch tf32", "GNS M = 3, torch fp32", "HGN L = 3, M = 2, cpu tf32", "HGN L = 3, M = 2, cpu fp32"],
        *["constant velocity", "ballistic motion", "mean acceleration", "fall and stop at the floor"],
        *["MPM 48³, step 0.5", "MPM 64³, step 0.5"],
        *["chaos floor: perturbed by 1e-06", "chaos floor: twice the step"],
    ]
    causes = [left["cause"] for left in report["meta"]["not_run"]]
    assert causes == ["RuntimeError: an illegal memory access", "grids of 48 are not liked"]
    assert report["meta"]["not_timed"] == ["MPM 64³, step 0.5"]  # its frames end together here
    printed = capsys.readouterr().err
    assert "left out: MPM 48³, step 0.5: grids of 48 are not liked" in printed
    assert "Traceback" in printed and "1 of the measurements failed" in printed
    assert all(f"left out: {name}.safetensors at fp16" in printed for name in ("hgn", "gns"))  # no backend here has it
    rows = report["rows"]
    assert [(row["system"], row["precision"]) for row in rows[:4]] == [
        (kind, precision) for kind in ("gns", "hgn") for precision in ("tf32", "fp32")
    ]
    assert all(row["ms"] > 0 and row["failed_scenes"] == 0 for row in rows[:4])


@pytest.mark.parametrize(("system", "frames"), [("mpm", 12), ("hgn", 8)])
def test_the_solver_is_timed_over_whole_rollouts(system, frames, monkeypatch):
    """The solver is timed over longer rollouts, because its frames are slowest when material has landed."""

    class Recorder:
        row, asked, stepped = {"system": system}, [0], True

        def trials(self, episodes, frames, on_frame):
            self.asked.append(frames)
            for frame in range(frames):
                on_frame(frame)

        def release(self):
            pass

    monkeypatch.setattr(timing, "FRAMES", 8)
    monkeypatch.setattr(timing, "SOLVER_FRAMES", 300)
    episode: Any = SimpleNamespace(material_N=np.zeros(3), position_TN3=np.zeros((12, 3, 3)))
    contender = Recorder()
    Stopwatch(contender, [episode], CPU).round()
    assert max(contender.asked) == frames


def test_shipped_weights_that_fit(data, tmp_path, monkeypatch, capsys):
    """By default all shipped weights that fit the data are compared; others are named."""
    (episode,) = EpisodeStore(data, "test")
    networks = {"a": network_of(levels=3), "b": gns_of(), "blind": network_of(obstacle_features=False)}
    networks |= {"slow": network_of(), "coarse": network_of(), "dry": network_of(materials=("snow",))}
    paths, grid = {name: tmp_path / f"{name}.safetensors" for name in networks}, random_grid(0, 10)
    for name, network in networks.items():
        cell_size = 1 / 32 if name == "coarse" else grid.cell_size
        save_weights(paths[name], network, WeightsInfo(network.config, 30.0 if name == "slow" else 60.0, cell_size))
    monkeypatch.setattr("tools.error_vs_time.command.shipped_weights", lambda: paths)
    water = replace(episode, material_N=np.zeros_like(episode.material_N), obstacle_grid=grid)
    assert [file.stem for file in fitting_weights([water])] == ["a", "b"]
    printed = capsys.readouterr().err
    assert all(f"shipped weights {name}:" in printed for name in ("blind", "slow", "coarse", "dry"))
    config = ErrorVsTimeConfig(data=data, out="x")
    found = {c.row["weights"]: c.row["levels"] for c in network_contenders(config, CPU, [water])}
    assert found == {"a.safetensors": 3, "b.safetensors": 1}


@pytest.mark.usefixtures("undrawn")
def test_a_killed_run_leaves_complete_rows(compare, tmp_path, monkeypatch, on_score):
    """After each contender the file contains its errors and its run times. Without a solver
    the data is the reference; ballistic motion has no error on ballistic data."""
    monkeypatch.delattr(datagen.mpm.solver, "simulate")

    def killed(row):
        if row.get("predictor") == "fall and stop at the floor":
            raise KeyboardInterrupt

    on_score(killed)
    with pytest.raises(KeyboardInterrupt):
        compare(resimulate=False)
    rows = {
        row.get("predictor", row["system"]): row for row in json.loads((tmp_path / "report.json").read_text())["rows"]
    }
    assert rows["hgn"]["one_step_mse"] > 0 and rows["hgn"]["position_mse"]["5"] > 0
    assert rows["hgn"]["ms"] > 0
    falls, flies = rows["ballistic motion"], rows["constant velocity"]
    assert falls["position_mse"]["5"] < 1e-13 < flies["position_mse"]["5"]
    assert falls["one_step_mse"] < 1e-13 < flies["one_step_mse"]


def test_weights_that_do_not_fit(compare, tmp_path, monkeypatch):
    """An unknown name, a missing file and weights for other data are refused before anything is simulated."""
    monkeypatch.delattr(datagen.mpm.solver, "simulate")
    dry = network_of(torch.float32, materials=("snow",))
    for name, change in (("dry", {}), ("slow", {"frame_rate_hz": 30.0}), ("moon", {"gravity": (0.0, -1.6, 0.0)})):
        network = dry if name == "dry" else network_of(torch.float32)
        values = {"frame_rate_hz": 60.0, "obstacle_cell_size": 1 / 64} | change
        save_weights(tmp_path / f"{name}.safetensors", network, WeightsInfo(network.config, **values))
    for name, message in (
        ("obstacle", r"weights\[0\] must be a file or the name of shipped weights \(.*obstacles.*\), got 'obstacle'"),
        (str(tmp_path / "none.safetensors"), r"weights\[0\] must be an existing file, got .*none"),
        (str(tmp_path / "dry.safetensors"), r"weights\[0\] must fit the data, got .*dry.*: .*snow.*use other weights"),
        (str(tmp_path / "slow.safetensors"), "frame_rate_hz must be the weights' 30.0, got 60"),
        (str(tmp_path / "moon.safetensors"), "gravity must be the weights'"),
    ):
        with pytest.raises(ConfigError, match=message):
            compare(weights=[name])


def test_imported_sets_are_refused(compare, tmp_path):
    """An imported set has no solver that could simulate it again; the message names the command that measures it."""
    path = np.full((9, 4, 3), 0.5, np.float32)
    scenes = [(path, np.full(4, 5), np.zeros((0, 3), np.float32))]
    source = write(tmp_path / "foreign", "plain", {"train": scenes, "valid": scenes}, metadata())
    import_set(source, ImportConfig(out=str(tmp_path / "mine"), materials={"5": "water"}, gravity=(0.0, -9.8, 0.0)))
    with pytest.raises(ConfigError, match=r"data must be a set of python -m datagen, .*mine.*; .*hgn.evaluate"):
        compare(data=str(tmp_path / "mine"))
