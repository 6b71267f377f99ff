"""Kinds of reports that users of tools like this one publish, on imported trajectories and data over HTTP."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from hgn.data import storage
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


def read(folder, text=None):
    (folder / "metadata.json").write_text(text or json.dumps(METADATA))
    name = find_format(folder, "auto")
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
    "fields in disorder": lambda: (
        {
            f"{i}/{key}": NAMED[i][key]
            for i, key in (
                (0, "position"),
                (2, "particle_type"),
                (1, "position"),
                (0, "particle_type"),
                (2, "position"),
            )
        }
        | {"1/particle_type": TYPES[1]}
    ),
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


@pytest.mark.parametrize(
    "content",
    [
        {"arr_0": np.array({"a": PAIRS[0], "b": 3})},
        {"arr_0": objects([{"position": POSITIONS[0]}])},
        {"arr_0": np.array({"a": {"particle_type": TYPES[0], "material_property": 1}})},
        {"arr_0": np.array(None)},
    ],
)
def test_other_objects_in_npz(tmp_path, content):
    """Are refused with the member's name."""
    np.savez(tmp_path / "train.npz", **content)
    with pytest.raises(ConfigError, match=r"train\.npz: arr_0.* must "):
        read(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"dt": 0.01,\n "bounds": [[0, 1]],\n "dt": 0.5}', "line 3: the key dt is given twice, first in line 1"),
        ('{"dim": 3,\n\t"train": {\n\t"dt": 1,\n\t"dt": 2}}', "line 4: the key dt is given twice, first in line 3"),
        ('{"dt": 010}', "must be JSON"),
        ('{"dt": 1:30}', "must be JSON"),
    ],
)
def test_metadata(tmp_path, text, message):
    """Keys given twice are refused with their line; JSON has no octal numbers."""
    np.savez(tmp_path / "train.npz", **{"0/position": POSITIONS[0]})
    with pytest.raises(ConfigError, match=message):
        read(tmp_path, text)


@pytest.mark.parametrize("offset", [0, 1, 10, 1e3, 1e5, 4e6])
@pytest.mark.parametrize("stored", [np.float32, np.float64])
@pytest.mark.parametrize("radius", [0.015, 1.0, 40.0])
def test_coarse_positions(offset, stored, radius):
    """Coordinates far from the origin are too coarse in float32, also when they were stored as float64 later."""
    position_TND = (POSITIONS[0].astype(np.float64) * radius + offset).astype(np.float32).astype(stored)
    coarse = np.spacing(np.float32(offset + radius)) > 1e-3 * radius
    if coarse:
        with pytest.raises(ConfigError, match=r"set: position must have numbers at most .* of float32 at"):
            require_fine("set", position_TND, radius)
    else:
        require_fine("set", position_TND, radius)
    require_fine("set", POSITIONS[0].astype(np.float64) * radius + np.pi * offset, radius)


@pytest.fixture
def proxy():
    """A proxy that answers every request itself, and lists them."""
    asked = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_response(200)
            self.send_header("Content-Length", "5")
            self.end_headers()
            self.wfile.write(b"hello")

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", asked
    server.shutdown()
    thread.join()
    server.server_close()


def test_proxies_are_honoured(monkeypatch, proxy):
    """http_proxy serves data of other machines, but not of this one or of hosts in no_proxy."""
    address, asked = proxy
    for name in ("http_proxy", "HTTP_PROXY"):
        monkeypatch.setenv(name, address)
    monkeypatch.setenv("no_proxy", "excepted.example")
    storage._remote.cache_clear()
    assert storage.open_storage("http://data.example:9/set").read("manifest.json", 0, 5) == b"hello"
    assert asked == ["http://data.example:9/set/manifest.json"]
    assert storage.open_storage(f"{address}/set").read("manifest.json", 0, 5) == b"hello"
    assert asked[1:] == ["/set/manifest.json"]
