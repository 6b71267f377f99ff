"""The solver's promises about steps, batches, failures and bad input; test_closed_forms has its physics."""

import contextlib
import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
import shared_kernels
from mpm_scenes import CELL, CONFIG, assert_inside, block, joined, particles, sheet, simulated
from scene.test_episode import members_of

from datagen.mpm import launch
from datagen.mpm.device import initialise
from datagen.mpm.solver import SceneFailure, particle_bounds, simulate
from datagen.pool.plan import SceneTask
from datagen.pool.worker import Backend, make_episode, make_scene, simulate_batch
from hgn.config import DatagenConfig, DatasetConfig, MpmConfig, SceneConfig
from hgn.scene.episode import decode_episode
from hgn.scene.material import MATERIALS, SAND, SNOW, WATER
from hgn.schema import ConfigError

ADAPTIVE = CONFIG
FIXED = MpmConfig(device="cpu", fixed_time_step_s=0.02 / 64)
FOUR = particles([[x, 0.5, 0.5] for x in (0.3, 0.45, 0.6, 0.75)], range(4))  # one of each material


def run(scene, config, frames):
    (outcome,) = simulated([scene], config, frames)
    return outcome


def test_adaptive_steps_fill_the_frame():
    """Taichi Elements' scheme is ahead of g t² / 2 by g t / 2 times the interval between transfers."""
    config = MpmConfig(device="cpu", method="taichi_elements")
    outcome = run(block(SNOW, (0.4, 0.7, 0.4), (0.5, 0.8, 0.5), count=200), config, 11)
    time = 10 / 60
    fall = (outcome.position_TN3[-1] - outcome.position_TN3[0])[:, 1].mean()
    interval = time / outcome.counters["transfers"]
    assert -9.8 * time * (time / 2 + 0.55 * interval) < fall < -9.8 * time * (time / 2 + 0.45 * interval)
    assert outcome.counters["substeps"] >= time / (config.stability_fraction * CELL * (1000 / 1_666_667) ** 0.5)


def test_impact_at_ten_metres_per_second():
    """The adaptive step withstands an impact on the floor at 10 m/s, of a block and of a single particle of each
    material: nothing is more than 15 % faster than with an eighth of the step.
    """
    scenes = [
        block(material, (0.4, 0.3, 0.4), (0.6, 0.45, 0.6), (0, -10, 0), count=count)
        for material in range(len(MATERIALS))
        for count in (1, 0)
    ]
    finer = dataclasses.replace(ADAPTIVE, stability_fraction=ADAPTIVE.stability_fraction / 8)
    for outcome, exact in zip(*(simulated(scenes, config, 5) for config in (ADAPTIVE, finer)), strict=True):
        assert_inside(outcome.position_TN3, scenes[0])
        assert outcome.counters["position_clamps"] == 0
        assert outcome.counters["largest_speed"] < 1.15 * exact.counters["largest_speed"]


def test_many_particles_in_one_cell():
    """A frame with 100,000 particles in a cell ends with finite positions, and no particle is lost."""
    scene = block(WATER, [8 * CELL] * 3, [9 * CELL] * 3, count=100_000)
    (outcome,) = simulated([scene], MpmConfig(device="cpu", stability_fraction=1.0))
    assert np.isfinite(outcome.position_TN3[-1]).all()
    fall = (outcome.position_TN3[-1] - outcome.position_TN3[0])[:, 1].mean()
    # eight steps of a symplectic scheme fall further by an eighth
    assert fall == pytest.approx(-9.8 / 60**2 / 2, rel=0.15)


def test_materials_a_thousand_times_as_stiff_beside_each_other():
    """Particles may differ in stiffness and density by 1000:1 and 3:1: an impact stays finite, inside and bounded."""
    scene = block(SNOW, (0.4, 0.25, 0.4), (0.6, 0.4, 0.6), (0, -3, 0))
    hard = scene.position_N3[:, 0] > 0.5
    parameters = {
        "youngs_modulus_pa": np.where(hard, np.float32(1e8), np.float32(1e5)),
        "density_kg_m3": np.where(hard, np.float32(3000), np.float32(np.nan)),
    }
    soft = block(SNOW, (0.4, 0.25, 0.4), (0.6, 0.4, 0.6), (0, -3, 0))
    outcome = run(dataclasses.replace(scene, material_parameters=parameters), ADAPTIVE, 4)
    assert np.isfinite(outcome.position_TN3).all() and outcome.counters["largest_speed"] < 10
    assert outcome.counters["substeps"] > 2 * run(soft, ADAPTIVE, 4).counters["substeps"]
    with pytest.raises(ConfigError, match="youngs_modulus_pa"):
        bad = {"youngs_modulus_pa": np.full(scene.particle_count, -1, np.float32)}
        simulate([dataclasses.replace(scene, material_parameters=bad)], ADAPTIVE, 2, 60.0)


def test_scenes_of_a_batch_equal_scenes_alone():
    """A scene's trajectory is bitwise the same alone and in a batch with scenes of other size, material, obstacles,
    domain and steps. For water this also holds with a kernel for water only, on two threads. In its small domain it
    reaches the far wall."""
    water = block(WATER, (0.4, 0.2, 0.4), (0.5, 0.3, 0.5), (4, -3, 0))
    water = dataclasses.replace(water, domain_size=(14 * CELL, 26 * CELL, 20 * CELL))
    snow = block(SNOW, (0.4, 0.45, 0.4), (0.55, 0.6, 0.5), (0, -4, 0), seed=1, obstacles=(sheet(0.3),))
    scenes = [water, snow, joined(block(SAND, (0.3, 0.2, 0.3), (0.4, 0.3, 0.4)), water)]
    steps = (0.5, 1.0, 0.25)
    together = simulate(scenes, ADAPTIVE, 7, 60.0, stability_fractions=steps)
    for own_kernel, index in ((False, 0), (False, 1), (False, 2), (True, 0)):
        config = dataclasses.replace(ADAPTIVE, stability_fraction=steps[index])
        with shared_kernels.kernels_of_their_own() if own_kernel else contextlib.nullcontext():
            (alone,) = simulate([scenes[index]], config, 7, 60.0)
        assert np.array_equal(alone.position_TN3, together[index].position_TN3)
        assert alone.counters == together[index].counters
    assert 0.65 < together[0].position_TN3[..., 0].max() < 11 * CELL


@pytest.mark.parametrize(
    ("config", "velocity", "cause"),
    [
        (FIXED, (0, 1e25, 0), "frame 1: a particle's position, velocity or velocity gradient is no longer finite"),
        (FIXED, (0, 3000, 0), "frame 1: a particle left the domain"),
        (ADAPTIVE, (0, 20, 0), "frame 1: the frame needs more than 30 substeps"),
    ],
    ids=["not finite", "left", "substeps"],
)
def test_a_bad_scene_leaves_its_batch_alone(config, velocity, cause, monkeypatch):
    """A scene that blows up is reported with frame and rule; its batch mates keep every bit."""
    if "substeps" in cause:
        monkeypatch.setattr(launch, "MAXIMUM_SUBSTEPS", 30)
    good = block(WATER, (0.4, 0.2, 0.4), (0.5, 0.3, 0.5), (1, -1, 0))
    bad = block(SNOW, (0.4, 0.4, 0.4), (0.5, 0.5, 0.5), velocity)
    first, failed, last = simulate([good, bad, good], config, 5, 60.0)
    assert isinstance(failed, SceneFailure)
    assert cause in failed.cause
    alone = run(good, config, 5)
    for outcome in (first, last):
        assert np.array_equal(outcome.position_TN3, alone.position_TN3)
        assert outcome.counters == alone.counters


def test_few_particles():
    """One particle, two on one spot, particles on cell faces and corners: finite, and frame 0 is the input."""
    spots = [
        [[0.5, 0.5, 0.5]],
        [[0.4, 0.3, 0.4]] * 2,
        [[4 * CELL, 5 * CELL, 6 * CELL], [4.5 * CELL, 5 * CELL, 6.5 * CELL], [4.5 * CELL, 4.5 * CELL, 4.5 * CELL]],
        [np.full(3, 3 * CELL), np.full(3, 13 * CELL)],
    ]
    scenes = [particles(spot, material) for spot in spots for material in range(len(MATERIALS))]
    for scene, outcome in zip(scenes, simulated(scenes, ADAPTIVE, 20), strict=True):
        assert outcome.position_TN3.dtype == np.float32
        assert np.array_equal(outcome.position_TN3[0], scene.position_N3)
        assert np.isfinite(outcome.position_TN3).all()


def test_bounds_themselves_are_inside():
    """Particles exactly on the bounds start, and stay within them."""
    for wall_cells in (2, 3, 5):
        config = MpmConfig(device="cpu", wall_cells=wall_cells)
        low, high = particle_bounds(block(WATER, (0.4, 0.4, 0.4), (0.5, 0.5, 0.5), count=1), config)
        scene = particles([low, high, [low[0], high[1], low[2]]], WATER, (2, 2, 2))
        assert_inside(simulated([scene], config, 5)[0].position_TN3, scene, config)


def test_particles_start_where_networks_stop_them():
    """1.5 or 2.5 cells from a plane, a rounding outside of the bounds, as in scenes that hgn.play saves."""
    scene = particles([[1.5 * CELL] * 3, [1 - 2.5 * CELL] * 3], WATER, (2, 2, 2))
    (outcome,) = simulated([scene], ADAPTIVE, 5)
    assert np.abs(outcome.position_TN3[0] - scene.position_N3).max() < 2e-6
    assert_inside(outcome.position_TN3, scene)
    with pytest.raises(ConfigError, match="must lie within the walls"):
        simulated([particles([[1.499 * CELL] * 3], WATER, (2, 2, 2))], ADAPTIVE, 5)


def test_a_domain_that_is_no_cube():
    """Sides of 1, 0.75 and 1.375 with nodes that are no multiple of the block size: material spreads to each wall."""
    scene = block(WATER, (0.3, 0.2, 0.3), (0.6, 0.5, 0.6), (3, 0, 4), domain_size=(1.0, 0.75, 1.375))
    position = run(scene, ADAPTIVE, 25).position_TN3
    assert_inside(position, scene)
    _, high = particle_bounds(scene, ADAPTIVE)
    assert (position.max(axis=(0, 1))[[0, 2]] > high[[0, 2]] - 2 * CELL).all()


def test_nothing_to_simulate():
    """No scenes give no results; scenes without particles give empty trajectories, also beside others; one frame is the
    initial state, without a step. Each frame is told once."""
    nothing = particles([])
    frames: list[int] = []
    assert simulate([], ADAPTIVE, 4, 60.0) == []
    (alone,) = simulate([nothing], ADAPTIVE, 4, 60.0, frames.append)
    assert alone.position_TN3.shape == (4, 0, 3) and alone.counters["substeps"] == 0
    _, other, _ = simulate([nothing, FOUR, nothing], ADAPTIVE, 3, 60.0, frames.append)
    assert other.position_TN3.shape == (3, 4, 3)
    (outcome,) = simulate([FOUR], ADAPTIVE, 1, 60.0, frames.append)
    assert np.array_equal(outcome.position_TN3, FOUR.position_N3[None])
    assert frames == [0, 1, 2, 3, 0, 1, 2, 0]


GOOD = block(WATER, (0.4, 0.4, 0.4), (0.5, 0.5, 0.5), count=4)


def spoiled(**values):
    """GOOD with values that were written into its arrays behind its check."""
    scene = dataclasses.replace(GOOD, **{name: getattr(GOOD, name).copy() for name in values})
    for name, value in values.items():
        getattr(scene, name)[1, 2] = value
    return scene


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (lambda: dataclasses.replace(GOOD, cell_size=1 / 64), {}, "cell_size must be the same in all scenes"),
        (lambda: dataclasses.replace(GOOD, position_N3=GOOD.position_N3 + 0.8), {}, "scene 1 .* walls.*move the part"),
        (lambda: dataclasses.replace(GOOD, position_N3=GOOD.position_N3 - 1000), {}, "position_N3 of scene 1 .* walls"),
        (lambda: dataclasses.replace(GOOD, gravity=(0, np.nan, 0)), {}, "gravity must be three numbers"),
        (lambda: dataclasses.replace(GOOD, gravity=(0, np.inf, 0)), {}, "gravity must be three numbers"),
        (lambda: dataclasses.replace(spoiled(velocity_N3=np.inf)), {}, "velocity_N3 must be finite.*particle 1"),
        (lambda: dataclasses.replace(spoiled(position_N3=np.inf)), {}, "position_N3 must be finite.*particle 1"),
        (lambda: GOOD, {"scenes": [dataclasses.replace(GOOD, cell_size=0.06)]}, "domain_size"),
        (lambda: GOOD, {"scenes": [dataclasses.replace(GOOD, cell_size=0.25)]}, "domain_size"),
        (lambda: GOOD, {"frames": 0}, "frames must be at least 1"),
        (lambda: GOOD, {"frame_rate_hz": np.nan}, "frame_rate_hz must be"),
        (lambda: GOOD, {"stability_fractions": (1.0, 0.0)}, r"stability_fractions\[1\] must be above 0"),
    ],
)
def test_bad_input_is_refused(make, options, message):
    """Scenes outside the walls, of other grids, not finite, of no whole number of cells, too small for the walls, or no
    frames: an error that names the field."""
    with pytest.raises(ConfigError, match=message):
        simulate(**{"scenes": [GOOD, make()], "config": ADAPTIVE, "frames": 2, "frame_rate_hz": 60.0} | options)


def test_memory_is_given_back():
    """25 simulations leave the process within 20 MB of its size; each holds a grid of 2 MB and more."""

    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    scenes = [FOUR] * 16
    for _ in range(5):
        simulate(scenes, ADAPTIVE, 1, 60.0)
    before = resident()
    for _ in range(25):
        simulate(scenes, ADAPTIVE, 1, 60.0)
    assert resident() - before < 20e6


def test_one_runtime_a_process():
    """A second start with other threads or device is refused; the same, or auto, is not."""
    assert initialise("auto").kind == "cpu"
    assert initialise("cpu", 2).threads == 2
    with pytest.raises(ConfigError, match="cpu_threads"):
        initialise("cpu", 1)
    with pytest.raises(ConfigError, match="device"):
        initialise("cuda")


def test_the_far_end_of_a_long_domain():
    """Water 1,000 cells from the origin splashes as it does near it, but for the rounding of its coordinates."""
    place = np.random.default_rng(0).uniform(0, 2, (64, 3)) + np.array([8, 3, 4])
    ends = []
    for shift in (0, 1000):
        away = np.array([shift, 0, 0])
        domain = (1020 * CELL, 10 * CELL, 10 * CELL)
        scene = particles((place + away) * CELL, WATER, (0, -2, 0), domain_size=domain)
        (outcome,) = simulated([scene], frames=4)
        ends.append(outcome.position_TN3.astype(float) - away * CELL)
    assert np.abs(ends[1] - ends[0]).max() < 0.01 * CELL


def test_several_cells_a_substep():
    """At 1,000 m/s the adaptive step crosses 0.3 cells at most; a fixed one of five cells stops the scene or leaves all
    particles inside, never out of range.
    """
    place = np.random.default_rng(1).uniform(0, 2, (64, 3)) * CELL + 0.45
    scenes = [particles(place, material, (300, -950, 0)) for material in (WATER, SAND, SNOW)]
    for outcome in simulated(scenes, rate_hz=960.0):
        assert_inside(outcome.position_TN3, scenes[0])
        assert outcome.counters["smallest_time_step_s"] <= 0.3 * CELL / 990
    scenes += [particles(place, material, (0, 1000, 0)) for material in (WATER, SAND, SNOW)]
    for fast in simulate(scenes, FIXED, 3, 60.0):
        if isinstance(fast, SceneFailure):
            assert fast.cause.startswith("frame ")
        else:
            assert_inside(fast.position_TN3, scenes[0])


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (4.0, 3.0, -12.0)])
def test_an_episode_keeps_its_scenes_gravity(gravity):
    """A random scene in motion becomes an episode that says its gravity, also as stored bytes; until something is
    met its bodies drift straight, or along that gravity."""
    size = float(np.linalg.norm(gravity))
    config = DatagenConfig(
        scene=SceneConfig(
            obstacle_count=0, group_count=1, group_size=0.06, maximum_initial_speed=1.0, gravity=gravity,
            domain_size=(0.5, 0.5, 0.5), cell_size=1 / 32,
            zero_gravity_fraction=float(size == 0), tilted_gravity_fraction=0.0,
        ),
        mpm=ADAPTIVE, dataset=DatasetConfig(frames=4),
    )  # fmt: skip
    answer, made = make_scene(SceneTask("train", 0, 0, 3), config, Backend())
    assert answer == "made"
    (result,) = simulate_batch([made], config, Backend(), 2)
    stored = members_of(make_episode(made, result, config, "0" * 64))
    episode = decode_episode("train-000000", stored)
    assert episode.gravity == gravity
    time_T1 = np.arange(4)[:, None] / 60
    centre_T3 = episode.position_TN3.astype(np.float64).mean(axis=1)
    expected_T3 = centre_T3[0] + time_T1 * episode.initial_velocity_N3[0] + 0.5 * time_T1**2 * np.array(gravity)
    assert episode.initial_velocity_N3.any()
    np.testing.assert_allclose(centre_T3, expected_T3, atol=1e-5)
