"""Moving obstacles in their own frames: kernels find the surface where the collider of an obstacle at rest has it."""

import dataclasses
from collections import namedtuple

import numpy as np
import pytest
import taichi as ti
from mpm_scenes import BOX, CELL, CONFIG, box_corners, particles, sheet

from datagen.mpm.body_kernel import move_bodies, nearest_surface
from datagen.mpm.collider import HIDDEN, SEEN, build_collider
from datagen.mpm.device import initialise
from datagen.mpm.grid_launch import GridLaunch
from datagen.mpm.layout import BLOCK_NODES, KEY, STATE, VALUE
from datagen.mpm.mls_mpm import Integers, Scalars, Vectors
from hgn.scene.motion import Motion, turning
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import Obstacle
from hgn.scene.shapes import shape_obstacle

NODES = 24
MIDDLE = (NODES * CELL / 2,) * 3
Arrays = namedtuple("Arrays", ["pose", "contact", "contact_normal", "shape", "setting", "scene_value"])


@ti.kernel
def find_surfaces(
    normal: Vectors, other: Vectors, pose: Scalars, contact: Integers, contact_normal: Vectors, shape: Integers,
    setting: Scalars, scene_value: ti.types.ndarray(dtype=ti.f32, ndim=2),
):  # fmt: skip
    """Writes the contacts of both fields of all nodes in the bodies' first poses: the normal, and [friction, smallest
    mass, speed of the surface]."""
    arrays = ti.static(Arrays(pose, contact, contact_normal, shape, setting, scene_value))
    for _ in range(1):
        scene_value[0, VALUE.time_step] = 1e-6
        scene_value[0, VALUE.begins] = 1.0
        move_bodies(0, arrays)
    for i in range(NODES**3):
        for field in range(2):
            free = ti.Vector([0.0, 0.0, 0.0])
            index = ti.Vector([i // NODES**2, i // NODES % NODES, i % NODES])
            found, friction, least, velocity = nearest_surface(index, field, free, 0.0, 0.0, ti.math.inf, 0, arrays)
            normal[2 * i + field] = found
            other[2 * i + field] = ti.Vector([friction, least, velocity.norm()])


def launched(obstacle, **scene):
    own = {"domain_size": (NODES * CELL,) * 3, "particles_per_cell": 1.0} | scene
    one = particles([[0.4, 0.4, 0.4]], obstacles=(obstacle,), **own)
    return one, GridLaunch(initialise("cpu"), [one], [build_collider(one, 0.5)], CONFIG, (NODES,) * 3, 60.0)


def thin_plate():
    return Obstacle("plate", box_corners((-4, -0.15, -4), (4, 0.15, 4)) * CELL + np.array(MIDDLE), BOX, True)


# the fraction of nodes that only one of the two may claim, and of nodes within a cell of the surface that may have
# another normal or mass: interpolation rounds edges, and between two equally near faces directions are averaged
OBSTACLES = {
    "square": (shape_obstacle("square", 0.5, MIDDLE), 0.02, 0.0),
    "pyramid": (shape_obstacle("pyramid", 0.5, MIDDLE), 0.1, 0.18),
    "cone": (shape_obstacle("cone", 0.5, MIDDLE), 0.1, 0.1),
    "thin plate": (thin_plate(), 0.05, 0.1),
}


@pytest.mark.parametrize("name", OBSTACLES)
def test_contacts_in_a_turned_frame(name):
    """In random poses nodes have the contacts that build_collider gives to the same obstacle at rest in that pose."""
    obstacle, claims, normals = OBSTACLES[name]
    for seed in range(3):
        rng = np.random.default_rng(seed)
        pose = euler_rotation(tuple(rng.uniform(-180, 180, 3)))
        motion = Motion(np.zeros(1), rng.uniform(-CELL, CELL, (1, 3)), pose[None], MIDDLE)
        moving = dataclasses.replace(obstacle, motion=motion, friction=0.25)
        scene, launch = launched(moving)
        found, other = (ti.Vector.ndarray(3, ti.f32, 2 * NODES**3) for _ in range(2))
        arrays = (launch.pose, launch.contact, launch.contact_normal, launch.shape, launch.setting, launch.scene_value)
        find_surfaces(found, other, *arrays)
        found, other = (array.to_numpy().reshape(-1, 2, 3) for array in (found, other))
        launch.release()
        still = dataclasses.replace(moving.at(0.0), motion=None)
        collider = build_collider(dataclasses.replace(scene, obstacles=(still,)), 0.5)
        node = np.ravel_multi_index(tuple(collider.node_K3.T), (NODES,) * 3)
        others = np.setdiff1d(np.arange(NODES**3), node)
        for field in (SEEN, HIDDEN):
            expected, claimed = collider.normal_K23[:, field], found[node, field].any(axis=1)
            wrong = np.count_nonzero(claimed != expected.any(axis=1))
            if field == SEEN:  # only nodes with two fields have the other
                wrong += np.count_nonzero(found[others, field].any(axis=1))
            assert wrong <= claims * len(node)
            near = claimed & expected.any(axis=1) & (collider.distance_K2[:, field] <= 1)
            assert near.any() or not expected.any()
            cosine = (expected * found[node, field]).sum(axis=1)
            mass = other[node, field, 1] - collider.least_K2[:, field]
            assert np.count_nonzero(near & ((cosine < 0.95) | (np.abs(mass) > 0.02))) <= normals * near.sum()
            assert (other[node, field, 0][near] == 0.25).all() and not other[node, field, 2].any()


def test_poses_follow_the_keyframes():
    """After each frame a body has the place of its keyframes to 1e-4 cells, also where several lie within the frame and
    after the last, and its velocity is that between them."""
    time = np.array([0.004, 0.03, 0.033, 0.05, 0.1])
    turns = [(0, 0, 0), (0, 90, 20), (0, 90, 0), (170, 0, 0), (170, 0, 5)]
    move = np.random.default_rng(0).uniform(-0.1, 0.1, (5, 3))
    motion = Motion(time, move, np.stack([euler_rotation(turn) for turn in turns]), (0.5, 0.5, 0.5))
    corner = shape_obstacle("pyramid", 0.4, MIDDLE).vertex_V3
    scene, launch = launched(dataclasses.replace(shape_obstacle("pyramid", 0.4, MIDDLE), motion=motion))
    (body,) = launch.colliders[0].bodies
    for frame, _ in enumerate(launch._advance(8), 1):
        state = launch.pose.to_numpy()[1:]
        place, axes = state[STATE.end : STATE.end + 3], state[STATE.end + 3 : STATE.turn].reshape(3, 3)
        own = (corner - 0.5) / CELL @ body.key_TK[0, KEY.axes : KEY.turn].reshape(3, 3).T  # not turned at first
        assert np.abs(place + own @ axes - motion.place(corner, frame / 60) / CELL).max() < 1e-4
        (before, start), (after, end) = (motion.pose(frame / 60 - span) for span in (2e-4, 1e-4))
        turn, velocity = turning(after @ before.T) / 1e-4, (end - start) / 1e-4
        assert np.allclose(state[STATE.turn : STATE.turn + 3], turn, atol=1e-3)
        assert np.allclose(state[STATE.velocity : STATE.velocity + 3], velocity / CELL, atol=1e-3)
    assert body.obstacle == 0 and scene.moves
    launch.release()


def test_far_and_large_obstacles_take_little_memory():
    """An obstacle that never comes near the domain has no samples, one much larger than it those within its reach; a
    tilted sheet has at most twice the number of a level one."""
    up = Motion.of_frames([(0.0, (0, 0, 0)), (1.0, (0, 0.5, 0))], (0.0, 0.0, 0.0))
    for height, count in ((5.0, 0), (0.5, 1)):
        large = dataclasses.replace(sheet(height, -1e4, 1e4), motion=up)
        bodies = build_collider(particles([], obstacles=(large,)), 0.5).bodies
        assert len(bodies) == count and all(len(body.sample_S33) < 10 * BLOCK_NODES**2 for body in bodies)
    counts = []
    for angles in ((0, 0, 0), (30, 40, 50)):
        plate = shape_obstacle("square", 0.5, (0.5, 0.5, 0.5), rotation_33=euler_rotation(angles))
        plate = dataclasses.replace(plate, motion=up)
        fine = particles([], obstacles=(plate,), cell_size=CELL / 4)
        counts += [len(body.sample_S33) for body in build_collider(fine, 0.5).bodies]
    assert counts[1] < 2 * counts[0]
