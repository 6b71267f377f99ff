"""The solver against closed forms, conservation laws and its own promises about batches and failures."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mpm_scenes import CELL, CONFIG, assert_inside, beside, block, joined, particles, sheet, simulated

from datagen.mpm.device import initialise
from datagen.mpm.solver import SceneFailure, Simulated, fixed_substeps, particle_bounds, simulate
from datagen.pool.plan import SceneTask
from datagen.pool.worker import Backend, make_episode, make_scene, simulate_batch
from hgn.config import DatagenConfig, DatasetConfig, MpmConfig, SceneConfig
from hgn.scene.episode import decode_episode, encode_episode
from hgn.scene.material import MATERIALS, SAND, SNOW, WATER
from hgn.schema import ConfigError

ADAPTIVE = CONFIG
FIXED = MpmConfig(device="cpu", time_step="fixed")
BESIDE = beside()


def run(scene, config, frames):
    outcome = simulate([scene, beside(domain_size=scene.domain_size)], config, frames, 60.0)[0]
    assert isinstance(outcome, Simulated), outcome
    return outcome


@pytest.mark.parametrize("gravity", [(0.0, -9.8, 0.0), (3.0, 0.0, -4.0), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("material", range(len(MATERIALS)), ids=MATERIALS)
def test_free_fall(material, gravity):
    """At each frame a thrown body has moved by v t + g t² / 2, to 2e-4 of the whole way in 0.25 s, whatever gravity."""
    velocity = np.array([0.2, 0.6, -0.1])
    scene = block(material, (0.4, 0.45, 0.4), (0.5, 0.55, 0.5), tuple(velocity), gravity=gravity)
    position = run(scene, ADAPTIVE, 16).position_TN3.astype(float)
    time = np.arange(16)[:, None] / 60
    way = velocity * time + np.array(gravity) * time**2 / 2
    centre = position.mean(axis=1)
    assert np.abs(centre - centre[0] - way).max() < 2e-4 * np.linalg.norm(way[-1])


def test_free_fall_with_intervals_that_change():
    """Free fall stays exact where the speed shortens the intervals on the way: thrown up at 9 m/s, it comes back."""
    scene = block(SNOW, (0.4, 0.3, 0.4), (0.5, 0.4, 0.5), (0, 9, 0), count=100, gravity=(0.0, -60.0, 0.0))
    scene = dataclasses.replace(scene, domain_size=(1.0, 2.0, 1.0))
    outcome = run(scene, dataclasses.replace(ADAPTIVE, transfer_speed_m_s=8.0), 19)
    centre = outcome.position_TN3.astype(float)[:, :, 1].mean(axis=1)
    time = np.arange(19) / 60
    assert np.abs(centre - centre[0] - 9 * time + 30 * time**2).max() < 2e-4 * 9**2 / 120
    assert outcome.counters["transfers"] != 18 * round(outcome.counters["transfers"] / 18)  # they did change


def test_free_fall_as_taichi_elements_has_it():
    """With a fixed step of its scheme a falling body follows y = -g dt² n (n + 1) / 2 to 1e-4 of the fall."""
    config = dataclasses.replace(FIXED, time_integration="symplectic_euler")
    position = run(block(SAND, (0.4, 0.7, 0.4), (0.5, 0.8, 0.5)), config, 16).position_TN3.astype(float)
    n = fixed_substeps(config, 60.0) * np.arange(16)
    fall = -9.8 * config.fixed_time_step_s**2 * n * (n + 1) / 2
    assert np.abs(position[:, :, 1].mean(axis=1) - position[0, :, 1].mean() - fall).max() < 1e-4 * abs(fall[-1])


def test_taichi_elements_substeps():
    """A fixed step of 3.125e-4 s at 60 Hz takes 54 substeps a frame, Taichi Elements' count."""
    outcome = run(block(WATER, (0.4, 0.4, 0.4), (0.5, 0.5, 0.5), count=20), FIXED, 3)
    assert outcome.counters["substeps"] == 2 * 54
    assert outcome.counters["smallest_time_step_s"] == pytest.approx(3.125e-4)


def test_adaptive_steps_fill_the_frame():
    """The symplectic scheme is ahead of g t² / 2 by g t / 2 times the interval between transfers."""
    config = dataclasses.replace(ADAPTIVE, time_integration="symplectic_euler")
    outcome = run(block(SNOW, (0.4, 0.7, 0.4), (0.5, 0.8, 0.5), count=200), config, 11)
    time = 10 / 60
    fall = (outcome.position_TN3[-1] - outcome.position_TN3[0])[:, 1].mean()
    interval = time / outcome.counters["transfers"]
    assert -9.8 * time * (time / 2 + 0.55 * interval) < fall < -9.8 * time * (time / 2 + 0.45 * interval)
    assert outcome.counters["substeps"] >= time / (config.stability_fraction * CELL * (1000 / 1_666_667) ** 0.5)


@pytest.mark.parametrize("config", [ADAPTIVE, FIXED], ids=["adaptive", "fixed"])
def test_momentum_is_conserved(config):
    """Without gravity two colliding blocks keep their total momentum to 1e-5 of what each brings in."""
    scene = joined(
        block(WATER, (0.3, 0.4, 0.4), (0.42, 0.55, 0.55), (2, 0.3, 0), gravity=(0.0, 0.0, 0.0)),
        block(SNOW, (0.5, 0.42, 0.4), (0.6, 0.57, 0.55), (-2, 0, 0.1), seed=1),
        block(SAND, (0.38, 0.62, 0.4), (0.5, 0.7, 0.5), (0, -2, 0), seed=2),
    )
    moved = np.diff(run(scene, config, 7).position_TN3.astype(float), axis=0).sum(axis=1)
    expected = moved[0]
    assert np.abs(moved - expected).max() < 1e-5 * np.abs(scene.velocity_N3).sum() / 60


def test_water_comes_to_rest():
    """Water between walls carries its own weight: it comes to rest, and keeps its level but for half a cell."""
    scene = block(WATER, (2.6 * CELL, 2.6 * CELL, 2.6 * CELL), (13.2 * CELL, 7 * CELL, 13.2 * CELL))
    outcome = run(scene, ADAPTIVE, 91)
    level = outcome.position_TN3[:, :, 1].mean(axis=1)
    assert np.abs(level - level[0]).max() < 0.5 * CELL
    assert np.abs(level[-30:] / level[-1] - 1).max() < 0.02
    speed = np.linalg.norm(np.diff(outcome.position_TN3[-10:], axis=0), axis=2) * 60
    assert np.sqrt((speed**2).mean()) < 0.1
    assert outcome.counters["water_volume_floors"] == 0


@pytest.mark.parametrize("material", range(len(MATERIALS)), ids=MATERIALS)
@pytest.mark.parametrize("count", [1, 0], ids=["particle", "block"])
def test_impact_at_ten_metres_per_second(material, count):
    """The adaptive step bears an impact on the floor at 10 m/s, of a block and of a single particle: nothing is more
    than 15 % faster than with an eighth of the step, of which a block of water throws something up at 15.1 m/s.
    """
    scene = block(material, (0.4, 0.3, 0.4), (0.6, 0.45, 0.6), (0, -10, 0), count=count)
    finer = dataclasses.replace(ADAPTIVE, stability_fraction=ADAPTIVE.stability_fraction / 8)
    outcome, exact = (run(scene, config, 13) for config in (ADAPTIVE, finer))
    assert_inside(outcome.position_TN3, scene)
    assert outcome.counters["position_clamps"] == 0
    assert outcome.counters["largest_speed"] < 1.15 * exact.counters["largest_speed"]


def test_stiffening_water_bears_thirty_metres_per_second():
    """At 30 m/s linear water is pressed to its floor; stiffening water is not, and both stay finite and inside."""
    scene = block(WATER, (0.4, 0.3, 0.4), (0.55, 0.45, 0.55), (0, -30, 0))
    floors = []
    for equation in ("linear", "stiffening"):
        config = MpmConfig(device="cpu", water_equation=equation)
        (outcome,) = simulated([scene], config, 7)
        assert_inside(outcome.position_TN3, scene, config)
        floors.append(outcome.counters["water_volume_floors"])
    assert floors[0] > 0 and floors[1] == 0


def test_a_million_particles_in_one_cell():
    """A cell as full as memory allows: a frame passes, finite, and nothing is lost."""
    scene = block(WATER, [8 * CELL] * 3, [9 * CELL] * 3, count=1_000_000)
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


def test_snow_impact_is_converged():
    """Halving the step changes the height of a snow block that fell at 4.5 m/s by less than 3 %."""
    scene = block(SNOW, (0.35, 0.25, 0.35), (0.6, 0.5, 0.6), (0, -4.5, 0))
    half = MpmConfig(device="cpu", stability_fraction=0.25)
    heights = [
        np.quantile(run(scene, config, 25).position_TN3[-1, :, 1], 0.95) - 3 * CELL for config in (ADAPTIVE, half)
    ]
    assert abs(heights[1] / heights[0] - 1) < 0.03


def test_walls():
    """Slipping walls keep tangential motion, sticking walls brake it, and neither lets anything through."""
    scene = block(SNOW, (0.2, 2.6 * CELL, 0.3), (0.4, 4.6 * CELL, 0.5), (2, 0, 0))
    moved = []
    for contact in ("slip", "stick"):
        config = MpmConfig(device="cpu", wall_contact=contact)
        position = run(scene, config, 10).position_TN3
        moved.append((position[-1] - position[0])[:, 0].mean())
        assert_inside(position, scene, config)
    assert moved[0] == pytest.approx(2 * 9 / 60, rel=0.02)
    assert moved[1] < 0.7 * moved[0]


def test_scenes_of_a_batch_equal_scenes_alone():
    """A scene's trajectory is bitwise the same alone and beside scenes of other size, material, obstacles and steps."""
    scenes = [
        block(WATER, (0.4, 0.2, 0.4), (0.5, 0.3, 0.5), (1, -3, 0)),
        joined(block(SNOW, (0.4, 0.45, 0.4), (0.55, 0.6, 0.5), (0, -4, 0), seed=1, obstacles=(sheet(0.3),)), BESIDE),
        joined(block(SAND, (0.3, 0.2, 0.3), (0.4, 0.3, 0.4)), block(WATER, (0.5, 0.2, 0.3), (0.6, 0.3, 0.4)), BESIDE),
    ]
    steps = (0.5, 1.0, 0.25)
    together = simulate(scenes, ADAPTIVE, 7, 60.0, stability_fractions=steps)
    for scene, step, outcome in zip(scenes, steps, together, strict=True):
        (alone,) = simulate([scene], dataclasses.replace(ADAPTIVE, stability_fraction=step), 7, 60.0)
        assert np.array_equal(alone.position_TN3, outcome.position_TN3)
        assert alone.counters == outcome.counters


@pytest.mark.parametrize(
    ("config", "velocity", "cause"),
    [
        (FIXED, (0, 1e25, 0), "frame 1: a particle's position, velocity or velocity gradient is no longer finite"),
        (FIXED, (0, 3000, 0), "frame 1: a particle left the domain"),
        (MpmConfig(device="cpu", maximum_substeps_per_frame=20), (0, 20, 0), "maximum_substeps_per_frame = 20"),
    ],
    ids=["not finite", "left", "substeps"],
)
def test_a_bad_scene_leaves_its_batch_alone(config, velocity, cause):
    """A scene that blows up is reported with frame and rule; its batch mates keep every bit."""
    good = block(WATER, (0.4, 0.2, 0.4), (0.5, 0.3, 0.5), (1, -1, 0))
    bad = block(SNOW, (0.4, 0.4, 0.4), (0.5, 0.5, 0.5), velocity)
    first, failed, last, _ = simulate([good, bad, good, BESIDE], config, 5, 60.0)
    assert isinstance(failed, SceneFailure)
    assert cause in failed.cause
    alone = run(good, config, 5)
    for outcome in (first, last):
        assert np.array_equal(outcome.position_TN3, alone.position_TN3)
        assert outcome.counters == alone.counters


@pytest.mark.parametrize("material", range(len(MATERIALS)), ids=MATERIALS)
def test_few_particles(material):
    """One particle, two on one spot, particles on cell faces and corners: finite, and frame 0 is the input."""
    spots = [
        [[0.5, 0.5, 0.5]],
        [[0.4, 0.3, 0.4]] * 2,
        [[4 * CELL, 5 * CELL, 6 * CELL], [4.5 * CELL, 5 * CELL, 6.5 * CELL], [4.5 * CELL, 4.5 * CELL, 4.5 * CELL]],
        [np.full(3, 3 * CELL), np.full(3, 13 * CELL)],
    ]
    scenes = [particles(spot, material) for spot in spots]
    for scene, outcome in zip(scenes, simulated([*scenes, BESIDE], ADAPTIVE, 20), strict=False):
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


def test_a_domain_that_is_no_cube():
    """Sides of 1, 0.75 and 1.375 with nodes that are no multiple of the block size: material spreads to each wall."""
    scene = block(WATER, (0.3, 0.2, 0.3), (0.6, 0.5, 0.6), (3, 0, 4), domain_size=(1.0, 0.75, 1.375))
    position = run(scene, ADAPTIVE, 25).position_TN3
    assert_inside(position, scene)
    _, high = particle_bounds(scene, ADAPTIVE)
    assert (position.max(axis=(0, 1))[[0, 2]] > high[[0, 2]] - 2 * CELL).all()


def test_empty():
    """No scenes give no results; scenes without particles give empty trajectories, also beside others."""
    nothing = particles([])
    frames: list[int] = []
    assert simulate([], ADAPTIVE, 4, 60.0) == []
    (alone,) = simulate([nothing], ADAPTIVE, 4, 60.0, frames.append)
    assert alone.position_TN3.shape == (4, 0, 3)
    assert alone.counters["substeps"] == 0
    assert frames == [0, 1, 2, 3]
    _, other, _ = simulate([nothing, BESIDE, nothing], ADAPTIVE, 2, 60.0)
    assert len(other.position_TN3) == 2


def test_one_frame_is_the_initial_state():
    """frames=1 returns the initial positions without a step; on_frame sees each frame once."""
    frames: list[int] = []
    (outcome,) = simulate([BESIDE], ADAPTIVE, 1, 60.0, frames.append)
    assert np.array_equal(outcome.position_TN3, BESIDE.position_N3[None])
    simulate([BESIDE], ADAPTIVE, 3, 60.0, frames.append)
    assert frames == [0, 0, 1, 2]


def test_bad_input_is_refused():
    """Scenes outside the walls, of other grids, not finite, or no frames: an error that names the field."""
    good, late = (block(WATER, (0.4, 0.4, 0.4), (0.5, 0.5, 0.5), count=4) for _ in range(2))
    late.velocity_N3[0] = np.nan
    for changes, field in (
        ({"cell_size": 1 / 64}, "cell_size"),
        ({"position_N3": good.position_N3 + 0.8}, "position_N3 of scene 1"),
    ):
        with pytest.raises(ConfigError, match=field):
            simulate([good, dataclasses.replace(good, **changes)], ADAPTIVE, 2, 60.0)
    drifting = dataclasses.replace(good, gravity=(0, np.nan, 0))
    uneven, small = (dataclasses.replace(good, cell_size=size) for size in (0.06, 0.25))
    for scene, field in ((drifting, "gravity"), (uneven, "domain_size"), (small, "domain_size"), (late, "velocity_N3")):
        with pytest.raises(ConfigError, match=field):
            simulate([scene], ADAPTIVE, 2, 60.0)
    with pytest.raises(ConfigError, match="frames"):
        simulate([good], ADAPTIVE, 0, 60.0)
    with pytest.raises(ConfigError, match="frame_rate_hz"):
        simulate([good], ADAPTIVE, 2, float("nan"))
    with pytest.raises(ConfigError, match=r"stability_fractions\[1\] must be above 0"):
        simulate([good, good], ADAPTIVE, 2, 60.0, stability_fractions=(1.0, 0.0))


def test_memory_is_given_back():
    """Fifty simulations leave the process within 20 MB of its size; each holds a grid of 2 MB and more."""

    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    scenes = [BESIDE] * 16
    for _ in range(5):
        simulate(scenes, ADAPTIVE, 1, 60.0)
    before = resident()
    for _ in range(50):
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


def test_one_thread_repeats_itself_in_silence():
    """In a process of one thread two runs agree bitwise, and Taichi writes nothing to stdout or stderr."""
    program = (
        "import numpy as np; from datagen.mpm.solver import simulate; from hgn.config import MpmConfig;"
        "from hgn.scene.scene import Scene; x = np.random.default_rng(0).uniform(.3, .5, (300, 3)).astype('f4');"
        "s = Scene(x, x - 2, np.zeros(300, 'u1'), cell_size=1 / 16);"
        "a, b = (simulate([s], MpmConfig(), 4, 60., cpu_threads=1)[0].position_TN3 for _ in range(2));"
        "raise SystemExit(0 if np.array_equal(a, b) else 1)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


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
    stored = encode_episode(make_episode(made, result, config, "0" * 64))
    episode = decode_episode("train-000000", stored)
    assert episode.gravity == gravity
    time_T1 = np.arange(4)[:, None] / 60
    centre_T3 = episode.position_TN3.astype(np.float64).mean(axis=1)
    expected_T3 = centre_T3[0] + time_T1 * episode.initial_velocity_N3[0] + 0.5 * time_T1**2 * np.array(gravity)
    assert episode.initial_velocity_N3.any()
    np.testing.assert_allclose(centre_T3, expected_T3, atol=1e-5)
