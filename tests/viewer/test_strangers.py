"""What strangers send to the page of hgn.play: names, values, files and requests; no browser is needed."""

import asyncio
import gc
import http
import json
import pickle
import re
import socket
import urllib.request
import weakref
from contextlib import ExitStack
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
from viewer import soak

from hgn.viewer import viser_compat
from hgn.viewer.film import FilmPage
from hgn.viewer.page import MAXIMUM_UPLOAD_BYTES, PlayPage
from hgn.viewer.session import PlaySession
from hgn.viewer.viser_compat import COOKIE, MOST_OPENING, guarded

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


def moved(**place):
    return lambda page: page.session.move_obstacle(replace(page.session.obstacles[0], **place))


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
    *((moved(position=value), "obstacle") for value in ((NAN, 0.0, 0.0), (0.0, 1e30, 0.0), (0.0, 0.0, -INFINITE))),
    (moved(rotation=(0.0, NAN, 0.0)), "obstacle"),
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
    """Moving an obstacle 30 times keeps no more states alive than moving it once, and no samples of past places."""
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
    places = {id(placed): vars(placed) for frame in session.recording.frames for placed in frame.obstacles}
    assert len(places) >= 30 and all(len(pickle.dumps({**place, "body": None})) < 1000 for place in places.values())


def test_requests_of_other_pages_are_refused():
    """A page of another origin is refused though the browser sends this page's cookie with its request; so are tokens
    that no browser sends."""
    own = ("http://127.0.0.1:8080", "HTTP://127.0.0.1:8080", "https://127.0.0.1:8080")  # the last by a tunnel with TLS
    others = ("http://127.0.0.1:9999", "http://evil.example", "null", "", "http://[::1", "http://a]b", "file://")
    others += ("http://127.0.0.1:8080@evil.example", "http://u@127.0.0.1:8080", "javascript://127.0.0.1:8080")
    for origin, refused in (
        (None, False),
        *((origin, False) for origin in own),
        *((origin, True) for origin in others),
    ):
        given = {} if origin is None else {"Origin": origin}
        headers = Headers({"Host": "127.0.0.1:8080", "Cookie": f"{COOKIE}_8080=secret"} | given)
        assert answered_with_403("/", headers) == refused, origin
    for path in ("/?token=\udcff", "//[", "http://[/", "/?token=secret%00", "/#?token=secret", "*", "/?a"):
        assert answered_with_403(path, Headers({"Host": "127.0.0.1:8080"})), path


def test_who_never_asks_keeps_nobody_out(page):
    """Of too many connections that have not shown the token the oldest are closed, however long they may wait."""
    place = ("127.0.0.1", page.server.get_port())
    with ExitStack() as stack:
        waiting = [stack.enter_context(socket.create_connection(place, 8)) for _ in range(MOST_OPENING + 5)]
        assert [connection.recv(1) for connection in waiting[:5]] == 5 * [b""]
        with urllib.request.urlopen(page.address) as answer:
            assert answer.status == http.HTTPStatus.OK


def answered_with_403(path, headers):
    connection = SimpleNamespace(local_address=("127.0.0.1", 8080))
    response = guarded(lambda connection, request: None, "secret")(connection, Request(path, headers))
    return response is not None and response.status_code == http.HTTPStatus.FORBIDDEN


def updated(label, **values):
    """A control's message."""
    return lambda page: viser_compat.messages.GuiUpdateMessage(controls(page)[label].uuid, values)


def controls(page):
    return {handle.label: handle._impl for handle in page.server.gui._gui_input_handle_from_uuid.values()}


def upload(label, **other):
    """The beginning of an upload by a control."""

    def message(page):
        values = {"transfer_uuid": "t", "filename": "a.obj", "mime_type": "", "part_count": 0, "size_bytes": 0} | other
        return viser_compat.messages.FileTransferStartUpload(controls(page)[label].uuid, **values)

    return message


def part(label, content):
    """The only part of an upload that "Own mesh" has begun; it names another control."""

    def message(page):
        received(page, 0, [upload("Own mesh", part_count=1, size_bytes=1)(page)])
        return viser_compat.messages.FileTransferPart(controls(page)[label].uuid, "t", 0, content)

    return message


def received(page, client, messages):
    """Gives messages to the server, as a viewer's connection would."""

    async def give():
        for message in messages:
            await page.server._websock_server._handle_incoming_message(client, message)

    asyncio.run(give())


def parts(page, name, count, size):
    """The beginning of an upload of 10^9 bytes, and parts of it."""
    button = controls(page)["Own mesh"].uuid
    yield viser_compat.messages.FileTransferStartUpload(button, name, "a.obj", "", 10**9, 10**9)
    for number in range(count):
        yield viser_compat.messages.FileTransferPart(button, name, number, bytes(size))


@pytest.mark.parametrize(
    ("message", "passes"),
    [
        (updated("Diameter", value=0.2), True),
        (updated("Weights", value="other"), True),
        (updated("Weights", props={"options": ("/etc/passwd",)}), False),
        (updated("Weights", value="other", props={}), False),
        *((updated("Step", **{name: value}), False) for name, value in (("removed", True), ("update_cb", []))),
        (updated("Size", sync_cb=None), False),
        (updated("Weights", value=10**6 * "x"), False),
        (updated("Gravity", value=10**5 * (0.0,)), False),
        (updated("Gravity", value=[0, 0, 1.5]), True),
        *((updated("Gravity", value=value), False) for value in ([], [1.0, 2.0], "123", ["1", "2", "3"], 3 * [2**63])),
        *((updated("Size", value=value), False) for value in ("0.2", None, [0.2], {"a": 1}, 2**63)),
        (updated("Own mesh", value="a.obj"), False),
        (lambda page: viser_compat.messages.GuiUpdateMessage(["x"], {"value": 1}), False),
        (lambda page: viser_compat.messages.GuiUpdateMessage(controls(page)["Size"].uuid, ["value"]), False),
        (upload("Own mesh"), True),
        *((upload(label), False) for label in ("Gravity", "Size", "Weights", "Step")),
        *((upload("Own mesh", **{name: 10**300}), False) for name in ("part_count", "size_bytes")),
        *((upload("Own mesh", **{name: 2000 * "x"}), False) for name in ("transfer_uuid", "filename", "mime_type")),
        *((upload("Own mesh", transfer_uuid=value), False) for value in (["t"], {"t": 1}, 5**30)),
        (part("Own mesh", b"x"), True),
        (part("Size", b"x"), False),
        (part("Own mesh", [[]]), False),
        (lambda page: viser_compat.messages.ShareUrlRequest(), False),
        (lambda page: viser_compat.messages.ResetGuiMessage(), False),
    ],
)
def test_messages_that_are_not_of_the_page(page, monkeypatch, message, passes):
    """A viewer sets the values of controls, of the types that they have, and nothing else of them; only the button for
    uploads takes files, with texts that are counted and numbers that other viewers can be sent; the server asks nobody
    for an address."""
    asked, handled = [], page.server._websock_server._incoming_handlers
    monkeypatch.setitem(handled, viser_compat.messages.ShareUrlRequest, [lambda *_: asked.append("address")])
    sent, uploads = message(page), page.server.gui._current_file_upload_states
    before = {name: dict(vars(state)) for name, state in controls(page).items()} | {"uploads": {*uploads}}
    received(page, 0, [sent])
    after = {name: dict(vars(state)) for name, state in controls(page).items()} | {"uploads": {*uploads}}
    for name, state in controls(page).items():
        vars(state).update(before[name])
    page.server.gui._drop_uploads_from_client(0)
    assert (after != before) == passes and not asked


def test_acknowledgements_of_parts_are_not_kept(page):
    """Meshes that come in thousands of parts leave few messages for the viewers who come later."""
    kept = page.server._websock_server._broadcast_buffer.message_from_id
    before = len(kept)
    for number in range(100):
        received(page, 1, parts(page, str(number), 20, 1))
    assert len(kept) - before <= 64
    page.server.gui._drop_uploads_from_client(1)


def test_actions_that_wait_are_bounded(page, messages):
    """Of a flood of actions before one frame the first are done; one mesh waits to be read at a time."""
    done = []
    for number in range(10_000):
        page.do(lambda number=number: done.append(number))
    page._do_all()
    assert done == list(range(64))


def test_a_frame_that_fails_pauses(page, messages, monkeypatch, capsys):
    """An unexpected error of the simulation pauses for everybody, and is told; Restart goes on."""
    failed = []

    def step():
        failed.append(page.ended.set())
        raise RuntimeError("no frame")

    monkeypatch.setattr(page.session, "step", step)
    monkeypatch.setattr(page, "steps", 1)
    page.ended.clear()
    page.run()
    assert failed and not page.playing and "no frame; paused" in messages[0]
    assert "RuntimeError" in capsys.readouterr().err
    page.restart()
    assert page.playing
    page.playing = False


@pytest.mark.parametrize("value", [INFINITE, NAN, -5.0, 1e300, 900 * "9"])
def test_a_film_goes_on_at_any_value(page, value):
    """Values that its sliders do not give, and an update that fails, do not end the page of a rollout."""
    film = FilmPage(page.session.rollout(), port=0)
    received(film, 0, [updated("Frame", value=value)(film), upload("Frame")(film)])
    assert film.slider.value == 0
    shown, failures = [], [RuntimeError("deque mutated during iteration")]

    def show(frame):
        shown.append(frame)
        film.speed._impl.value = film.slider._impl.value = value
        if len(shown) > 3:
            film.ended.set()
        if failures:
            raise failures.pop()

    film.film.show = show
    film.run()
    film.close()
    assert len(shown) == 4 and all(0 <= frame < film.rollout.frame_count for frame in shown)


def test_meshes_are_bounded(page, messages, monkeypatch):
    """Files of all obstacles count together, also of those that only past frames show; so does their number."""
    monkeypatch.setattr("hgn.viewer.session.MAXIMUM_MESH_BYTES", 4 * len(TRIANGLES))
    for _ in range(6):
        sent(page, lambda: page._add_file("a.obj", TRIANGLES))
        page.session.step()
        sent(page, page._remove_chosen)
    assert len(messages) == 2 and "mesh files must be at most" in messages[0]
    page.restart()
    gc.collect()
    sent(page, lambda: page._add_file("a.obj", TRIANGLES))
    assert len(messages) == 2
    monkeypatch.setattr("hgn.viewer.session.MAXIMUM_OBSTACLES", 3)
    for _ in range(3):
        sent(page, page._add_shape)
    assert len(messages) == 4 and "obstacles must be at most 3" in messages[3]
    page.restart()


def test_who_takes_no_file_gets_no_other(page, messages):
    """Files for a viewer who does not read them do not pile up."""
    sent, waiting = [], {}

    def send(name, content, **_):
        sent.append(name)
        waiting[len(sent)] = viser_compat.messages.FileTransferPart(None, "t", 0, content)

    connection = SimpleNamespace(get_message_buffer=lambda: SimpleNamespace(message_from_id=waiting))
    event = SimpleNamespace(client=SimpleNamespace(_websock_connection=connection, send_file_download=send))
    for action in 2 * (page._send_scene, page._send_rollout):
        page.do(lambda action=action: action(event))
    page._do_all()
    assert sent == ["scene.zip"] and len(messages) == 3 and "download must be complete" in messages[0]


@pytest.mark.parametrize(("uploads", "count", "size"), [(40, 2, 1 << 20), (3, 30_000, 1), (300, 0, 0)])
def test_unfinished_uploads_are_bounded(page, monkeypatch, uploads, count, size):
    """Uploads that never become whole are dropped, those of the viewer with the most first: large parts, many parts,
    none at all."""
    monkeypatch.setattr(viser_compat, "MAXIMUM_UNFINISHED_BYTES", 10 << 20)
    states = page.server.gui._current_file_upload_states
    received(page, 1, parts(page, "small", 1, 100))
    for number in range(uploads):
        received(page, 2, parts(page, str(number), count, size))
        assert sum(state["transferred_bytes"] for state in states.values()) <= 10 << 20
        assert len(states) <= 11 and sum(len(state["parts"]) for state in states.values()) <= 53_000
    assert states["small"]["transferred_bytes"] == 100
    for client in (1, 2):
        page.server.gui._drop_uploads_from_client(client)


@pytest.mark.slow
def test_two_viewers(tmp_path, request):
    """No unexpected error is printed in ten seconds. `make soak` takes two minutes, and memory stays within 50 MB of
    what it is after one."""
    seconds = 120 if request.config.getoption("soak") else 10
    text = soak.main(seconds, tmp_path / "soak.json")
    report = json.loads((tmp_path / "soak.json").read_text())
    assert report["errors"] == 0 and report["ended"] is None, text
    assert report["rows"][-1]["frames"] > 0 and report["rows"][-1]["answers"] > 0
    assert seconds == 10 or report["growth_mb"] < 50, report["rows"]
