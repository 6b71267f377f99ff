"""Kinds of reports that users of tools like this one publish, on imported trajectories."""

import json

import numpy as np
import pytest

from hgn.data.foreign.formats import find_format, read_split, set_info
from hgn.data.foreign.settings import ImportConfig
from hgn.data.foreign.trajectory import require_fine
from hgn.schema import ConfigError

METADATA = {"bounds": [[0.0, 1.0]] * 3, "dim": 3, "dt": 1 / 60, "default_connectivity_radius": 0.035}
RNG = np.random.default_rng(0)
POSITIONS = [RNG.random((20, count, 3)).astype(np.float32) for count in (5, 7, 6)]
TYPES = [np.full(position.shape[1], 5) for position in POSITIONS]
PAIRS = list(zip(POSITIONS, TYPES, strict=True))
NAMED = [{"particle_type": types, "position": position} for position, types in PAIRS]


def read(folder):
    (folder / "metadata.json").write_text(json.dumps(METADATA))
    name = find_format(folder)
    return list(read_split(folder, "train", set_info(folder, name, ImportConfig(out="mine"))))


def objects(entries):
    array = np.empty(len(entries), object)
    for i, entry in enumerate(entries):
        array[i] = entry
    return array


LAYOUTS = {
    "a dict of tuples": lambda: {"arr_0": np.array({f"simulation_{i}": pair for i, pair in enumerate(PAIRS)})},
    "a dict of dicts": lambda: {"data": np.array(dict(enumerate(NAMED)))},
    "a dict with another name": lambda: {"gns_data": np.array({f"{i}": list(pair) for i, pair in enumerate(PAIRS)})},
    "a list of dicts": lambda: {"arr_0": objects(NAMED)},
    "a list of tuples": lambda: {"trajectories": objects(PAIRS)},
    "a dict each": lambda: {f"simulation_{i}": np.array(entry) for i, entry in enumerate(NAMED)},
    "fields by trajectory": lambda: {
        f"{i}/{key}": value for i, entry in enumerate(NAMED) for key, value in entry.items()
    },
    "fields after another": lambda: {
        f"{i}/{key}": NAMED[i][key] for key in ("particle_type", "position") for i in range(3)
    },
    "fields in disorder": lambda: {
        f"{i}/{key}": NAMED[i][key]
        for i, key in zip((0, 2, 1, 0, 2, 1), 3 * ("position", "particle_type"), strict=True)
    },
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_npz(tmp_path, layout):
    """Trajectories in dicts and lists, alone or together, and the fields of the plain format in any order."""
    np.savez(tmp_path / "train.npz", **LAYOUTS[layout]())
    result = read(tmp_path)
    order = [0, 2, 1] if "disorder" in layout else [0, 1, 2]
    assert len(result) == 3
    for trajectory, i in zip(result, order, strict=True):
        assert np.array_equal(trajectory.position_TND, POSITIONS[i]) and np.array_equal(trajectory.type_N, TYPES[i])


@pytest.mark.parametrize("offset", [0, 1, 10, 1e3, 1e5, 4e6])
@pytest.mark.parametrize("stored", [np.float32, np.float64])
@pytest.mark.parametrize("radius", [0.015, 1.0, 40.0])
def test_coarse_positions(offset, stored, radius):
    """Coordinates far from the origin are too coarse in float32, also when they were stored as float64 later."""
    position_TND = (POSITIONS[0].astype(np.float64) * radius + offset).astype(np.float32).astype(stored)
    coarse = np.spacing(np.float32(offset + radius)) > 1e-3 * radius
    if coarse:
        with pytest.raises(ConfigError, match=r"set: position must have a resolution of .* in float32 at"):
            require_fine("set", position_TND, radius)
    else:
        require_fine("set", position_TND, radius)
    require_fine("set", POSITIONS[0].astype(np.float64) * radius + np.pi * offset, radius)


ROUNDED = {
    "float16": lambda a: a.astype(np.float16),
    "bfloat16": lambda a: (a.view(np.uint32) & np.uint32(0xFFFF0000)).view(np.float32),
    "3 decimals": lambda a: np.round(a, 3),
    "8 bits": lambda a: np.round(a * 255) / 255,
    "far away": lambda a: (a + np.float32(1e5)) - np.float32(1e5),
    "very far away": lambda a: (a + np.float32(1e6)) - np.float32(1e6),  # 17 values are left
    "far away along one axis": lambda a: (a + np.float32([0, 4e5, 0])) - np.float32([0, 4e5, 0]),
    "far away along two axes": lambda a: (a + np.float32([4e5, 0, 4e5])) - np.float32([4e5, 0, 4e5]),
    "one axis in 3 decimals": lambda a: np.stack([a[..., 0], a[..., 1], np.round(a[..., 2], 3)], axis=2),
}


@pytest.mark.parametrize("stored", [np.float32, np.float64])
@pytest.mark.parametrize("name", ROUNDED)
def test_positions_rounded_before(name, stored):
    """Numbers that were rounded, and then stored in a finer type, are as coarse as before; a lattice is not."""
    walk_TN3 = RNG.random((1, 60, 3), np.float32) + np.cumsum(0.01 * RNG.random((20, 60, 3), np.float32), 0)
    require_fine("set", walk_TN3.astype(stored), 0.035)
    with pytest.raises(ConfigError, match=r"set: position must have a resolution of 3.5e-05 .* or finer"):
        require_fine("set", ROUNDED[name](walk_TN3).astype(stored), 0.035)
    require_fine("set", np.tile((np.arange(180.0) % 17 / 16).reshape(60, 3).astype(stored), (20, 1, 1)), 0.035)


@pytest.mark.parametrize("name", ["particle_types", "types", "Material"])
def test_types_by_another_name(tmp_path, name):
    """Types that the file has under another name are not taken for those of a fluid; other fields are ignored."""
    fields = {"position": POSITIONS[0], "particle_id": np.arange(5), "material_property": np.ones(5)}
    np.savez(tmp_path / "train.npz", **{f"0/{key}": value for key, value in fields.items()})
    assert read(tmp_path)[0].type_N.tolist() == [1] * 5
    np.savez(tmp_path / "train.npz", **{f"0/{key}": value for key, value in (fields | {name: TYPES[0]}).items()})
    with pytest.raises(ConfigError, match=rf"train.npz: 0: {name} must be named particle_type, got '{name}'"):
        read(tmp_path)
