"""Scenes by kind: sound, of their kind, and the same on every machine."""

import functools
import hashlib
import json
from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scene.test_random_scene import digest, surface_distances

from hgn.config import DatagenConfig, SceneConfig
from hgn.data.identity import dataset_identity
from hgn.scene.distance import contains
from hgn.scene.group import WALL_CELLS
from hgn.scene.kinds import ELASTIC_KINDS, MOVING_RANGES, SCENE_KINDS, fastest
from hgn.scene.own_physics import with_elastic_bodies
from hgn.scene.random_scene import generate_scene
from hgn.scene.rotation import quaternion_rotation
from hgn.scene.world import DOMAINS, MAXIMUM_PARTICLES, NEAR_WALL, NEAREST_CELLS, RANGES, draw_kind
from hgn.schema import ConfigError

LARGEST = (2.0, 1.5, 1.5)
CELL = 1 / 64


@functools.cache
def scene_of(kind, seed):
    return generate_scene(SceneConfig(domain_size=LARGEST, kinds={kind: 1.0}), seed)


def bodies(scene):
    """Record and particles of each body."""
    records = scene.specification["groups"]
    ends = np.cumsum([record["particle_count"] for record in records])
    return list(zip(records, np.split(scene.position_N3.astype(np.float64), ends[:-1]), strict=True))


@pytest.mark.parametrize("kind", SCENE_KINDS)
def test_scenes_of_a_kind_are_sound(kind):
    """Whole cells, particles between the walls and clear of obstacles and of other bodies, meshes rebuilt from the
    record, never too many particles, the same bits again, and not the same scene for another seed."""
    digests = set()
    for seed in range(4):
        scene = scene_of(kind, seed)
        position_N3, size_3 = scene.position_N3.astype(np.float64), np.array(scene.domain_size)
        assert tuple((size_3 / CELL).tolist()) in DOMAINS.values() and scene.specification["layout"] == kind
        assert 100 < scene.particle_count <= MAXIMUM_PARTICLES
        assert (position_N3 > WALL_CELLS * CELL).all() and (position_N3 < size_3 - WALL_CELLS * CELL).all()
        for obstacle in scene.obstacles:
            assert (obstacle.vertex_V3 >= 0).all() and (obstacle.vertex_V3 <= size_3).all()
            assert surface_distances(position_N3[::5], obstacle).min() > NEAREST_CELLS * CELL
            assert not contains(position_N3, obstacle).any()
        parts = [part for _, part in bodies(scene)]
        for i, one in enumerate(parts):
            for other in parts[:i]:
                assert np.sqrt(((one[::3, None] - other[None, ::5]) ** 2).sum(axis=2)).min() > NEAREST_CELLS * CELL
        digests.add(digest(scene))
    assert len(digests) == 4 and digest(scene_of.__wrapped__(kind, 0)) in digests


GOLDEN = "22c6ec30"  # of one scene of each kind


def test_a_kind_is_bitwise_the_same_everywhere():
    """Each kind has its ranges, and a seed gives the same scene on every machine, in every release."""
    assert tuple(RANGES) == SCENE_KINDS
    together = " ".join(digest(scene_of(kind, 3)) for kind in SCENE_KINDS)
    assert hashlib.sha256(together.encode()).hexdigest()[:8] == GOLDEN


def tilt_of(record):
    """The tangent of half the angle between an obstacle's own y axis and the world's."""
    cosine = quaternion_rotation(tuple(record["quaternion"]))[1, 1]
    return np.sqrt((1 - cosine) / (1 + cosine))


# what makes a scene one of its kind: of (specification, scene)
def is_pool(scene):
    record, position_N3 = bodies(scene)[0]
    inner_3 = np.array(scene.domain_size) - 2 * WALL_CELLS * CELL
    low, high = RANGES["pool"]["depth"]
    wide = np.allclose(np.array(record["size"])[[0, 2]], inner_3[[0, 2]], atol=1e-5)
    return wide and low <= record["size"][1] <= high and position_N3[:, 1].min() < WALL_CELLS * CELL + 0.01


def is_edge(scene):
    (plate,), (body,) = scene.specification["obstacles"], scene.specification["groups"]
    beyond = abs(body["position"][0] - plate["position"][0]) - plate["size"] / 2
    low, high = RANGES["edge"]["beyond"]
    return low - 1e-9 <= beyond <= high + 1e-9 and body["position"][1] > plate["position"][1]


def is_slope(scene):
    (plate,) = scene.specification["obstacles"]
    low, high = RANGES["slope"]["tilt"]
    return low - 1e-6 <= tilt_of(plate) <= high + 1e-6


def is_dam(scene):
    (_, position_N3), *floor = bodies(scene)
    width = scene.domain_size[2] - 2 * WALL_CELLS * CELL
    wet = all(record["material"] == "water" and np.ptp(part[:, 1]) < 0.05 for record, part in floor)
    return np.ptp(position_N3[:, 2]) > 0.9 * width and np.ptp(position_N3[:, 0]) < 0.31 and wet


def is_apart(scene):
    lowest = [part[:, 1].min() for _, part in bodies(scene)]
    speeds = [np.linalg.norm(record["velocity"]) for record, _ in bodies(scene)]
    return max(lowest) < WALL_CELLS * CELL + 0.02 and max(speeds) <= RANGES["apart"]["speed"][1] and len(speeds) > 1


@pytest.mark.parametrize("holds", [is_pool, is_edge, is_slope, is_dam, is_apart])
def test_a_scene_is_of_its_kind(holds):
    kind = holds.__name__.removeprefix("is_")
    assert all(holds(scene_of(kind, seed)) for seed in range(8))


def test_some_bodies_are_next_to_a_wall():
    """About a quarter of the coordinates along a wall's normal, and not all at the same distance."""
    gaps = []
    for seed in range(40):
        scene = scene_of("apart", seed)
        low, high = WALL_CELLS * CELL, scene.domain_size[0] - WALL_CELLS * CELL
        gaps += [min(part[:, 0].min() - low, high - part[:, 0].max()) for _, part in bodies(scene)]
    near = [gap for gap in gaps if gap < NEAR_WALL]
    assert 0.25 < len(near) / len(gaps) < 0.5 and max(near) > 0.06 and min(near) < 0.02


def test_half_of_the_stacks_are_cubes_of_one_material():
    records = [scene_of("stack", seed).specification["groups"] for seed in range(24)]
    alike = [
        len({(r["shape"], r["material"]) for r in stack}) == 1 and stack[0]["shape"] == "cube" for stack in records
    ]
    assert 8 <= sum(alike) <= 18


def test_gravity_is_as_large_however_it_is_tilted():
    sizes = [np.linalg.norm(scene_of("pool", seed).gravity) for seed in range(20)]
    across = [np.linalg.norm(np.array(scene_of("pool", seed).gravity)[[0, 2]]) for seed in range(20)]
    assert np.allclose(sizes, 9.8) and 4 <= np.count_nonzero(across) <= 17 and 9.8 * 0.5 < max(across) < 9.8 * 0.72


def test_kinds_are_drawn_by_their_shares():
    """Within four standard deviations; a share of 0 is never drawn, and only relative sizes matter."""
    rng, shares = np.random.Generator(np.random.PCG64(1)), {"pool": 1.0, "dam": 3.0, "jet": 0.0, "edge": 4.0}
    count = Counter(draw_kind(shares, rng) for _ in range(4000))
    for kind, share in shares.items():
        expected = share / 8
        assert abs(count[kind] / 4000 - expected) <= 4 * np.sqrt(expected * (1 - expected) / 4000)


def test_the_fastest_scene():
    """The largest initial speed is that of the fastest kind that is drawn; without kinds it is the setting."""
    assert fastest(SceneConfig(kinds={"pool": 1.0, "drop": 0.5, "jet": 0.0})) == RANGES["drop"]["speed"][1]
    assert fastest(SceneConfig(kinds={"pool": 1.0})) == 0.0
    assert fastest(SceneConfig(maximum_initial_speed=2.0)) == 2.0


def test_a_kind_that_fits_into_no_domain_is_refused():
    """The message names the kind and the setting to change."""
    with pytest.raises(ConfigError, match=r"kinds must fit .* got jet; raise domain_size or leave"):
        generate_scene(SceneConfig(domain_size=(0.4, 1.0, 0.4), kinds={"jet": 1.0}), 0)


def test_a_sixth_of_the_scenes_draws_elastic_bodies():
    """Only kinds of solid bodies, half of them of no other material, beams too; other scenes stay as they are."""
    plain = SceneConfig(domain_size=LARGEST, kinds={"pool": 9.0, "drop": 1.0}, particles_per_cell=0.1)
    config = replace(plain, own_physics=("elastic",))
    drawn = {seed: own for seed in range(600) if (own := with_elastic_bodies(config, seed)) is not config}
    assert 70 < len(drawn) < 130 and all(own.kinds == {"drop": 1.0} for own in drawn.values())
    alone = [seed for seed, own in drawn.items() if own.materials == ("elastic",)]
    assert 0.35 < len(alone) / len(drawn) < 0.65
    groups = [generate_scene(config, seed).specification["groups"][0] for seed in alone[:20]]
    assert {(group["material"], group["shape"]) for group in groups} == {
        ("elastic", s) for s in ("cube", "sphere", "box")
    }
    seed = next(seed for seed in range(600) if seed not in drawn)
    assert digest(generate_scene(config, seed)) == digest(generate_scene(plain, seed))


def test_what_scenes_draw_of_own_physics_is_independent():
    """Each of friction, parameters, elastic bodies and moving obstacles with each other, within four deviations of the
    product of their fractions; but friction and parameters, of which half of the scenes have neither."""
    physics = ("friction", "parameters", "elastic", "moving")
    kinds = {"drop": 1.0, "apart": 1.0}
    config = SceneConfig(domain_size=LARGEST, kinds=kinds, particles_per_cell=0.1, own_physics=physics)
    scenes = [generate_scene(config, seed) for seed in range(500)]
    has = {
        "friction": [any(s.wall_friction) for s in scenes],
        "parameters": [bool(s.material_parameters) for s in scenes],
        "elastic": [with_elastic_bodies(config, seed) is not config for seed in range(500)],
        "moving": [s.specification["layout"] in MOVING_RANGES for s in scenes],
    }
    for one, other in combinations(physics, 2):
        if {one, other} != {"friction", "parameters"}:
            expected = sum(has[one]) * sum(has[other]) / 500
            both = sum(map(min, has[one], has[other]))
            assert abs(both - expected) < 4 * np.sqrt(expected), (one, other, both, expected)
    elastic = {s.specification["layout"] for s, own in zip(scenes, has["elastic"], strict=True) if own}
    assert elastic <= set(ELASTIC_KINDS) and len(elastic) > 3


def test_half_of_the_scenes_draws_friction_or_parameters():
    """A third each, a sixth both. Scenes with neither are the ones of a data set without own physics, bit by bit."""
    plain = SceneConfig(domain_size=LARGEST, kinds={"drop": 1.0}, particles_per_cell=0.1)
    scenes = [generate_scene(replace(plain, own_physics=("friction", "parameters")), seed) for seed in range(300)]
    rough, varied = [any(s.wall_friction) for s in scenes], [bool(s.material_parameters) for s in scenes]
    assert 75 < sum(rough) < 125 and 75 < sum(varied) < 125 and 30 < sum(map(min, rough, varied)) < 70
    seed = next(seed for seed in range(300) if not (rough[seed] or varied[seed]))
    assert digest(scenes[seed]) == digest(generate_scene(plain, seed))


def test_kinds_belong_to_the_identity_of_a_data_set():
    plain, world = DatagenConfig(), DatagenConfig(scene=SceneConfig(kinds={"pool": 1.0}))
    assert "kinds" not in dataset_identity(plain)["scene"]
    assert dataset_identity(world)["scene"]["kinds"] == {"pool": 1.0}
    json.dumps(dataset_identity(replace(world)))
