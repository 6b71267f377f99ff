"""Tests the limits of what a page keeps and saves."""

import tracemalloc
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install 'hgn[play]'")
from hgn.scene.rollout_file import read_rollout, write_rollout
from hgn.scene.scene_file import ObstacleEntry
from hgn.viewer.placed import placed_by
from hgn.viewer.recording import Frame, Recording


def frame(particles, obstacles=()):
    return Frame(
        np.zeros((particles, 3), np.float32), np.zeros((particles, 3), np.float32), tuple(obstacles), (0, 0, 0)
    )


def recorded(limit, frames):
    recording, entered = Recording(limit), 0
    for each in frames:
        added = len(each.position_N3) - entered
        entered += added
        recording.enter(np.zeros(added, np.uint8), np.zeros((added, 1, 3), np.float32))
        recording.append(each)
    return recording


def saved(recording):
    return recording.rollout((1.0, 1.0, 1.0), 60.0, 1 / 32, {})


def cone(size=0.3):
    return placed_by(ObstacleEntry(shape="cone", size=size, position=(0.5, 0.5, 0.5)), None, 1 / 32)


def test_places_of_obstacles_count():
    """Frames with obstacles that moved take as much as their places, also after some were dropped or deleted."""
    cones = [cone(0.1) for _ in range(20)]
    at_rest = recorded(50_000, [frame(10, cones) for _ in range(200)])
    moved = [frame(10, [replace(one, position=(0.5, 0.5, 1e-3 * k)) for one in cones]) for k in range(200)]
    recording = recorded(50_000, moved)
    assert 3 < len(recording.frames) < 10 and len(at_rest.frames) > 50
    recording.back_to(198)
    frames = [*recording.frames]
    places = sum(before.bytes_before(after) for before, after in pairwise(frames))
    assert recording.bytes == sum(each.bytes for each in frames) + places <= 50_000


def test_a_saved_rollout_is_within_the_limit():
    """It has the newest frames, of which each counts with the newest particles and all vertices."""
    one, vertices = cone(), len(cone().body.mesh.vertex_V3)
    early, late = [frame(5, [one]) for _ in range(50)], [frame(500, [replace(one, position=(0.1, 0.1, 0.1))])]
    recording = recorded(20 * 24 * (500 + vertices), early + late)
    assert len(recording.frames) == 51
    rollout = saved(recording)
    assert rollout.position_TN3.shape == (20, 500, 3) and rollout.entry_frame_N[-1] == 19
    assert np.isnan(rollout.position_TN3[:19, 5:]).all() and np.isfinite(rollout.position_TN3[:, :5]).all()
    (obstacle,) = rollout.obstacles
    assert [obstacle.motion.pose(time)[1][0] for time in (0, 18 / 60, 19 / 60)] == pytest.approx([0, 0, -0.4])


def test_files_are_written_in_pieces(tmp_path, monkeypatch):
    """The memory of writing does not grow with the frames: all vertices of obstacles are in each frame."""
    one = cone()
    vertices = len(one.body.mesh.vertex_V3)
    rollout = saved(recorded(1 << 30, [frame(5, [one]) for _ in range(150_000 // vertices)]))
    write_rollout(tmp_path / "whole.vtkhdf", rollout)
    monkeypatch.setattr("hgn.scene.rollout_file.POINTS_OF_A_WRITE", 10_000)
    tracemalloc.start()
    try:
        write_rollout(tmp_path / "pieces.vtkhdf", rollout)
        assert tracemalloc.get_traced_memory()[1] < 3 << 20  # 24 bytes of each point take 3.6 MB together
    finally:
        tracemalloc.stop()
    whole, pieces = (read_rollout(tmp_path / f"{name}.vtkhdf") for name in ("whole", "pieces"))
    np.testing.assert_array_equal(pieces.position_TN3, whole.position_TN3)
