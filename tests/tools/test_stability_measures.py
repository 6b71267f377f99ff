"""Measures and limits of tools.stability network, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from network.states import network_of
from runtime.stability import family, one_particle, outcome_of

from hgn.config import MpmConfig, NetworkConfig
from hgn.runtime.rollouts import RolloutResult
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.obstacle_grid import ObstacleGrid
from tools.measures import neighbours
from tools.stability.case import Case, Limit, Outcome
from tools.stability.checks import row_of, violation
from tools.stability.measures import STIR_FRAMES, energy_growth, energy_rise
from tools.stability.network import Runner
from tools.stability.network_cases import RESTS, SPREADS

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


def test_energy_growth_against_a_closed_form():
    """Free fall from rest adds no energy; a sudden throw upwards adds that of its speed."""
    scene = one_particle()
    case, time = Case("single", (scene,), 12), np.arange(12)[:, None, None] / 60
    fall = scene.position_N3 + 0.5 * np.array(scene.gravity) * time**2
    thrown = fall + np.array([0, 1.4, 0]) * time
    found = [energy_growth(outcome_of(case, [RolloutResult(p.astype(np.float32))])) for p in (fall, thrown, thrown[:1])]
    assert found == [pytest.approx(0, abs=1e-4), pytest.approx(0.5 * 1.4**2 / 9.8, rel=5e-3), 0]


def test_energy_rise():
    """Energy that was lost and comes back is a rise, but no growth."""
    scene, time_T = one_particle(), np.arange(21) / 60
    scene = one_particle(velocity_N3=np.array([[2.0, 0.0, 0.0]], np.float32))
    case, fall_T = Case("single", (scene,), 21), -0.5 * 9.8 * time_T**2
    for middle, rise in ((2.0, 0.0), (1.0, 1.5 / 9.8), (3.0, 2.5 / 9.8)):
        speed_T = np.where(np.arange(20) // 7 == 1, middle, 2.0)
        x_T = np.concatenate([[0.0], np.cumsum(speed_T) / 60])
        path_TN3 = np.stack([x_T, 0 * x_T, 0 * x_T], axis=1)[:, None] + scene.position_N3
        path_TN3[..., 1] += fall_T[:, None]
        found = outcome_of(case, [RolloutResult(path_TN3.astype(np.float32))])
        assert energy_rise(found) == pytest.approx(rise, abs=2e-3)


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
