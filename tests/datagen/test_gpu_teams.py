"""On a GPU: teams of one block and of several give what one launch a substep gives, also where not all fit."""

import dataclasses

import numpy as np
import pytest
import torch
from mpm_scenes import block, sheet

from hgn.config import MpmConfig
from hgn.scene.motion import Motion
from hgn.scene.rotation import euler_rotation
from hgn.scene.shapes import shape_obstacle


def _scene():
    low, high, room = (0.3, 0.35, 0.3), (0.5, 0.55, 0.5), {"obstacles": (sheet(0.3),), "cell_size": 1 / 32}
    return block(np.arange(3000) % 3, low, high, (0, -2, 0), count=3000, **room)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize(
    ("threads", "blocks", "run"), [(256, 1, 8), (128, 2, 8), (256, 4, 4), (128, 40, 1), (64, 8, 4), (256, 120, 8)]
)
def test_teams_agree_with_one_launch_a_substep(threads, blocks, run):
    """Three materials on a sheet: one frame agrees to 1e-6, ten to 2e-5 of the domain; as many substeps. With 120
    blocks of 256 threads two teams take three scenes.
    """
    from datagen.mpm.solver import Team, simulate

    config = MpmConfig(device="cuda")
    expected = simulate([_scene()], config, 11, 60.0, team=Team(0))
    _require_alike(expected * 3, simulate([_scene()] * 3, config, 11, 60.0, team=Team(threads, blocks, run)))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize(("threads", "blocks", "run"), [(256, 1, 8), (128, 40, 1), (256, 4, 4)])
def test_teams_agree_where_obstacles_move(threads, blocks, run):
    """The same with a sheet and a body that rise and turn, in a launch with a scene at rest."""
    from datagen.mpm.solver import Team, simulate

    turns = np.stack([euler_rotation((0.0, angle, angle / 5)) for angle in (0.0, 90.0)])
    motion = Motion(np.array([0.0, 1.0]), np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0]]), turns, (0.4, 0.3, 0.4))
    obstacles = (sheet(0.3), shape_obstacle("cone", 0.1, (0.6, 0.45, 0.4)))
    moving = tuple(dataclasses.replace(obstacle, motion=motion) for obstacle in obstacles)
    scenes, config = [_scene(), dataclasses.replace(_scene(), obstacles=moving)], MpmConfig(device="cuda")
    expected = simulate(scenes, config, 11, 60.0, team=Team(0))
    _require_alike(expected, simulate(scenes, config, 11, 60.0, team=Team(threads, blocks, run)))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_blocks_that_do_not_fit_end_in_one_launch_a_substep(monkeypatch):
    """4,000 blocks of 512 threads that wait for each other are more than any GPU runs at once: a warning, no hang, and
    the right result, apart from the order of sums.
    """
    from datagen.mpm import solver

    monkeypatch.setattr(solver, "_teams_at_once", lambda device, team: 1)
    config = MpmConfig(device="cuda")
    expected = solver.simulate([_scene()], config, 11, 60.0, team=solver.Team(0))
    with pytest.warns(RuntimeWarning, match="does not run the 4000 blocks"):
        found = solver.simulate([_scene()], config, 11, 60.0, team=solver.Team(512, 4000))
    _require_alike(expected, found)


def _require_alike(expected, found):
    from datagen.mpm.solver import Simulated

    for one, other in zip(found, expected, strict=True):
        assert isinstance(one, Simulated) and isinstance(other, Simulated)
        away_T = np.abs(one.position_TN3 - other.position_TN3).max(axis=(1, 2))
        assert away_T[1] < 1e-6 and away_T.max() < 2e-5
        assert one.counters["substeps"] == other.counters["substeps"]
