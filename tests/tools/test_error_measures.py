"""Measures, paired intervals and figures of tools.error_vs_time, against closed forms."""

import io
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from network.states import gns_of, network_of
from PIL import Image

from hgn.data.batch import make_batch
from hgn.data.reader import EpisodeStore
from hgn.evaluate import EvaluateConfig, one_step_rows, table
from hgn.runtime.backend import build
from hgn.runtime.rollouts import RolloutResult, simulate_scenes
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.distance import fraction_inside, outside_domain
from hgn.scene.motion import Motion
from hgn.scene.shapes import shape_obstacle
from hgn.training.errors import ballistic, frame_batches, one_step_errors
from tools.error_vs_time import plot, score
from tools.error_vs_time.contenders import BaselineContender, triton_acceleration
from tools.error_vs_time.paired import paired_difference, paired_rows, paired_table
from tools.error_vs_time.plot import draw_frames, draw_pareto
from tools.error_vs_time.run import draw
from tools.error_vs_time.sinkhorn import sinkhorn_divergences
from tools.measures import energies, energy_scale, momentum_error
from tools.timing import FrameClock

CPU = torch.device("cpu")


@pytest.fixture
def episode(small_dataset):
    (episode,) = EpisodeStore(small_dataset, "test")
    return episode


@pytest.fixture
def episodes(small_dataset):
    return list(EpisodeStore(small_dataset, "validation"))


def some_of(episode, particles):
    """The episode with some of its particles."""
    changed = {name: getattr(episode, name)[particles] for name in ("initial_velocity_N3", "material_N")}
    key = f"some-{particles.start}"
    return replace(episode, key=key, position_TN3=np.array(episode.position_TN3[:, particles]), **changed)


def test_baseline_errors_are_those_of_training(episode):
    """One-step errors agree with what training measures, at every frame."""
    gravity = BaselineContender("fall", lambda e: 0.9 * np.asarray(e.gravity) / e.frame_rate_hz**2, CPU)
    network = network_of(torch.float32, obstacle_features=False)
    batches = frame_batches([episode], network, 1, 100)
    expected = one_step_errors({"fall": lambda b: 0.9 * ballistic(b)}, batches, CPU, network.config.materials)
    assert gravity.one_step(episode, 1).error.mse == pytest.approx(expected["fall"].mse, rel=1e-5)


def test_one_step_errors_by_kind_of_scene(episodes, episode, capsys):
    """Kinds have the errors of their episodes alone, and fractions of the whole error that sum to 1; data without
    kinds have no such figures."""
    network = network_of(torch.float32, obstacle_features=False)
    backend, config = build("torch", network, "fp32"), EvaluateConfig(data="data")
    of = lambda kind, e: replace(e, specification=e.specification | {"layout": kind})  # noqa: E731
    assert len(episodes) == 2
    mixed = [of("pool", episodes[0]), of("jet", episode), of("pool", episodes[1])]
    whole = {row["system"]: row for row in one_step_rows(backend, [*episodes, episode], config)}
    rows = {row["system"]: row for row in one_step_rows(backend, mixed, config)}
    jet, pools = (one_step_rows(backend, e, config)[0]["one_step_mse"] for e in ([episode], episodes))
    kinds = rows["network"]["by_kind"]
    assert kinds["jet"]["one_step_mse"] == pytest.approx(jet, rel=1e-5)
    assert kinds["pool"]["one_step_mse"] == pytest.approx(pools, rel=1e-5)
    assert sum(kind["fraction"] for kind in kinds.values()) == pytest.approx(1)
    size = lambda e: e.particle_count * (len(e.position_TN3) - 1)  # noqa: E731
    ratio = jet * size(episode) / (pools * sum(map(size, episodes)))
    assert kinds["jet"]["fraction"] / kinds["pool"]["fraction"] == pytest.approx(ratio, rel=1e-5)
    for name, row in rows.items():
        assert row["one_step_mse"] == pytest.approx(whole[name]["one_step_mse"], rel=1e-5)
        assert row["by_material"] == pytest.approx(whole[name]["by_material"], rel=1e-5)
    assert "by_kind" not in whole["network"] and "by_kind" not in rows["ballistic motion"]
    assert "pool" in table(list(rows.values()), config, 3) and "pool" not in table(list(whole.values()), config, 3)


def test_one_step_errors_of_triton(episode):
    """One-step errors of backend triton are computed by its kernels, for several frames together. In float32 they equal
    those of the plain network, whatever its walls constrain. Captured programs are used again for further frames, and
    for fewer particles."""
    more, fewer = some_of(episode, slice(0, 12)), some_of(episode, slice(1, 12))
    network = network_of(torch.float32, width=16, levels=1, message_passing_steps=1, wall_clearance=(0.5, 0.5))
    backend, made = build("triton", network, "fp32"), []
    with torch.inference_mode():
        for samples in ([(more, 0), (more, 2)], [(fewer, 1), (fewer, 3)], [(more, 3)]):
            batch = make_batch(samples, network.config)
            found_N3 = triton_acceleration(backend, batch)
            torch.testing.assert_close(found_N3, network(batch.state()), rtol=1e-4, atol=1e-8)
            made.append(backend.idle[len(samples)])
    assert made[0] is made[1] is not made[2]


def test_ghost_acceleration_counts_particles_at_rest(episode):
    """Only particles that have not moved count, each with the length of what is predicted for it."""
    position_TN3 = np.repeat(np.array(episode.position_TN3[:1]), 9, axis=0)
    position_TN3[:, 0] += np.arange(9, dtype=np.float32)[:, None] * 0.01
    still_N3 = np.zeros_like(episode.initial_velocity_N3)
    still = replace(episode, position_TN3=position_TN3, initial_velocity_N3=still_N3, gravity=(0.0, 0.0, 0.0))
    step = BaselineContender("push", lambda e: np.array([3e-3, 0.0, 4e-3]), CPU).one_step(still, 1)
    assert step.rest_count == 8 * (position_TN3.shape[1] - 1)
    assert score.one_step_figures([step])["ghost"] == pytest.approx(5e-3, rel=1e-5)


def test_sinkhorn_against_closed_forms():
    """Zero for a permuted cloud, the square of the shift for a shifted one, NaN where a position is not finite."""

    def sinkhorn_divergence(first, second, blur=0.01):
        return sinkhorn_divergences([(first, second)], blur)[0]

    generator = torch.Generator().manual_seed(0)
    cloud = torch.rand(120, 3, generator=generator)
    shift = torch.tensor([0.1, -0.05, 0.2])
    assert abs(sinkhorn_divergence(cloud, cloud.flip(0))) < 1e-9
    assert sinkhorn_divergence(cloud, cloud + shift) == pytest.approx(float(shift.square().sum()), rel=1e-4)
    assert sinkhorn_divergence(cloud, cloud + 0.01 * shift) == pytest.approx(5.25e-6, rel=1e-3)
    apart = float((cloud[0] - cloud[1]).square().sum())
    assert sinkhorn_divergence(cloud[:1], cloud[1:2]) == pytest.approx(apart, rel=1e-5)
    others = [(cloud[:50], cloud[50:100] + shift), (cloud[:50], cloud[:50]), (cloud[:3], cloud[3:6])]
    more = [(cloud[:50] * 0.1, cloud[50:100]), (cloud[:50] * math.nan, cloud[:50])]
    together = sinkhorn_divergences([*others, *more], 0.05)
    assert together[:3] == pytest.approx([sinkhorn_divergence(*pair, 0.05) for pair in others], rel=1e-4, abs=1e-9)
    assert together[3] > 0 and math.isnan(together[4])
    cloud[3, 0] = math.nan
    assert math.isnan(sinkhorn_divergence(cloud, cloud))


def test_momentum_and_energy_against_closed_forms():
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


def test_shares_inside_obstacles_and_outside_of_the_domain():
    """Closed bodies hold what is within them, sheets nothing; the domain ends at its planes."""
    cone = shape_obstacle("cone", 0.4, (0.5, 0.5, 0.5), np.eye(3), "cone")
    square = shape_obstacle("square", 0.4, (0.5, 0.5, 0.5), np.eye(3), "square")
    point = np.array([[0.5, 0.5, 0.5], [0.9, 0.9, 0.9], [1.1, 0.5, 0.5], [0.5, -0.1, 0.5]])
    assert fraction_inside(point, [cone], 0.0) == 0.25 and fraction_inside(point, [square], 0.0) == 0
    away = replace(cone, motion=Motion.of_frames([(0.0, (0, 0, 0)), (2.0, (0.8, 0, 0))], (0.5, 0.5, 0.5)))
    assert [fraction_inside(point, [away], time) for time in (0.0, 0.8, 1.5)] == [0.25, 0.0, 0.25]
    assert outside_domain(point, (1.0, 1.0, 1.0)) == 0.5 and outside_domain(point[:0], (1.0, 1.0, 1.0)) == 0


def test_frames_that_end_together():
    """The clock measures from the end of the first group of frames. With a single group it returns no time."""
    clock = FrameClock()
    clock.ends = [1.0, 1.000001, 1.000002, 1.3, 1.300001, 1.300002]
    assert clock.milliseconds() == pytest.approx(100, rel=1e-3)
    clock.ends = [1.0, 1.1, 1.2]
    assert clock.milliseconds() == pytest.approx(100)
    clock.ends = [1.0, 1.000001]
    assert clock.milliseconds() is None


def test_failed_scenes_are_left_out_of_means(episodes):
    """Errors at a frame are means over the scenes that reached it, and say over how many."""
    paths = [np.array(episode.position_TN3) for episode in episodes]
    trials = [RolloutResult(paths[0] + np.float32(0.1)), RolloutResult(paths[1][:3] + np.float32(0.2), "why")]
    row = score.rollout_figures(trials, episodes, CPU)
    np.testing.assert_allclose(row["curve"], [*[0.075] * 3, *[0.03] * 3], rtol=1e-4)
    assert row["by_scene"]["position MSE"]["5"] == [pytest.approx(0.03, rel=1e-3), None]
    assert row["by_scene"]["Sinkhorn"]["5"][1] is None
    assert row["scenes_reached"] == {"5": 1} and row["first_failure_frame"] == 3 and row["first_failure"] == "why"


@pytest.mark.parametrize("network_of_kind", [network_of, gns_of])
def test_a_diverging_scene_does_not_change_others(episodes, network_of_kind):
    """Off backend triton scenes are simulated once, and one that diverges ends alone: it is kept as far as it came,
    with the cause, and the others are as if it had never been there."""
    scenes = [InitialState.of_episode(episode) for episode in (*episodes, episodes[0])]
    scenes[1] = replace(scenes[1], velocity_N3=scenes[1].velocity_N3 + np.float32(60.0))
    simulator, calls = Simulator(network_of_kind(torch.float32), 60.0), []
    predict = simulator.backend.predict
    simulator.backend.predict = lambda state: calls.append(len(state.position_N3)) or predict(state)
    first, lost, last = simulate_scenes(simulator, scenes, 5)
    assert lost.cause is not None and f"diverged at frame {lost.frame_count}" in lost.cause and len(calls) == 4
    assert calls[0] > calls[-1] and np.isfinite(lost.position_TN3).all()
    for trial, scene in ((first, scenes[0]), (last, scenes[2])):
        (alone,) = simulate_scenes(simulator, [scene], 5)
        assert trial.cause is None and trial.frame_count == 5
        np.testing.assert_allclose(trial.position_TN3, alone.position_TN3, atol=1e-6)
    assert simulate_scenes(simulator, [], 5) == []


def report_row(system, error, ms, **more):
    one_step = None if system in ("mpm", "chaos") else error
    row = {"system": system, "one_step_mse": one_step, "one_step_quartiles": one_step and [0.5 * error, 2 * error]}
    row |= {"one_step_by_material": one_step and {"water": 2 * error}, "position_mse": {"50": error, "299": 2 * error}}
    row |= {"position_quartiles": {"50": [0.5 * error, 2 * error]}, "scenes_reached": {"50": 2, "299": 1}}
    row |= {"seeds": [1, 2], "failed_scenes": 1, "curve": [0.0, error, None], "penetration": 0.01, "sinkhorn": {}}
    row |= {"reference_penetration": 0.005, "ms": ms, "ms_batched": ms, "batch_scenes": 2, "backend": "triton"}
    return row | {"weights": f"{system}.safetensors", "levels": 3, "message_passing_steps": 4} | more


def report_rows():
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


def test_paired_differences():
    """A constant difference is its own interval; noise about zero carries no word; a few scenes far off take the word
    from the mean and leave it to the median; scenes without a value of either do not count."""
    rng = np.random.default_rng(3)
    base = rng.uniform(1, 2, 60)
    lower = paired_difference(base - 0.5, base)
    assert lower is not None and lower["median"] == pytest.approx([-0.5] * 3) == lower["mean"]
    assert lower["median_says"] == lower["mean_says"] == "nearer"
    higher = paired_difference([*(base + 0.5), None, 9.0], [*base, 0.0, None])
    assert higher is not None and higher["mean_says"] == "farther" and higher["scenes"] == 60
    other = base + rng.normal(0, 1, 60)
    noise = paired_difference(other, base)
    assert noise is not None and noise["mean_says"] == noise["median_says"] == "no difference shown"
    _, low, high = noise["mean"]
    error = float(np.std(other - base)) / 60**0.5
    assert [low, high] == pytest.approx(np.mean(other - base) + 1.96 * error * np.array([-1, 1]), abs=0.08 * error)
    far = base - 0.1
    far[:2] += 20
    few = paired_difference(far, base)
    assert few is not None and (few["median_says"], few["mean_says"]) == ("nearer", "no difference shown")
    assert paired_difference([1.0], [2.0]) is None


def test_paired_rows():
    """A network stands beside GNS, each setting of the solver and other weights at its precision, in the errors and
    frames that both have of scenes.
    """
    rows = report_rows()
    other = rows[0] | {"weights": "other.safetensors", "by_scene": {"position MSE": {"50": [1.5, 2.5, 3.5]}}}
    for row, values in ((rows[0], [1.0, 2.0, 3.0]), (rows[2], [2.0, 3.0, 4.0]), (rows[5], [0.0, 2.0, 4.0])):
        row["by_scene"] = {"position MSE": {"50": values}}
    rows[0]["by_scene"]["one-step MSE"] = rows[2]["by_scene"]["one-step MSE"] = {"0": [1.0, 1.0]}
    made = paired_rows(rows)
    of_hgn = [(row["other"].split(",")[0], row["error"]) for row in made if row["one"].startswith("HGN")]
    assert of_hgn == [("GNS M = 4", "one-step MSE"), ("GNS M = 4", "position MSE"), ("MPM 64³", "position MSE")]
    beside = paired_rows([*rows, other, other | {"precision": "another"}])
    assert [(row["error"], row["mean"][0]) for row in beside if "(other" in row["other"]] == [("position MSE", -0.5)]
    told = paired_table(made).splitlines()
    assert max(map(len, told)) <= 100
    assert {row["mean_says"] for row in made} == {"nearer", "no difference shown"}
    assert "nearer" not in "".join(told) and any("-1 (-1 to" in line and "GNS" in line for line in told)


def test_networks_of_a_figure_differ_in_colour():
    """Those of older reports too, which have systems that this version no longer measures."""
    report = Path(__file__).resolve().parents[2] / "results" / "error_vs_time" / "chosen.json"
    rows = [row for row in json.loads(report.read_text())["rows"] if "precision" in row and row["system"] != "mpm"]
    styles = plot._styles([row for row in rows if row["system"] not in plot.UNTIMED])
    assert len(styles) > 4 and len({style["color"] for style in styles.values()}) == len(styles)


def test_the_figures_show_what_diverged(tmp_path):
    """Points beyond the panel, scenes that failed and a report without a single row are drawn too."""
    meta = {"versions": {"torch": "2", "taichi": "1"}, "commit": "c", "date": "2026-01-01", "command": "x " * 200}
    meta |= {"scenes": 2, "split": "test", "data": "d", "device": "a GPU", "reference": "the solver"}
    rows = report_rows()
    rows[2] |= {"position_mse": {"50": 1e-6}, "scenes_reached": {"50": 2, "299": 0}, "failed_scenes": 2}
    names = draw(str(tmp_path / "report"), rows, meta)
    assert [Path(name).name for name in names] == ["report.png", "report_batched.png", "report_frames.png"]
    empty = (draw_pareto([], meta, batched=True), draw_frames([], meta))
    for picture in (*(Path(name).read_bytes() for name in names), *empty):
        with Image.open(io.BytesIO(picture)) as image:
            assert image.width > 500
