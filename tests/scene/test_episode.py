"""Tests the episode codec: it loses nothing, equal input gives equal bytes, and errors name each fault."""

import dataclasses
import io
import json
import pickle
from typing import Any

import numpy as np
import pytest
from equality import assert_same
from hypothesis import given, settings
from hypothesis import strategies as st

from hgn.data.shard import episode_tar
from hgn.scene import episode as episode_module
from hgn.scene.episode import Episode, decode_episode, encode_episode
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.schema import ConfigError


def members_of(episode):
    return {name: b"".join(parts) for name, parts in encode_episode(episode).items()}


def make_episode(frames=4, particles=5, cells=3, seed=0, **changes):
    generator = np.random.default_rng(seed)
    normal_K3 = generator.normal(size=(cells, 3))
    values: dict[str, Any] = {
        "key": "train-000012",
        "position_TN3": generator.random((frames, particles, 3)).astype(np.float32),
        "initial_velocity_N3": generator.normal(size=(particles, 3)).astype(np.float32),
        "material_N": generator.integers(0, 3, particles).astype(np.uint8),
        "obstacle_grid": ObstacleGrid(
            cell_size=1 / 64,
            cell_K3=np.stack([np.arange(cells)] * 3, axis=1).astype(np.int32),
            normal_K3=(normal_K3 / np.linalg.norm(normal_K3, axis=1, keepdims=True)).astype(np.float32),
        ),
        "domain_size": (1.0, 2.0, 1.0),
        "gravity": (0.0, -9.8, 0.0),
        "frame_rate_hz": 60.0,
        "seed": 2**62 + 7,
        "specification": {"groups": [{"shape": "cube", "centre": [0.1, 0.2, 0.3]}]},
        "solver": {"substeps": 1234, "projections": 0},
    }
    return Episode(**(values | changes))


@settings(max_examples=25, deadline=None)
@given(frames=st.integers(1, 4), particles=st.integers(0, 9), cells=st.integers(0, 4), seed=st.integers(0, 2**32))
def test_roundtrip(frames, particles, cells, seed):
    """Decoding returns every field bitwise, for any sizes, an empty scene and no obstacles included."""
    parameters = {"youngs_modulus": np.linspace(1, 2, particles, dtype=np.float32)}
    episode = make_episode(frames, particles, cells, seed, material_parameters=parameters)
    members = members_of(episode)
    assert "parameter_youngs_modulus.npy" in members
    assert_same(episode, decode_episode(episode.key, members))


def test_members():
    """Memory layout and key order of the input leave no trace in the stored bytes, and NumPy and JSON alone read them.
    Members given as arrays are not copied."""
    episode = make_episode()
    members, solver = members_of(episode), dict(reversed(episode.solver.items()))
    other = dataclasses.replace(episode, position_TN3=np.asfortranarray(episode.position_TN3), solver=solver)
    assert members_of(other) == members
    position = np.load(io.BytesIO(members["position.npy"]), allow_pickle=False)
    assert np.array_equal(position, episode.position_TN3) and json.loads(members["json"])["seed"] == episode.seed
    flat = {name: np.frombuffer(data, np.uint8) for name, data in members.items()}
    decoded = decode_episode(episode.key, flat)
    assert np.shares_memory(decoded.position_TN3, flat["position.npy"])
    assert not decoded.position_TN3.flags.writeable


def grid(cell_size=1 / 64, dtype=np.int32, normals=3, cells=((0, 0, 0),) * 3):
    return {"obstacle_grid": ObstacleGrid(cell_size, np.array(cells, dtype), np.zeros((normals, 3), np.float32))}


BROKEN_FIELDS: list[tuple[dict[str, Any], str]] = [
    (grid(normals=2), "obstacle_normal must have shape"),
    (grid(dtype=np.int64), "obstacle_cell must be of type int32"),
    (grid(cell_size=0.0), "cell_size must be from 1e-9 to 1e9"),
    (grid(cell_size=5e-324), "cell_size must be from 1e-9 to 1e9"),
    (grid(), "obstacle_cell must be sorted and unique"),
    (grid(cells=[[1, 0, 0], [0, 5, 5], [2, 0, 0]]), "obstacle_cell must be sorted and unique"),
    (grid(cells=[[-(2**31), 0, 0], [0, 0, 0], [1, 0, 0]]), "obstacle_cell must be at most 65535 in size"),
    ({"key": "train.000012"}, "key must be letters"),
    ({"key": ""}, "key must be letters"),
    ({"position_TN3": np.zeros((0, 5, 3), np.float32)}, "position must have shape"),
    ({"position_TN3": np.zeros((4, 5), np.float32)}, "position must have shape"),
    ({"position_TN3": np.zeros((4, 5, 3))}, "position must be of type float32, got float64"),
    ({"initial_velocity_N3": np.zeros((4, 3), np.float32)}, "velocity must have shape"),
    ({"initial_velocity_N3": np.full((5, 3), np.nan, np.float32)}, "velocity must be finite, got nan at"),
    ({"material_N": np.zeros(5, np.int64)}, "material must be of type uint8"),
    ({"material_N": np.full(5, 4, np.uint8)}, r"material must be 0 to 3 \(.*\), got 4"),
    ({"frame_rate_hz": float("nan")}, "frame_rate_hz must be from 1e-9 to 1e9"),
    ({"domain_size": (1.0, 0.0, 1.0)}, r"domain_size\[1\] must be from 1e-9 to 1e9"),
    ({"gravity": (0.0, 1e300, 0.0)}, r"gravity\[1\] must be at most 1e15 in size"),
    ({"gravity": (0.0, float("inf"), 0.0)}, r"gravity\[1\] must be finite"),
    ({"material_parameters": {"e": np.zeros(4, np.float32)}}, "parameter_e must have shape"),
    ({"material_parameters": {"a.b": np.zeros(5, np.float32)}}, "parameter names must be"),
]


@pytest.mark.parametrize(("changes", "message"), BROKEN_FIELDS)
def test_wrong_fields_are_refused(changes, message):
    """An episode with a wrong shape, type or value cannot be made, and the message names the field."""
    with pytest.raises(ConfigError, match=message):
        make_episode(**changes)


def test_arrays_are_written_from_their_own_memory():
    """The parts of a tar include the positions themselves: a copy of all episodes of a launch would cost seconds."""
    episode = make_episode()
    parts = [np.frombuffer(part, np.uint8) for part in episode_tar(episode) if len(part)]
    assert any(np.shares_memory(part, episode.position_TN3) for part in parts)


def test_frames_are_not_checked_one_by_one(monkeypatch):
    """Sound positions need no call per frame: at each call a thread waits for the others that check episodes."""
    episode, calls = make_episode(), []
    monkeypatch.setattr(episode_module, "_require_within", lambda *arguments: calls.append(arguments))
    members_of(episode)
    assert not calls


@pytest.mark.parametrize("frames_per_block", [1, 2, 3, 4])
def test_positions_that_are_not_finite_are_refused_both_ways(monkeypatch, frames_per_block):
    """Writing and reading both refuse NaN, and the message names frame and particle."""
    episode = make_episode()
    monkeypatch.setattr(episode_module, "_BLOCK_PARTICLES", frames_per_block * episode.particle_count)
    position = episode.position_TN3.copy()
    position[2, 3, 1] = np.nan
    with pytest.raises(ConfigError, match=r"position must be finite, got nan at \[3, 1\] in frame 2"):
        members_of(dataclasses.replace(episode, position_TN3=position))
    with pytest.raises(ConfigError, match="position must be finite"):
        decode_episode(episode.key, members_of(episode) | {"position.npy": npy(position)})


@pytest.mark.parametrize("value", [float("nan"), np.int64(3), {1, 2}])
def test_what_is_not_json_is_refused(value):
    """Solver counters and specifications are plain JSON; a NaN would not be readable elsewhere."""
    with pytest.raises(ConfigError, match="must be plain JSON"):
        members_of(make_episode(solver={"x": value}))


def npy(array, **options):
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, **options)
    return buffer.getvalue()


def description(**changes):
    mapping = json.loads(members_of(make_episode())["json"]) | changes
    return json.dumps({key: value for key, value in mapping.items() if value is not None}).encode()


def headed(header):
    """A .npy file with any header, and nothing behind it."""
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()


def specified(**specification):
    return {"json": description(specification=specification)}


def random_scene(**changes):
    """A random scene with one obstacle."""
    record = {"shape": "cone", "size": 0.3, "position": [0.5, 0.2, 0.5], "quaternion": [1.0, 0.0, 0.0, 0.0]} | changes
    return specified(kind="random", obstacles=[{key: value for key, value in record.items() if value is not None}])


def random_scenes(count, **changes):
    """A random scene with as many obstacles."""
    (record,) = json.loads(random_scene(shape="half_sphere", **changes)["json"])["specification"]["obstacles"]
    return {"json": description(specification={"kind": "random", "obstacles": count * [record]}, cell_size=1 / 512)}


SHAPED = "{'descr': '<f4', 'fortran_order': False, 'shape': %s, }"
BROKEN_MEMBERS: list[tuple[dict[str, bytes | None], str]] = [
    ({"json": None}, "member json is missing"),
    ({"position.npy": None}, "member position.npy is missing"),
    ({"colour.npy": npy(np.zeros(5))}, "train-000012.colour.npy is not a known member"),
    ({"json": b"{"}, "train-000012.json must be JSON"),
    ({"json": b'{"seed": 1, "seed": 2}'}, "train-000012.json must be JSON, got the key seed is given twice"),
    ({"json": b"[]"}, "schema_version must be 1, got None"),
    ({"json": description(schema_version=2)}, "schema_version must be 1, got 2; generate .* or use the version that"),
    ({"json": description(seed=None)}, "train-000012.json.seed is missing"),
    ({"json": description(colour=3)}, "train-000012.json.colour is not a known key"),
    ({"json": description(gravity=[0.0, 1.0])}, "gravity must be a list of 3 values"),
    ({"position.npy": b""}, "position.npy must be a plain .npy file"),
    ({"position.npy": b"PK\x03\x04 zip"}, "position.npy must be a plain .npy file"),
    ({"position.npy": npy(np.zeros((4, 5, 3), np.float32))[:-1]}, "position.npy must have 240 bytes .*, got 239"),
    ({"position.npy": npy(np.zeros((4, 5, 3), np.float32)) + b"x"}, "position.npy must have 240 bytes .*, got 241"),
    ({"position.npy": npy(np.zeros((4, 5, 3)))}, "position.npy must be of type <f4 in C order, got <f8"),
    ({"position.npy": npy(np.zeros((4, 5, 3), np.float32, order="F"))}, "got <f4, Fortran order"),
    ({"position.npy": npy(np.zeros((4, 15), np.float32))}, "position.npy must have 3 dimensions"),
    ({"velocity.npy": npy(np.zeros((5, 3), np.float32), version=(2, 0))}, "not version 1.0"),
    ({"velocity.npy": headed("{'descr': ((((")}, "velocity.npy must be a plain .npy file"),
    ({"velocity.npy": headed("{'descr': " + 3000 * "-" + "1}")}, "velocity.npy must be a plain .npy file"),
    ({"velocity.npy": headed(SHAPED % "(-2, -3)")}, "velocity.npy must be a plain .npy file"),
    ({"velocity.npy": headed(SHAPED % "(True, 0)")}, "velocity.npy must be a plain .npy file"),
    ({"velocity.npy": headed(SHAPED % f"(0, {2**63})")}, "velocity.npy must have another shape"),
    *(({"json": description(solver={"settings": s})}, "json.solver.settings must be a map") for s in ([], None, 5)),
    *(
        ({"json": description(solver={"settings": {name: value}})}, f"json.solver.settings.{name} must be ")
        for name in ("collider_friction", "youngs_modulus_pa")
        for value in ("x", [1], float("nan"), -1.0, 1e300)
    ),
    *((specified(dimensions=n), "json.specification.dimensions must be ") for n in (7, "two", float("nan"), True)),
    *((specified(particle_counts=c), "json.specification.particle_counts") for c in (["a"], [-3, 8], [2.5, 2.5], 5)),
    *((specified(layout=kind), "json.specification.layout must be text") for kind in ([], {}, 5, None, "\x1b[31m")),
    *((specified(groups=g), "json.specification.groups") for g in (7, ["x"], [{"particle_count": "x"}])),
    *((specified(kind="random", obstacles=o), "json.specification.obstacles") for o in (None, 5, [5], [[]])),
    *(
        (random_scene(**{name: value}), rf"json.specification.obstacles\[0\].*{name}")
        for name, values in {
            "shape": (None, 5, "torus"),
            "size": (None, "x", [1.0, 2.0], float("nan"), 0.0, 1e30),
            "position": (5.0, [1.0], [float("nan"), 0.0, 0.0], 3 * [1e300]),
            "quaternion": ("abcd", [1.0], 4 * [float("inf")], 4 * [1e200], 4 * [0.0], [2.0, 0.0, 0.0, 0.0]),
            "friction": ("x", float("nan"), -1.0),
            "keyframes": (5, [], [[0.0, [0.0, 0.0, 0.0]], ["a", [0.0, 0.0, 0.0]]], [[0.0, [float("nan"), 0.0, 0.0]]]),
        }.items()
        for value in values
    ),
    (random_scenes(10_000), "json.specification.obstacles must be at most 1000, got 10000"),
    (random_scenes(600, size=1.0), "json.specification.obstacles must be of sizes whose squares .* got 600"),
]


@pytest.mark.filterwarnings("ignore:Stored array in format 2.0")
@pytest.mark.parametrize(("changes", "message"), BROKEN_MEMBERS)
def test_wrong_members_are_refused(changes, message):
    """A missing, foreign, cut or altered member ends in one message that names it."""
    members: dict[str, bytes | None] = dict(members_of(make_episode())) | changes
    with pytest.raises(ConfigError, match=message):
        decode_episode("train-000012", {name: data for name, data in members.items() if data is not None})


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("a pickle was loaded",))


def test_nothing_is_unpickled():
    """A member with a pickled object is refused without loading it."""
    members = members_of(make_episode())
    header = npy(np.array([None] * 5, dtype=object), allow_pickle=True)
    start = header.index(b"\n") + 1
    for data in (header[:start] + pickle.dumps(Bomb()), pickle.dumps(Bomb())):
        with pytest.raises(ConfigError, match=r"material\.npy must be"):
            decode_episode("train-000012", members | {"material.npy": data})
