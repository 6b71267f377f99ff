"""What strangers send to the page of hgn.play: names, values, files and requests; no browser is needed."""

import asyncio
import gc
import http
import re
import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from network.states import network_of, silent
from websockets import Headers
from websockets.http11 import Request

from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.scene import Scene
from hgn.scene.shapes import shape_obstacle

pytest.importorskip("viser", reason="viser is not installed: pip install 'hgn[play]'")
from hgn.viewer import viser_compat
from hgn.viewer.page import MAXIMUM_UPLOAD_BYTES, PlayPage
from hgn.viewer.session import PlaySession
from hgn.viewer.viser_compat import COOKIE, guarded

# viser keeps its event loop's threads and sockets until the garbage collector comes
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
TRIANGLES = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture(scope="module")
def page():
    network = silent(network_of(torch.float32, width=16, levels=2, inputs="relative"))
    block_N3 = 0.4 + 0.2 * np.random.default_rng(0).random((100, 3)).astype(np.float32)
    cone = shape_obstacle("cone", 0.3, (0.5, 0.5, 0.5))
    scene = Scene(block_N3, 0 * block_N3, np.zeros(100, np.uint8), (cone,), cell_size=1 / 32, gravity=(0.0, 0.0, 0.0))
    session = PlaySession(Simulator(network, 60.0, "cpu"), scene, weights="floating")
    loaded = []

    def load(name):
        loaded.append(name)
        return session.simulator

    page = PlayPage(session, ("floating", "other"), load, port=0)
    page.loaded = loaded
    yield page
    page.close()


@pytest.fixture
def messages(page, monkeypatch):
    """The messages that viewers have seen."""
    seen = []
    monkeypatch.setattr(page, "_notify", lambda message, client=None: seen.append(message))
    return seen


def sent(page, action):
    """Does what a viewer sent, as the page's loop would."""
    page.do(action)
    page._do_all()
    page._show()
    page._show_status()


@pytest.mark.parametrize(
    "name",
    [
        *("<img src=x onerror=alert(1)>.obj", "<script>alert(1)<script>.obj", "[x](javascript:alert(1)).obj"),
        *("![x](http:example.org).obj", "`a` **b** | c.obj", "\x1b[31mred.obj", "{{constructor}}.obj", "a\nb.obj"),
        "ü" * 200 + ".obj",
    ],
)
def test_names_of_files_are_shown_as_plain_words(page, messages, name):
    """Whatever a file is called, the page shows letters, digits, dots, hyphens and underscores."""
    sent(page, lambda: page._add_file(name, TRIANGLES))
    assert re.fullmatch(r"chosen: [A-Za-z0-9_.-]{1,48}", page.chosen_text.content)
    assert not messages
    sent(page, page._remove_chosen)


def file(name, content):
    return lambda page: page._add_file(name, content)


def click(*ray):
    return lambda page: page._drop(np.array([0.5, 2.0, 0.5]), np.array(ray))


def gravity(*value):
    return lambda page: page.session.set_gravity(value)


def weights(name):
    return lambda page: page._use(name)


INFINITE, NAN, LISTED = float("inf"), float("nan"), "weights must be one of floating, other"
REFUSED = [
    (file("x\0y.obj", TRIANGLES), "null"),
    (file("x.obj", b"\xff\xfe\x00"), "x.obj"),
    (file("x.glb", b"glTF\x02\0\0\0" + bytes(8)), "x.glb"),
    (file("x.stl", b""), "x.stl"),
    (file("x.txt", TRIANGLES), "mesh must be one of"),
    (file("x.obj", bytes(MAXIMUM_UPLOAD_BYTES + 1)), "at most 64 MiB"),
    *((click(*ray), "ray") for ray in ((0.0, 0.0, 0.0), (NAN, 0.0, 1.0), (INFINITE, 0.0, 0.0))),
    *((gravity(*value), "gravity") for value in ((NAN, 0.0, 0.0), (0.0, INFINITE, 0.0), (0.0, 1e30, 0.0))),
    *((weights(name), LISTED) for name in ("/etc/passwd", "hf://someone/weights", "../weights", "")),
]


@pytest.mark.parametrize(("action", "message"), REFUSED, ids=range(len(REFUSED)))
def test_bad_input_is_answered(page, messages, action, message):
    """Files that cannot be read, rays without a direction, gravity without bounds and weights that the page does not
    offer are a message to the viewer who sent them; nothing is opened, and the session goes on as it was."""

    def state():
        session = page.session
        return len(session.obstacles), session.live.particle_count, session.gravity, list(page.loaded)

    before = state()
    sent(page, lambda: action(page))
    assert len(messages) == 1 and message in messages[0] and state() == before and not page.loaded


@pytest.mark.parametrize("error", [KeyError("x"), ZeroDivisionError("x"), RuntimeError("x"), MemoryError("x")])
def test_any_error_of_one_viewer_is_a_message_to_that_viewer(page, messages, capsys, error):
    """An unexpected error is told to its viewer and printed with its trace; no other action is lost."""

    def fail():
        raise error

    done = []
    page.do(fail)
    page.do(lambda: done.append(True))
    page._do_all()
    assert len(messages) == 1 and type(error).__name__ in messages[0]
    assert done and type(error).__name__ in capsys.readouterr().err


def test_an_update_that_fails_is_tried_again(page, monkeypatch, capsys):
    """viser may fail where a viewer comes or goes: the session goes on, and the next round shows what is missing."""
    shown, failures = [], [RuntimeError("deque mutated during iteration"), asyncio.InvalidStateError("done")]

    def show():
        if failures:
            raise failures.pop()
        shown.append(page.session.frame)
        page.ended.set()

    monkeypatch.setattr(page, "_show", show)
    page.playing = False
    page.do(lambda: None)
    page.run()
    assert len(shown) == 1 and "deque mutated" in capsys.readouterr().err


def test_values_beyond_the_sliders_are_clamped(page, monkeypatch):
    """A value that no slider gives is taken as the nearest that one gives; NaN as the least."""
    for value in (100.0, 1e30, INFINITE, NAN, -5.0):
        for name in ("diameter", "speed", "height"):
            monkeypatch.setattr(page, name, SimpleNamespace(value=value, min=0.1, max=0.3))
        spout = page._spout(np.array([0.5, 2.0, 0.5]), np.array([0.0, -1.0, 0.0]))
        assert all(0.1 <= number <= 0.3 for number in (spout.diameter, spout.speed, spout.position[1]))


def test_a_moved_obstacle_leaves_no_earlier_scene_behind(page, monkeypatch):
    """Moving an obstacle 30 times keeps no more states alive than moving it once."""
    session = page.session
    alive: list[weakref.ref] = []
    begin = InitialState.__init__

    def remembering(self, *arguments, **options):
        begin(self, *arguments, **options)
        alive.append(weakref.ref(self))

    monkeypatch.setattr(InitialState, "__init__", remembering)
    for step in range(30):
        session.move_obstacle(replace(session.obstacles[0], position=(0.3 + 0.01 * step, 0.5, 0.5)))
        session.step()
    gc.collect()
    assert len(alive) >= 30
    assert sum(state() is not None for state in alive) <= 3


def test_requests_of_other_pages_are_refused():
    """A page of another origin is refused though the browser sends this page's cookie with its request."""
    for origin, refused in (
        *((None, False), ("http://127.0.0.1:8080", False), ("http://127.0.0.1:9999", True)),
        *(("http://evil.example", True), ("null", True), ("", True)),
    ):
        given = {} if origin is None else {"Origin": origin}
        headers = Headers({"Host": "127.0.0.1:8080", "Cookie": f"{COOKIE}_8080=secret"} | given)
        connection = SimpleNamespace(local_address=("127.0.0.1", 8080))
        response = guarded(lambda connection, request: None, "secret")(connection, Request("/", headers))
        assert (response is not None and response.status_code == http.HTTPStatus.FORBIDDEN) == refused


def test_unfinished_uploads_are_bounded(monkeypatch):
    """Parts of uploads that never become whole are dropped, those of the viewer with the most first."""
    monkeypatch.setattr(viser_compat, "MAXIMUM_UNFINISHED_BYTES", 1000)
    states = {}

    def drop(client):
        for key in [key for key, state in states.items() if state["client_id"] == client]:
            del states[key]

    def take(gui, client, message):
        if message.transfer_uuid in states:
            states[message.transfer_uuid]["transferred_bytes"] += len(message.content)

    gui = SimpleNamespace(_current_file_upload_states=states, _drop_uploads_from_client=drop)
    states["small"] = {"client_id": 1, "transferred_bytes": 0}
    part = viser_compat.bounded(take)
    part(gui, 1, SimpleNamespace(transfer_uuid="small", content=bytes(100)))
    for number in range(40):
        states[str(number)] = {"client_id": 2, "transferred_bytes": 0}
        part(gui, 2, SimpleNamespace(transfer_uuid=str(number), content=bytes(300)))
        assert sum(state["transferred_bytes"] for state in states.values()) <= 1000
    assert states["small"]["transferred_bytes"] == 100
