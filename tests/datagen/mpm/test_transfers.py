"""Transfers between particles and grid come at a rate of their own, with substeps between them."""

import dataclasses

import numpy as np
import pytest
from mpm_scenes import CONFIG, joined, particles, simulated

from datagen.mpm import grid_kernel
from hgn.scene.material import ELASTIC, SAND, SNOW, WATER
from hgn.solver_method import METHODS
from tools.stability.solver_scenes import CELL, block


def height_cells(position_N3):
    """The 0.95 quantile of heights above the last node of the floor."""
    return float(np.quantile(position_N3[:, 1], 0.95)) / CELL - 2


def centre_cells(position_N3):
    """The mean height above the last node of the floor."""
    return float(position_N3[:, 1].mean()) / CELL - 2


@pytest.fixture
def every_step(monkeypatch):
    """A transfer at every step."""
    monkeypatch.setitem(METHODS, "corrected", METHODS["corrected"]._replace(transfer_speed_m_s=None))


def cube(velocity, stiffness=1.0):
    """200 particles of all materials at random places above the floor."""
    place = np.random.default_rng(0).uniform((0.4, 0.25, 0.4), (0.55, 0.4, 0.55), (200, 3))
    parameters = {"youngs_modulus_pa": np.full(200, 1e6 * stiffness, np.float32)}
    return particles(place, np.arange(200) % 4, velocity, material_parameters=parameters)


def run(scene, config, frames, rate_hz=60.0):
    return simulated([scene], config, frames, rate_hz)[0]


def test_stiffness_changes_steps_and_not_transfers():
    """Slow scenes have cell_size / transfer_speed_m_s between transfers, eight times a frame here, with any number of
    stress steps. Fast scenes transfer more often, so that no particle moves farther than a fraction of a cell."""
    soft, hard, fast = (
        run(cube(velocity, stiffness), CONFIG, 3)
        for velocity, stiffness in (((0, -1, 0), 1), ((0, -1, 0), 30), ((12, -12, 0), 1))
    )
    assert soft.counters["transfers"] == hard.counters["transfers"] == 2 * 8
    assert hard.counters["substeps"] > 3 * soft.counters["substeps"] > 3 * 16
    assert fast.counters["transfers"] > 1.5 * 16


def apart(frames=9):
    """How much the height of a splash of water changes where something far away needs several times as many steps."""
    water = block(WATER, (30, 4, 30), (5, 5, 5), (0, -4.5, 0))
    far = block(ELASTIC, (6, 30, 6), (1, 1, 1))
    moduli = [np.repeat(np.float32([1e6, modulus]), [water.particle_count, 8]) for modulus in (1e6, 1e8)]
    both = [joined(water, far, material_parameters={"youngs_modulus_pa": modulus_N}) for modulus_N in moduli]
    alone, beside = (run(scene, CONFIG, frames, 240.0) for scene in both)
    assert beside.counters["substeps"] > 4 * alone.counters["substeps"]
    heights = [height_cells(o.position_TN3[-1][: water.particle_count]) for o in (alone, beside)]
    return abs(heights[1] / heights[0] - 1)


def test_what_is_stiff_leaves_water_as_it_is():
    """Water splashes the same, to 3 %, whatever its neighbours' stiffness."""
    assert apart() < 0.03


def test_a_transfer_at_every_step_smooths(every_step):
    """With a transfer at every substep the same water is smoothed by the neighbour's steps."""
    scene = cube((1, -3, 0))
    none = run(scene, CONFIG, 3)
    assert none.counters["transfers"] == none.counters["substeps"]
    assert apart() > 0.03


def with_stiff(soft, stiff, times):
    """Two scenes in one, the second elastic and so many times as stiff."""
    modulus = np.repeat(np.float32([1e6, 1e6 * times]), [soft.particle_count, stiff.particle_count])
    return joined(soft, stiff, material_parameters={"youngs_modulus_pa": modulus})


def test_particles_take_steps_of_their_own(monkeypatch):
    """Sand that falls on the floor takes two substeps an interval far from a stiff body that takes eight: it
    acts three times, the first and the last for half a step. It lands where it does alone, and five times nearer to
    where an eighth of the step takes it, as stresses act about the time that they are of.
    """
    acted = np.zeros(2, np.int64)
    one_substep = grid_kernel.substep

    def counted(*arguments):
        covered = arguments[6].to_numpy()
        one_substep(*arguments)
        changed = arguments[6].to_numpy() != covered
        acted[:] += changed[: sand.particle_count].sum(), changed[sand.particle_count :].sum()

    sand = block(SAND, (20, 4, 20), (5, 5, 5), (0, -3, 0))
    stiff = block(ELASTIC, (40, 20, 40), (2, 2, 2), (0, 0, 0))
    soft = dataclasses.replace(sand, material_parameters={})
    alone = run(soft, CONFIG, 7, 240.0)
    monkeypatch.setattr(grid_kernel, "substep", counted)
    beside = run(with_stiff(sand, stiff, 13), CONFIG, 7, 240.0)
    monkeypatch.undo()
    substeps, transfers = beside.counters["substeps"], beside.counters["transfers"]
    assert alone.counters["transfers"] == transfers and substeps == (8 + 1) * transfers
    assert acted[0] <= 1.02 * 3 * transfers * sand.particle_count  # stiffness in the first step is not known
    assert acted[1] == substeps * stiff.particle_count
    fine = run(soft, dataclasses.replace(CONFIG, stability_fraction=CONFIG.stability_fraction / 8), 7, 240.0)
    errors = [
        np.sqrt(((outcome.position_TN3[-1, : sand.particle_count] - fine.position_TN3[-1]).astype(float) ** 2).mean())
        for outcome in (alone, beside)
    ]
    assert 5 * errors[1] < errors[0] < 3e-4, errors


def shaken(scenes, frames):
    """How fast bodies at rest move in the end, root mean square, and how far their centres have, in cells."""
    for outcome in simulated(scenes, CONFIG, frames, 240.0):
        place_TN3 = 64 * outcome.position_TN3.astype(np.float64)
        speed_N3 = 240 * (place_TN3[-1] - place_TN3[-2])
        yield np.sqrt((speed_N3**2).sum(1).mean()), np.abs(place_TN3[-1].mean(0) - place_TN3[0].mean(0)).max()


def test_what_is_stiff_rests():
    """A block that takes several substeps an interval lies still on the floor: after 0.15 s it moves by less
    than 0.01 cells a second, and has not left its place (it danced, since transfers found velocities half a step
    ahead).
    """
    scenes = []
    for material, stiffness in ((ELASTIC, 16), (SNOW, 3.6)):
        scene = block(material, (30, 2, 30), (3, 3, 3))
        modulus = np.full(scene.particle_count, 1e6 * stiffness, np.float32)
        scenes.append(dataclasses.replace(scene, material_parameters={"youngs_modulus_pa": modulus}))
    for speed, way in shaken(scenes, 37):
        assert speed < 0.01 and way < 0.01


def test_sand_rests_around_what_is_stiff():
    """Sand in a bin around a stiff body stays at rest, although its steps are longer than the body's: its centre sinks
    by less than 0.02 cells in 0.2 s. (It once rose by 0.2, because one force acted before the others balanced it.)"""
    sand = block(SAND, (2, 2, 2), (4, 6, 4))
    inside = ((64 * sand.position_N3 > (3, 4, 3)) & (64 * sand.position_N3 < (5, 6, 5))).all(1)
    sand = dataclasses.replace(
        sand, domain_size=(9 / 64, 13 / 64, 9 / 64),
        **{name: getattr(sand, name)[~inside] for name in ("position_N3", "velocity_N3", "material_N")},
    )  # fmt: skip
    ((_, way),) = shaken([with_stiff(sand, block(ELASTIC, (3, 4, 3), (2, 2, 2), seed=1), 16)], 49)
    assert way < 0.02


def test_bodies_of_different_steps_that_meet():
    """Sand that a stiff body falls upon ends as with half the step, to 2 % of a cell in the mean (0.37 where particles
    near the body take longer steps); without gravity and floor the momentum of all is constant.
    """
    scene = with_stiff(
        block(SAND, (30, 3, 30), (6, 4, 6), (0, 0, 0)), block(ELASTIC, (31, 8, 31), (4, 4, 4), (0, -3, 0)), 16
    )
    whole, fine = (
        run(scene, dataclasses.replace(CONFIG, stability_fraction=CONFIG.stability_fraction / parts), 7, 240.0)
        for parts in (1, 2)
    )
    assert 64 * np.abs(fine.position_TN3[-1].mean(0) - whole.position_TN3[-1].mean(0)).max() < 0.02
    assert 64 * np.abs(fine.position_TN3[-1].std(0) - whole.position_TN3[-1].std(0)).max() < 0.02
    lifted_N3 = scene.position_N3 + np.float32([0, 0.3, 0])
    free = dataclasses.replace(scene, gravity=(0.0, 0.0, 0.0), position_N3=lifted_N3)
    path_TN3 = run(free, CONFIG, 7, 240.0).position_TN3.astype(np.float64)
    velocity_T3 = 240 * np.diff(path_TN3.mean(1), axis=0)
    assert np.abs(velocity_T3 - scene.velocity_N3.mean(0)).max() < 1e-4, velocity_T3


def test_half_the_step():
    """Half the step moves the centre of sand that hits the floor at 10 m/s, and the height of a block of each material
    at 4.5 m/s, by less than 3 %, as transfers stay as many: intervals are synchronised while something is fast, and
    those that follow take up strain and stress where these have left them.
    """
    half = dataclasses.replace(CONFIG, stability_fraction=CONFIG.stability_fraction / 2)
    blocks = [block(kind, (30, 4, 30), (5, 5, 5), (0, -4.5, 0)) for kind in (SAND, SNOW, WATER)]
    fast = block(SAND, (29, 4, 29), (6, 6, 6), (0, -10.0, 0))
    for scenes, frames, measure in (([fast], 9, centre_cells), (blocks, 6, height_cells)):
        outcomes = [simulated(scenes, config, frames, 240.0) for config in (CONFIG, half)]
        for whole, fine in zip(*outcomes, strict=True):
            assert np.abs(measure(fine.position_TN3[-1]) / measure(whole.position_TN3[-1]) - 1) < 0.03
