"""Measures and limits of tools.stability network, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from network.states import network_of
from runtime.stability import family, one_particle, outcome_of

from hgn.config import MpmConfig, NetworkConfig
from hgn.runtime.rollouts import RolloutResult
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.obstacle_grid import ObstacleGrid
from tools.measures import neighbours
from tools.stability.case import Case, Limit, Outcome
from tools.stability.checks import row_of, violation
from tools.stability.measures import STIR_FRAMES, energy_growth, energy_rise, far_effect, kinetic_change, passed, pull
from tools.stability.network import Runner
from tools.stability.network_cases import PASSES, RESTS, SPREADS

CPU = MpmConfig(device="cpu")
SCENE = {"obstacle_count": 1, "obstacle_size": [0.1, 0.2]}
SCENE |= {"group_shapes": ["cube"], "group_count": 2, "group_size": 0.04}


def failure(limits, own, solver):
    """The first violation of limits, by figures of the network and of the solver."""
    return next(filter(None, (violation(limit, own, solver, True) for limit in limits)), None)


def test_limits():
    """A limit bounds from both sides, absolutely or relative to the solver; NaN and missing figures violate it."""
    limit = Limit("rest.height", -0.1, 0.2, below=1.0, above=2.0)
    for value, passes in ((0.89, False), (0.91, True), (2.19, True), (2.21, False), (float("nan"), False)):
        found = violation(limit, {"rest": {"height": value}}, {"rest": {"height": 1.0}}, True)
        assert (found is None) == passes
    assert found == "rest.height nan, must be 0.9 to 2.2 (solver 1)"
    both = {"spread": [{"scene": 0, "frame": 3, "width": 1.0}, {"scene": 1, "frame": 3, "width": 4.0}]}
    assert violation(Limit("spread.width", high=3.0), both, {}, False) == (
        "spread.width (scene 1, frame 3) 4, must be at most 3"
    )
    assert violation(Limit("spread.width", low=0.5), both, {}, False) is None
    assert "the solver did not come to the end" in str(violation(limit, both | {"rest": {}}, {"rest": None}, True))
    assert "the network did not come to the end" in str(violation(limit, {"rest": None}, {}, False))


def test_collapse_beside_the_solver():
    """A cube of sand that spreads as the solver's passes; spread a fifth less, or a cell higher, it does not."""
    (case,) = family("collapse", NetworkConfig(materials=("sand",)), frames=61, **SCENE)
    assert case.frames == 61 and case.at_frames == (30, 60)
    assert [scene.position_N3[:, 1].min() for scene in case.scenes] == pytest.approx([5 / 64, 20 / 64])
    soft = replace(CPU, youngs_modulus_pa=0.1 * CPU.youngs_modulus_pa)  # a third of the steps
    films = Runner(Simulator(network_of(), 60.0), [case], soft)._solver(case.scenes, case.frames)
    row = row_of(outcome_of(case, films, solver=films), {})
    truth = row.more["collapse"]
    assert row.held and truth == row.more["solver_collapse"] and len(truth) == 4
    x_N, y_N, z_N = 64 * films[0].position_TN3[30].T.astype(np.float64)
    expected = {"spread": np.sqrt(0.5 * (x_N.var() + z_N.var())), "height": y_N.mean()}
    expected["neighbours"] = neighbours(64 * films[0].position_TN3[30].astype(np.float64), 1.0)
    assert truth[0] == pytest.approx({"scene": 0, "frame": 30} | expected)
    assert truth[1]["spread"] > 1.5 * truth[0]["spread"] > 6  # it falls apart
    for field, factor in (("spread", 0.8), ("height", 1.6)):
        other = [record | {field: factor * record[field]} for record in truth]
        assert f"collapse.{field} (scene" in str(failure(SPREADS[2:4], {"collapse": other}, {"collapse": truth}))


@pytest.mark.parametrize(
    ("through", "leaked", "beyond"),
    [
        (0.7, 0.0, None),
        (0.55, 0.15, None),
        (0.55, 0.4, "passed.leaked (hole_cells 2.0) 0.4, must be at most 0.15 (solver 0.1)"),
        (0.1, 0.0, "passed.through (hole_cells 2.0) 0.1, must be 0.5 to 0.9 (solver 0.7)"),
        (1.0, 0.0, "passed.through (hole_cells 2.0) 1, must be 0.5 to 0.9 (solver 0.7)"),
        (0.1, 0.6, "passed.through (hole_cells 2.0) 0.1, must be 0.5 to 0.9 (solver 0.7)"),
    ],
)
def test_holes_beside_the_solver(through, leaked, beyond):
    """Particles that cross the edge's height within the hole pass, others leak, and those that come back do neither.
    At most a fifth of all may pass more or less than with the solver, and a twentieth more leak."""
    still_N3 = np.zeros((20, 3), np.float32)
    scene = one_particle(
        position_N3=still_N3 + np.float32(0.5), velocity_N3=still_N3, material_N=np.zeros(20, np.uint8)
    )

    def falls(through, leaked):
        """Through the hole at 0.4 and then far aside; or past it and then to the middle; or in and out again."""
        path_TN3 = np.stack([scene.position_N3] * 4)
        ways = [[(0.52, 0.3), (0.9, 0.1), (0.9, 0.1)], [(0.6, 0.3), (0.5, 0.1), (0.5, 0.1)]]
        ways.append([(0.5, 0.3), (0.5, 0.6), (0.5, 0.6)])
        first, second = round(20 * through), round(20 * (through + leaked))
        for axes, some, way in zip(
            ((0, 1), (2, 1), (0, 1)), np.split(np.arange(20), (first, second)), ways, strict=True
        ):
            path_TN3[np.ix_((1, 2, 3), some, axes)] = np.array(way)[:, None]
        return RolloutResult(path_TN3)

    limits = PASSES[2:4]  # these particles fall faster than gravity says
    case = Case("holes", (scene,) * 2, 4, limits, also=("pull",), hole_cells=(1.0, 2.0), hole_height=0.4)
    own, solvers = [falls(0.0, 0.0), falls(through, leaked)], [falls(0.1, 0.0), falls(0.7, 0.1)]
    row = row_of(outcome_of(case, own, solver=solvers), {})
    hole = row.more["passed"][1]
    assert hole == {"hole_cells": 2.0, "through": pytest.approx(through), "leaked": pytest.approx(leaked)}
    assert row.held == (beyond is None) and (row.held or row.beyond == beyond)
    assert row.more["pull"] == row.more["solver_pull"] == [None, None]  # four frames are fewer than a history
    early = [own[0], RolloutResult(own[1].position_TN3[:3], "diverged at frame 3")]
    row = row_of(outcome_of(case, early, solver=solvers), {})
    assert not row.held and row.beyond == "diverged at frame 3" and row.more["passed"] is None
    row = row_of(outcome_of(case, own, solver=early), {})
    assert not row.held and row.beyond == "passed: the solver did not come to the end"
    assert passed(outcome_of(case, early)) is None


def test_pull_in_a_hole():
    """Only particles in the hole of the solver's trajectory count: without contacts the network's fall with gravity,
    whatever its parameters; the solver's hung there, or fell at half the acceleration."""
    free = network_of(torch.float32, inputs="relative", obstacle_features=False)
    place_N3 = np.array([[0.5, 0.4, 0.49], [0.51, 0.405, 0.5], [0.5, 0.6, 0.5], [0.8, 0.4, 0.5]], np.float32)
    scene = one_particle(position_N3=place_N3, velocity_N3=0 * place_N3, material_N=np.zeros(4, np.uint8))
    case = Case("passes holes", (scene,) * 2, 20, hole_cells=(2.0, 2.0), hole_height=0.4)
    fall_T = 0.5 * scene.gravity[1] / 60**2 * np.arange(20.0) ** 2
    paths = [np.stack([place_N3] * 20), np.stack([place_N3] * 20)]
    paths[1][:, :2, 1] += (0.5 * (fall_T - fall_T[10]))[:, None]
    films = [RolloutResult(path) for path in paths]
    outcome = outcome_of(case, films, Simulator(free, 60.0), films)
    assert pull(outcome) == [pytest.approx(1, abs=1e-3)] * 2
    assert outcome.solver is not None
    assert pull(outcome.solver) == [pytest.approx(0, abs=1e-3), pytest.approx(0.5, abs=1e-3)]


def test_energy_growth_against_a_closed_form():
    """Free fall from rest adds no energy; a sudden throw upwards adds that of its speed."""
    scene = one_particle()
    case, time = Case("single", (scene,), 12), np.arange(12)[:, None, None] / 60
    fall = scene.position_N3 + 0.5 * np.array(scene.gravity) * time**2
    thrown = fall + np.array([0, 1.4, 0]) * time
    found = [energy_growth(outcome_of(case, [RolloutResult(p.astype(np.float32))])) for p in (fall, thrown, thrown[:1])]
    assert found == [pytest.approx(0, abs=1e-4), pytest.approx(0.5 * 1.4**2 / 9.8, rel=5e-3), 0]


def test_energy_rise_and_kinetic_change():
    """Energy that was lost and comes back is a rise, but no growth; kinetic energy may neither grow nor shrink."""
    scene, time_T = one_particle(), np.arange(21) / 60
    scene = one_particle(velocity_N3=np.array([[2.0, 0.0, 0.0]], np.float32))
    case, fall_T = Case("single", (scene,), 21), -0.5 * 9.8 * time_T**2
    for middle, rise, change in ((2.0, 0.0, 0.0), (1.0, 1.5 / 9.8, -0.75), (3.0, 2.5 / 9.8, 1.25)):
        speed_T = np.where(np.arange(20) // 7 == 1, middle, 2.0)
        x_T = np.concatenate([[0.0], np.cumsum(speed_T) / 60])
        path_TN3 = np.stack([x_T, 0 * x_T, 0 * x_T], axis=1)[:, None] + scene.position_N3
        found = outcome_of(case, [RolloutResult(path_TN3.astype(np.float32))])
        assert kinetic_change(found) == pytest.approx(change, abs=1e-3)
        path_TN3[..., 1] += fall_T[:, None]
        found = outcome_of(case, [RolloutResult(path_TN3.astype(np.float32))])
        assert energy_rise(found) == pytest.approx(rise, abs=2e-3)


def test_bodies_apart():
    """Passing bodies start PASSING_GAP apart and are level in the middle of the case; a push of the far body shows."""
    passing, far = family("apart", network_of(materials=("snow",)).config)
    (scene,) = passing.scenes
    half = len(scene.position_N3) // 2
    ways = [scene.position_N3[own].astype(np.float64) for own in (slice(half), slice(half, None))]
    assert ways[1][:, 0].min() - ways[0][:, 0].max() == pytest.approx(0.14, abs=2e-3)
    middles = [w.mean(axis=0) + passing.frames / 120 * scene.velocity_N3[k] for w, k in zip(ways, (0, -1), strict=True)]
    assert middles[0][2] == pytest.approx(middles[1][2], abs=5e-3)
    count = far.scenes[0].particle_count
    assert (far.scenes[1].position_N3[:count] == far.scenes[0].position_N3).all()
    films = [RolloutResult(np.stack([each.position_N3] * far.frames)) for each in far.scenes]
    assert far_effect(outcome_of(far, films)) == 0.0 and row_of(outcome_of(far, films), {}).held
    pushed_TN3 = films[1].position_TN3.copy()
    pushed_TN3[-1, :count, 0] += 0.5 / 64
    pushed = outcome_of(far, [films[0], RolloutResult(pushed_TN3)])
    assert far_effect(pushed) == pytest.approx(0.5, rel=1e-3) and not row_of(pushed, {}).held


@pytest.mark.parametrize(
    ("stretch", "shift", "stir", "beyond"),
    [
        (1.0, 0.0, 0.0, None),
        (1.05, 0.05, 0.02, None),
        (1.0, 3.2, 0.0, "rest.drift"),
        (1.3, 0.0, 0.0, "rest.neighbours"),
        (0.7, 0.0, 0.0, "rest.neighbours"),
        (1.0, 0.12, 0.0, "rest.height"),
        (1.0, 0.0, 0.05, "rest.squared speed 0.0025, must be -0.0003 to 0.0013 (solver 0.0004)"),
    ],
)  # fmt: skip
def test_rest_beside_the_solver(stretch, shift, stir, beyond):
    """A lattice counts its neighbours by a closed form. Drift, neighbours, spread, height and squared speed about the
    mean are bounded from both sides: frozen water fails where the solver's moves."""
    side, cell = 6, 1 / 64
    lattice_N3 = 0.6 * cell * np.stack(np.meshgrid(*3 * [np.arange(side)]), -1).reshape(-1, 3)
    lattice_N3 += 0.4 - lattice_N3.mean(axis=0)
    assert neighbours(lattice_N3, 0.7 * cell) == pytest.approx(6 * (side - 1) / side)
    assert neighbours(lattice_N3, 0.3 * cell) == neighbours(lattice_N3[:0], cell) == 0
    empty = ObstacleGrid(cell, np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
    still = 0 * lattice_N3
    scene = InitialState(lattice_N3, still, np.full(len(still), 2), empty, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    # at the end every other particle oscillates against the others, and all slide slowly together
    every_other_N = np.where(np.arange(len(lattice_N3)) % 2, 1.0, -1.0)
    back_T = np.arange(STIR_FRAMES + 1)[:, None] % 2

    def path(stretch, shift_cells, stir, sideways_cells=0.0):
        moved_3 = np.array([sideways_cells, shift_cells, 0.0]) * cell
        last_TN3 = np.stack([0.4 + stretch * (lattice_N3 - 0.4) + moved_3] * len(back_T))
        last_TN3[..., 0] += stir / 60 * back_T * every_other_N
        last_TN3[..., 0] += 1e-4 * cell * np.arange(len(back_T))[:, None]
        return RolloutResult(np.concatenate([[lattice_N3] * 3, last_TN3]).astype(np.float32))

    own, solver = (
        path(stretch, 0.0, stir, shift) if shift > 1 else path(stretch, shift, stir),
        path(1.0, 0.0, 0.02, 1.0),
    )
    case, simulator = Case("64 frames", (), len(back_T) + 3, RESTS, settled=2), Simulator(network_of(), 60.0)

    def row(own, solver):
        return row_of(Outcome(case, [scene], [own], simulator, Outcome(case, [scene], [solver], simulator)), {})

    found = row(own, solver)
    assert found.held is (beyond is None) and (beyond is None or beyond in found.beyond), found
    assert found.more["solver_rest"]["drift"] == pytest.approx(1.0, rel=2e-2)
    assert found.more["rest"]["squared_speed"] == pytest.approx(stir**2, abs=1e-8)
    assert found.more["solver_rest"]["squared_speed"] == pytest.approx(0.02**2, rel=1e-3)
    assert not row(own, RolloutResult(own.position_TN3[:3], "diverged")).held
    frozen = row(path(1.0, 0.0, 0.0), path(1.0, 0.0, 0.1, 1.0))
    assert frozen.beyond.startswith("rest.squared speed ") and "must be 0.0045 to" in frozen.beyond
