"""Tests untrusted input to the page of hgn.play: names, values, files and requests, without a browser."""

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
from websockets import Headers
from websockets.http11 import Request

from hgn.runtime.simulator import InitialState

pytest.importorskip("viser", reason="viser is not installed: pip install 'hgn[play]'")
from viewer import soak

from hgn.viewer import viser_compat
from hgn.viewer.page import MAXIMUM_UPLOAD_BYTES
from hgn.viewer.viser_compat import MOST_OPENING, guarded

# viser keeps its event loop's threads and sockets until the garbage collector comes
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
TRIANGLES = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def sent(page, action):
    """Runs a viewer's actions, as the page's loop does."""
    page.do(action)
    page._do_some()
    page._show()
    page._show_status()


NAMES = (
    *("<img src=x onerror=alert(1)>.obj", "<script>alert(1)<script>.obj", "[x](javascript:alert(1)).obj"),
    *("![x](http:example.org).obj", "`a` **b** | c.obj", "\x1b[31mred.obj", "{{constructor}}.obj", "a\nb.obj"),
    "ü" * 200 + ".obj",
)


@pytest.mark.parametrize("name", NAMES)
def test_names_of_weights_are_shown_as_plain_words(page, monkeypatch, name):
    """So is the name of the file of weights, which may be from anywhere."""
    monkeypatch.setattr(page.session, "weights", f"folder/{name}")
    page._show_status()
    assert re.fullmatch(r".* particles\n\nframe \d+ · [A-Za-z0-9_.-]{1,32} on cpu", page.status.content)


@pytest.mark.parametrize("name", NAMES)
def test_names_of_files_are_shown_as_plain_words(page, messages, name):
    """For any name of a file the page shows only letters, digits, dots, hyphens and underscores."""
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


def sheets(count):
    """Returns squares above one another, which need the samples of this number of surfaces."""
    corners = "".join(f"v 0 {i} 0\nv {count} {i} 0\nv {count} {i} {count}\nv 0 {i} {count}\n" for i in range(count))
    return (corners + "".join(f"f {4 * i + 1} {4 * i + 2} {4 * i + 3} {4 * i + 4}\n" for i in range(count))).encode()


INFINITE, NAN, LISTED = float("inf"), float("nan"), "weights must be one of floating, other"
REFUSED = [
    (file("x\0y.obj", TRIANGLES), "null"),
    (file("x.obj", b"\xff\xfe\x00"), "x.obj"),
    (file("x.glb", b"glTF\x02\0\0\0" + bytes(8)), "x.glb"),
    (file("x.stl", b""), "x.stl"),
    (file("x.txt", TRIANGLES), "mesh must be one of"),
    (file("x.obj", sheets(700)), "fewer than 600000 samples"),
    (file("x.obj", bytes(MAXIMUM_UPLOAD_BYTES + 1)), "at most 64 MiB"),
    *((click(*ray), "ray") for ray in ((0.0, 0.0, 0.0), (NAN, 0.0, 1.0), (INFINITE, 0.0, 0.0))),
    *((gravity(*value), "gravity") for value in ((NAN, 0.0, 0.0), (0.0, INFINITE, 0.0), (0.0, 1e30, 0.0))),
    *((moved(position=value), "obstacle") for value in ((NAN, 0.0, 0.0), (0.0, 1e30, 0.0), (0.0, 0.0, -INFINITE))),
    (moved(rotation=(0.0, NAN, 0.0)), "obstacle"),
    *((weights(name), LISTED) for name in ("/etc/passwd", "hf://someone/weights", "../weights", "")),
]


@pytest.mark.parametrize(("action", "message"), REFUSED, ids=range(len(REFUSED)))
def test_bad_input_is_answered(page, messages, action, message):
    """Unreadable files, rays without a direction, gravity that is too large, and weights that the page does not offer
    cause a message to the viewer who sent them. No file is opened, and the session continues unchanged."""

    def state():
        session = page.session
        undoable = len(session.undoable)
        return len(session.obstacles), session.live.particle_count, session.gravity, list(page.loaded), undoable

    before = state()
    sent(page, lambda: action(page))
    assert len(messages) == 1 and message in messages[0] and state() == before and not page.loaded


def test_a_drag_that_reaches_the_limit_is_told_once(page, messages, monkeypatch):
    """Pouring ends at the limit until the mouse is pressed again. Each press is one message, and Undo one step."""
    ray = np.array([0.5, 2.0, 0.5]), np.array([0.01, -1.0, 0.0])
    steps = []
    monkeypatch.setattr(page.session, "remember", lambda: steps.append(1))
    sent(page, lambda: page._pour(*ray))
    assert page.session.spout is not None and len(steps) == 1
    monkeypatch.setattr(page.session, "maximum_particles", page.session.live.particle_count)
    page._end_pouring()
    for _ in range(5):  # the mouse moves on
        sent(page, lambda: page._pour(*ray))
    assert page.session.spout is None and len(steps) == len(messages) == 1 and "particles=N allows more" in messages[0]
    assert "Undo" not in messages[0]  # it takes nothing away if the scene itself is at the limit
    sent(page, lambda: page._pour(ray[0], None))  # the mouse is released, pressed again, and moves
    for _ in range(5):
        sent(page, lambda: page._pour(*ray))
    sent(page, lambda: click(0.01, -1.0, 0.0)(page))
    assert page.session.spout is None and len(steps) == 1 and len(messages) == 3
    monkeypatch.undo()
    sent(page, lambda: page._pour(ray[0], None))
    sent(page, lambda: page._pour(*ray))
    assert page.session.spout is not None
    sent(page, lambda: page._pour(ray[0], None))


@pytest.mark.parametrize("error", [KeyError("x"), ZeroDivisionError("x"), RuntimeError("x"), MemoryError("x")])
def test_any_error_of_one_viewer_is_a_message_to_that_viewer(page, messages, capsys, error):
    """An unexpected error is shown to its viewer and printed with its traceback. All other actions run."""

    def fail():
        raise type(error)("x")  # `error` would keep its trace, and with it the frames' values

    done = []
    page.do(fail)
    page.do(lambda: done.append(True))
    page._do_some()
    assert len(messages) == 1 and type(error).__name__ in messages[0]
    assert done and type(error).__name__ in capsys.readouterr().err


def test_an_update_that_fails_is_tried_again(page, monkeypatch, capsys):
    """viser may fail when a viewer connects or leaves. The session continues, and the next iteration shows the missing
    changes."""
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
    """After 30 moves of an obstacle no more states exist than after one, and no samples of past places."""
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
    """A page of another origin is refused even with the token, and so are paths that only contain the token elsewhere.
    Cookies, which a browser sends to all ports of the host, do not open the page."""
    own = ("http://127.0.0.1:8080", "HTTP://127.0.0.1:8080", "https://127.0.0.1:8080")  # the last by a tunnel with TLS
    others = ("http://127.0.0.1:9999", "http://evil.example", "null", "", "http://[::1", "http://a]b", "file://")
    others += ("http://127.0.0.1:8080@evil.example", "http://u@127.0.0.1:8080", "javascript://127.0.0.1:8080")
    for origin, refused in (
        (None, False),
        *((origin, False) for origin in own),
        *((origin, True) for origin in others),
    ):
        given = {} if origin is None else {"Origin": origin}
        for path in ("/secret", "/secret/", "/secret/?darkMode"):
            assert answered_with_403(path, Headers({"Host": "127.0.0.1:8080"} | given)) == refused, origin
    others = ("/\udcff", "//[", "http://[/", "/secret%00", "/#/secret", "*", "/?a", "/?token=secret", "//secret", "/")
    for path in (*others, "/secrets", "/secre", "/?/secret/", ""):
        headers = Headers({"Host": "127.0.0.1:8080", "Cookie": "hgn_play_8080=secret; token=secret"})
        assert answered_with_403(path, headers), path


def test_nothing_of_the_token_is_stored(page):
    """The browser keeps no cookie, which it would send to all ports of the host, and names the address nowhere."""
    with urllib.request.urlopen(page.address) as answer:
        assert answer.headers["Set-Cookie"] is None and answer.headers["Referrer-Policy"] == "no-referrer"
        assert b"<title>Viser</title>" in answer.read()


def test_who_never_asks_keeps_nobody_out(page):
    """Of too many connections that have not shown the token the oldest are closed, however long they may wait."""
    place = ("127.0.0.1", page.server.get_port())
    with ExitStack() as stack:
        waiting = [stack.enter_context(socket.create_connection(place, 8)) for _ in range(MOST_OPENING + 5)]
        assert [connection.recv(1) for connection in waiting[:5]] == 5 * [b""]
        with urllib.request.urlopen(page.address) as answer:
            assert answer.status == http.HTTPStatus.OK


@pytest.mark.parametrize("sent", [b"", b"GET / HT", b"\x16\x03\x01 not HTTP\r\n\r\n"])
def test_a_connection_without_a_request_writes_no_traceback(page, caplog, sent):
    """Browsers open connections that they may never use."""
    with socket.create_connection(("127.0.0.1", page.server.get_port()), 8) as connection:
        connection.sendall(sent)
        connection.shutdown(socket.SHUT_WR)
        while connection.recv(1024):  # until the server closes it
            pass
    with urllib.request.urlopen(page.address) as answer:
        assert answer.status == http.HTTPStatus.OK
    assert not [record.message for record in caplog.records]


def answered_with_403(path, headers):
    connection = SimpleNamespace(local_address=("127.0.0.1", 8080))
    response = guarded(lambda connection, request: None, "secret")(connection, Request(path, headers))
    return response is not None and response.status_code == http.HTTPStatus.FORBIDDEN


def test_actions_that_wait_are_bounded(page, messages):
    """Of a flood of actions before one frame the first are done; one mesh waits to be read at a time."""
    done = []
    for number in range(10_000):
        page.do(lambda number=number: done.append(number))
    page._do_some()
    assert done == list(range(64))


def test_frames_follow_each_action_that_takes_long(page, messages, monkeypatch):
    """Actions wait for the next frame once those before it have taken their time. Later ones keep their order."""
    done, clock = [], [0.0]

    def action(number):
        clock[0] += 0.03
        done.append(number)

    monkeypatch.setattr("hgn.viewer.page.time", SimpleNamespace(monotonic=lambda: clock[0]))
    for number in range(9):
        page.do(lambda number=number: action(number))
    for count in (4, 8, 9):
        assert page._do_some() and done == list(range(count))
    assert not page._do_some()


def test_actions_of_viewers_who_left_are_dropped(page, messages, monkeypatch):
    """The end of pouring is not among them, because the spout would stay open."""
    done, (present, away) = [], (SimpleNamespace(client_id=number) for number in (1, 2))
    monkeypatch.setattr(page.server, "get_clients", lambda: {1: present})
    for client, key in ((present, None), (away, None), (away, "gravity"), (away, "pour"), (None, "other")):
        page.do(lambda client=client, key=key: done.append((client, key)), client, key)
    page._do_some()
    assert done == [(present, None), (away, "pour"), (None, "other")]


def test_a_frame_that_fails_pauses(page, messages, monkeypatch, capsys):
    """An unexpected error of the simulation pauses the session and is shown to all viewers. Restart continues."""
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
    page._do_some()
    assert sent == ["scene.zip"] and len(messages) == 3 and "download must be complete" in messages[0]


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
