"""Raw messages of viewers to the page of hgn.play: values of controls, uploads, cameras, and bytes that are none."""

import asyncio

import pytest
from processes import wait_until
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

pytest.importorskip("viser", reason="viser is not installed: pip install 'hgn[play]'")
import msgspec
import viser

from hgn.viewer import viser_compat
from hgn.viewer.film import FilmPage

# viser keeps its event loop's threads and sockets until the garbage collector comes
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
INFINITE, NAN = float("inf"), float("nan")


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


def pointed(**other):
    """A click into the scene."""
    ray = {"ray_origin": (0.0, 0.0, 0.0), "ray_direction": (0.0, 0.0, 1.0), "screen_pos": ((0.5, 0.5),)}
    values = {"event_type": "click", "modifier": None} | ray | other
    return lambda page: viser_compat.messages.ScenePointerMessage(**values)


def dragged(**other):
    """A motion of the mouse with a button pressed."""
    values = {"phase": "update", "name": "/room", "instance_index": None, "button": "left", "modifier": "shift"}
    values |= {f"{at}_position": (0.5, 0.5, 0.5) for at in ("start", "end")}
    values |= {f"{at}_screen_pos": (0.5, 1) for at in ("start", "end")}
    return lambda page: viser_compat.messages.SceneNodeDragMessage(**values | other)


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
        *((part("Own mesh", content), False) for content in ([[]], "x", None)),
        *((updated(label, value="x"), False) for label in ("Back by", "Weights", "Material")),
        (updated("Size", value=NAN), False),
        (pointed(), True),
        *((pointed(**{name: None}), False) for name in ("ray_origin", "ray_direction")),
        *((pointed(**other), False) for other in ({"event_type": "rect-select"}, {"screen_pos": ()})),
        *((pointed(ray_origin=value), False) for value in ((0.0, NAN, 0.0), [0.0, 1.0], (0.0, 0.0, -INFINITE))),
        *(
            (pointed(ray_origin=value), False)
            for value in (3 * (None,), (0.0, 0.0), (1e308, 0.0, 0.0), (True, 0.0, 0.0))
        ),
        *((upload("Own mesh", filename=value), False) for value in (None, b"a.obj", 5, ("a.obj",))),
        *((upload("Own mesh", part_count=value), False) for value in (0.5, None, "x")),
        (dragged(), True),
        *((dragged(end_screen_pos=value), False) for value in ((1e308, 0), (None, 0), (), ("a", "b"))),
        *((dragged(**other), False) for other in ({"phase": "x"}, {"name": 5}, {"end_position": (0.5, 0.5)})),
        (lambda page: viser_compat.messages.ShareUrlRequest(), False),
        (lambda page: viser_compat.messages.ResetGuiMessage(), False),
    ],
)
def test_messages_that_are_not_of_the_page(page, monkeypatch, message, passes):
    """A viewer can set only values of controls, of their types. Only the upload button accepts files, with bounded
    texts and with numbers that can be sent to other viewers. The server requests no address."""
    asked, handled = [], page.server._websock_server._incoming_handlers
    for kind in ("ShareUrlRequest", "ScenePointerMessage", "SceneNodeDragMessage"):
        monkeypatch.setitem(
            handled, getattr(viser_compat.messages, kind), [lambda client, message: asked.append(message)]
        )
    sent, uploads = message(page), page.server.gui._current_file_upload_states
    before = {name: dict(vars(state)) for name, state in controls(page).items()} | {"uploads": {*uploads}}
    received(page, 0, [sent])
    after = {name: dict(vars(state)) for name, state in controls(page).items()} | {"uploads": {*uploads}}
    for name, state in controls(page).items():
        vars(state).update(before[name])
    page.server.gui._drop_uploads_from_client(0)
    assert (after != before or bool(asked)) == passes


def test_pouring_on_a_cpu_is_slow_by_default(page):
    """One stroke of full speed would fill the 8,000 particles of a CPU within two seconds."""
    assert controls(page)["Speed"].value == 0.5


CAMERA = viser_compat.messages.ViewerCameraMessage(
    (1.0, 0.0, 0.0, 0.0), (0.5, 0.9, 2.0), 1.0, 0.01, 100.0, 600, 900, (0.5, 0.4, 0.5), (0.0, 1.0, 0.0)
).as_serializable_dict()


@pytest.mark.parametrize("closes", [True, False])
def test_malformed_messages_are_dropped(page, capfd, caplog, recwarn, closes):
    """Bytes that are no message close their connection. A camera with too many numbers is ignored. Neither is kept or
    logged, because a viewer can send any number of them."""
    raw = [b"", b"\xff\xff", b"\x05", b"\xc0", b"\x80", 10_000 * b"\x91", b"\xdf\xff\xff\xff\xff", "text"]
    raw += [msgspec.msgpack.encode({"type": kind}) for kind in ("x", ["x"], "Message", "ViewerCameraMessage")]
    raw += [msgspec.msgpack.encode(CAMERA | {"fov": value}) for value in ("x", None, [1.0])]
    others = [(), 1000 * (0.5,), (0.5, NAN, 0.5), (0.5, 0.5, INFINITE)]
    kept = [msgspec.msgpack.encode(CAMERA | {"position": value}) for value in others]
    for sent in raw if closes else [kept]:
        options = {"subprotocols": [f"viser-v{viser.__version__}"], "max_size": None}
        with connect(page.address.replace("http", "ws"), **options) as viewer:
            for message in [sent] if closes else [*sent, msgspec.msgpack.encode(CAMERA)]:
                viewer.send(message)
            if closes:
                with pytest.raises(ConnectionClosed):
                    while True:
                        viewer.recv(60)
            else:
                wait_until(page.server.get_clients)
                (client,) = page.server.get_clients().values()
                wait_until(lambda client=client: client.camera.position.tolist() == [0.5, 0.9, 2.0])
    printed = capfd.readouterr()
    assert printed.out + printed.err + caplog.text == "" and not len(recwarn)


@pytest.mark.parametrize("version", ["viser-v0", "viser-v" + 7000 * "x", "x"])
def test_viewers_of_another_version(page, caplog, version):
    """A viewer that names another version, however long, is closed without a trace."""
    with connect(page.address.replace("http", "ws"), subprotocols=[version]) as viewer, pytest.raises(ConnectionClosed):
        viewer.recv(60)
    assert caplog.text == ""


def test_acknowledgements_of_parts_are_not_kept(page):
    """Uploads of meshes in thousands of parts leave few stored messages for later viewers."""
    kept = page.server._websock_server._broadcast_buffer.message_from_id
    before = len(kept)
    for number in range(100):
        received(page, 1, parts(page, str(number), 20, 1))
    assert len(kept) - before <= 64
    page.server.gui._drop_uploads_from_client(1)


@pytest.mark.parametrize(("uploads", "count", "size"), [(40, 2, 1 << 20), (3, 3_000, 1), (300, 0, 0)])
def test_unfinished_uploads_are_bounded(page, monkeypatch, uploads, count, size):
    """Uploads that never become whole are dropped, those of the viewer with the most first: large parts, many parts,
    none at all."""
    monkeypatch.setattr(viser_compat, "MAXIMUM_UNFINISHED_BYTES", 10 << 20)
    monkeypatch.setattr(viser_compat, "PART_BYTES", 2_000)
    states = page.server.gui._current_file_upload_states
    received(page, 1, parts(page, "small", 1, 100))
    for number in range(uploads):
        received(page, 2, parts(page, str(number), count, size))
        assert sum(state["transferred_bytes"] for state in states.values()) <= 10 << 20
        assert len(states) <= 11 and sum(len(state["parts"]) for state in states.values()) <= 5_300
    assert states["small"]["transferred_bytes"] == 100
    for client in (1, 2):
        page.server.gui._drop_uploads_from_client(client)


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
