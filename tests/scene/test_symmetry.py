"""The symmetries of a scene, and which of them a sample is shown under."""

from collections import Counter

import numpy as np

from hgn.data.sampler import EpisodeSampler
from hgn.scene.symmetry import Symmetry, drawn_symmetry, scene_symmetries

CUBE = (1.0, 1.0, 1.0)
DOWN = (0.0, -9.8, 0.0)
CELL_SIZE = 1 / 64


def matrix_of(symmetry):
    """The linear part, [3, 3]."""
    matrix = np.zeros((3, 3))
    for i, (source, mirrored) in enumerate(zip(symmetry.source, symmetry.mirrored, strict=True)):
        matrix[i, source] = -1 if mirrored else 1
    return matrix


def matrices(symmetries):
    return {(matrix_of(symmetry) + 0.0).astype(np.int8).tobytes() for symmetry in symmetries}


def square_about_y():
    """Quarter turns about y, and each after a mirror of x."""
    turn, mirror = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.diag([-1, 1, 1])
    turns = [np.linalg.matrix_power(turn, k) for k in range(4)]
    return turns + [t @ mirror for t in turns]


def test_the_eight_of_a_square():
    """In a cube with gravity along an axis they are the quarter turns about it and their mirrors, identity first; where
    the other sides differ the identity, two mirrors and the half turn."""
    found = scene_symmetries(DOWN, CUBE, CELL_SIZE)
    assert len(found) == 8 and found[0] == Symmetry(cells=(63, 63, 63))
    assert matrices(found) == {m.astype(np.int8).tobytes() for m in square_about_y()}
    tunnel = scene_symmetries(DOWN, (1.0, 1.0, 2.0), CELL_SIZE)
    expected = [np.diag(signs).astype(np.int8) for signs in ([1, 1, 1], [-1, 1, 1], [1, 1, -1], [-1, 1, -1])]
    assert matrices(tunnel) == {m.tobytes() for m in expected}
    assert tunnel[0].cells == (63, 63, 127)
    assert len(scene_symmetries((0.0, 0.0, 1.0), CUBE, CELL_SIZE)) == 8


def test_any_gravity():
    """Without gravity all 48 of the cube remain, with an oblique one those that keep it; every set is a group."""
    counts = {(0.0, 0.0, 0.0): 48, (1.0, 1.0, 0.0): 4, (-2.0, -2.0, -2.0): 6, (1.0, -1.0, 0.0): 4, (1.0, 2.0, 3.0): 1}
    for gravity, count in counts.items():
        group = scene_symmetries(gravity, CUBE, CELL_SIZE)
        assert len(matrices(group)) == len(group) == count
        linear = [matrix_of(symmetry) for symmetry in group]
        for first in linear:
            np.testing.assert_array_equal(first @ gravity, gravity)
        products = {(a @ b + 0.0).astype(np.int8).tobytes() for a in linear for b in linear}
        assert products == matrices(group)


def test_draws_are_uniform_and_belong_to_the_seed():
    """Over 16,000 seeds of an order, or in a row, each of the eight is drawn within five standard deviations as often
    as the others; the same seed draws the same."""
    group = scene_symmetries(DOWN, CUBE, CELL_SIZE)
    order = EpisodeSampler(0, 16_000, lambda _: [1_001] * 16)
    spread = (16_000 / 8 * 7 / 8) ** 0.5
    for seeds in ([sample.seed for sample in order.next_batch()], range(16_000)):
        drawn = [drawn_symmetry(group, seed) for seed in seeds]
        counts = Counter(drawn)
        assert set(counts) == set(group)
        assert max(abs(count - 2_000) for count in counts.values()) < 5 * spread
        assert drawn[:100] == [drawn_symmetry(group, seed) for seed in list(seeds)[:100]]
    assert drawn_symmetry(group[:1], 5) == group[0]


def test_codes_tell_all():
    """A code holds source, mirror and cells of each axis, in 20 bits each; mirrors take nodes to nodes: of 64, the
    three at the lower wall to the three at the upper one, and the other way round."""
    nodes = np.arange(64) * CELL_SIZE
    for symmetry in scene_symmetries((0.0, 0.0, 0.0), CUBE, CELL_SIZE):
        np.testing.assert_array_equal(symmetry.mirror_sum[0] - nodes, nodes[::-1])
        assert symmetry.code < 2**60
        parts = [symmetry.code >> 20 * i for i in range(3)]
        assert tuple(part & 3 for part in parts) == symmetry.source
        assert tuple(bool(part >> 2 & 1) for part in parts) == symmetry.mirrored
        assert tuple(part >> 3 & 131071 for part in parts) == symmetry.cells
