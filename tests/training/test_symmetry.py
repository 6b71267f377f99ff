"""Symmetry augmentation on backend torch."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from equality import assert_same
from network.states import gns_of, network_of, random_grid
from scene.test_symmetry import matrix_of
from training.test_noise import episode

from hgn.config import TrainingConfig
from hgn.data.batch import make_batch
from hgn.network.obstacles import ObstacleCells
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.symmetry import drawn_symmetry, scene_symmetries
from hgn.training.symmetry import drawn_symmetries, obstacles_under, under_symmetries
from hgn.training.torch_updates import batch_loss

CELL_SIZE = 1 / 64
EIGHT = scene_symmetries((0.0, -9.8, 0.0), (1.0, 1.0, 1.0), CELL_SIZE)
ALL_48 = scene_symmetries((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), CELL_SIZE)
CENTRE = np.full(3, 63 / 128)  # of the solver's nodes


def scene_with_obstacles(seed, particles=12, cells=4_000):
    """Particles in the middle of random obstacle cells, as random as their motion."""
    made, grid = episode(particles, seed=seed), random_grid(seed, cells)
    middle = 0.25 + 0.02 * np.random.default_rng(seed).normal(size=(1, particles, 3))
    position = (made.position_TN3 - made.position_TN3[:1] + middle).astype(np.float32)
    grid = replace(grid, friction_K=np.random.default_rng(seed).random(len(grid.cell_K3)).astype(np.float32))
    return replace(made, position_TN3=position, obstacle_grid=grid, wall_friction=(0.75, 0.25, 0.5))


def seeds_of(symmetries, group=EIGHT):
    """A seed for each, that draws it from the group, of different noise."""
    found, seed = [], 100
    for symmetry in symmetries:
        seed += 1
        while drawn_symmetry(group, seed) != symmetry:
            seed += 1
        found.append(seed)
    return tuple(found)


def doubled(batch):
    names = ("window_WN3", "domain_S3", "gravity_S3", "wall_friction_S3")
    return replace(batch, **{n: getattr(batch, n).double() for n in names if getattr(batch, n) is not None})


def by_hand(batch, episodes, symmetries):
    """The batch of the images, each scene multiplied by its matrix about the centre of the solver's nodes."""
    windows, grids = [], []
    parts = batch.window_WN3.numpy().astype(np.float64)
    for scene, (made, symmetry) in enumerate(zip(episodes, symmetries, strict=True)):
        matrix = matrix_of(symmetry)
        windows.append((parts[:, batch.scene_N.numpy() == scene] - CENTRE) @ matrix.T + CENTRE)
        centre = (made.obstacle_grid.cell_K3 + 0.5) * CELL_SIZE
        cell = np.floor(((centre - CENTRE) @ matrix.T + CENTRE) / CELL_SIZE).astype(np.int32)
        order = np.lexsort(cell.T[::-1])
        normal = (made.obstacle_grid.normal_K3 @ matrix.T).astype(np.float32)
        grids.append(ObstacleGrid(CELL_SIZE, cell[order], normal[order], made.obstacle_grid.friction_K[order]))
    pairs = zip(symmetries, batch.gravity_S3, strict=True)
    walls = [np.abs(matrix_of(s)) @ made.wall_friction for s, made in zip(symmetries, episodes, strict=True)]
    return replace(
        batch,
        window_WN3=torch.from_numpy(np.concatenate(windows, axis=1)),
        gravity_S3=torch.stack([torch.tensor(matrix_of(symmetry)) @ gravity_3 for symmetry, gravity_3 in pairs]),
        obstacles=ObstacleCells.of(grids) if batch.obstacles is not None else None,
        wall_friction_S3=None if batch.wall_friction_S3 is None else torch.tensor(np.array(walls)),
    )


def loss_and_gradients(network, batch, symmetry):
    loss = batch_loss(network, batch, TrainingConfig(symmetry=symmetry))
    found = torch.autograd.grad(loss, list(network.parameters()), allow_unused=True)
    return float(loss.detach()), torch.cat([g.flatten() for g in found if g is not None])


@pytest.mark.parametrize(
    ("network", "shown"),
    [
        (network_of(levels=2, message_passing_steps=1), EIGHT),
        (network_of(levels=2, message_passing_steps=1, inputs="relative"), ALL_48[::6]),
        (network_of(levels=2, message_passing_steps=1, inputs="relative", own_physics=("friction",)), ALL_48[1::6]),
        (gns_of(message_passing_steps=1, cell_size=0.05), EIGHT[5:7]),
    ],
    ids=["hgn", "relative", "friction", "gns"],
)
def test_training_sees_the_image(network, shown):
    """With noise and grid jitter, loss and gradients of a batch whose samples draw each of the symmetries are those of
    the batch of images made by hand, to 1e-6 (positions of float32) or better; and not those of the batch itself."""
    episodes = [scene_with_obstacles(i, cells=4_000) for i in range(len(shown))]
    group = ALL_48 if network.config.relative else EIGHT
    batch = doubled(make_batch([(e, 6) for e in episodes], network.config, seeds_of(shown, group)))
    assert drawn_symmetries(batch) == list(shown)
    loss, gradient = loss_and_gradients(network, batch, "gravity")
    image = by_hand(batch, episodes, shown)
    assert_same(under_symmetries(batch, shown).wall_friction_S3, image.wall_friction_S3, "walls")
    expected_loss, expected = loss_and_gradients(network, image, "none")
    bound = 1e-10
    assert loss == pytest.approx(expected_loss, rel=bound)
    assert float((gradient - expected).norm() / expected.norm()) < bound
    other_loss, other = loss_and_gradients(network, batch, "none")
    assert abs(other_loss - loss) > 1e-4 * loss and float((gradient - other).norm() / expected.norm()) > 1e-3


def test_a_particle_on_a_face_takes_the_cell_above_in_the_image():
    """At 10 cells exactly, mirrored to 53, a particle has the image's cell 53, which is the scene's cell 9."""
    (mirror,) = (s for s in EIGHT if s.source == (0, 1, 2) and s.mirrored == (True, False, False))
    cell = np.array([[9, 5, 5], [10, 5, 5]], np.int32)
    normal = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], np.float32)
    cells = ObstacleCells.of([ObstacleGrid(CELL_SIZE, cell, normal)])
    assert cells is not None
    point, scene = torch.tensor([[53, 5.5, 5.5]], dtype=torch.float64) * CELL_SIZE, torch.zeros(1, dtype=torch.long)
    assert obstacles_under(cells, [mirror]).normals(point, scene).tolist() == [[-1.0, 0.0, 0.0]]


def test_symmetries_belong_to_samples_and_data_stay():
    """The symmetry of a sample depends only on its seed. The identity and the setting `none` change no bit of the
    data."""
    episodes = [scene_with_obstacles(i) for i in range(3)]
    config = network_of().config
    together = make_batch([(e, 6) for e in episodes], config, (7, 8, 9))
    alone = make_batch([(episodes[1], 6)], config, (8,))
    assert drawn_symmetries(together)[1] == drawn_symmetries(alone)[0]
    before = together.window_WN3.clone()
    under_symmetries(together, [EIGHT[7]] * 3)
    assert torch.equal(together.window_WN3, before)
    same = under_symmetries(together, [EIGHT[0]] * 3)
    assert torch.equal(same.window_WN3, before)
    assert same.obstacles is not None and together.obstacles is not None
    assert torch.equal(same.obstacles.key_K, together.obstacles.key_K)
    assert torch.equal(same.obstacles.normal_K3, together.obstacles.normal_K3)
