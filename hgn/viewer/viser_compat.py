"""Contains all changes to Viser's private parts; pyproject.toml bounds its version.

Viser serves its page and its websocket to every client of the port. Here the path of both begins with a token. The page
opens its websocket below its own path. A cookie would be sent to the servers of all ports of the host.
`tests/viewer/test_page.py` fails if a new version has changed these parts.
"""

import asyncio
import contextlib
import functools
import hmac
import http
import io
import logging
import math
import secrets
import socket
import sys
import traceback
import typing
import zlib
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest import mock

import msgspec
import viser
import websockets.asyncio.server
from viser import _gui_api, infra
from viser import _messages as messages
from viser._gui_api import GuiApi
from viser._gui_handles import GuiUploadButtonHandle
from websockets import Headers, State
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosedError
from websockets.http11 import Request, Response

from hgn.schema import require

MAXIMUM_UNFINISHED_BYTES = 128 << 20  # bytes of the incomplete uploads of all viewers
UPLOAD_BYTES, PART_BYTES = 1 << 20, 200  # bytes that are added for each upload and each of its parts
MOST_OPENING = 64  # number of connections without the token; a further one closes the oldest
MAXIMUM_MESSAGE_BYTES = 1 << 20  # bytes of a message from a viewer; parts of uploads have 512 KiB
LONGEST_TEXT, LARGEST_NUMBER = 1000, 2**53  # characters of a text in a message; largest integer of a browser
REFUSAL = b"open the address that hgn.play printed, with its token\n"
SENT = (
    *(messages.SceneNodeClickMessage, messages.SceneNodeDragMessage, messages.ScenePointerMessage),
    *(messages.FileTransferStartUpload, messages.FileTransferPart, messages.ViewerCameraMessage),
)  # messages that viewers may send, in addition to values of controls
_kinds: Callable[[Any], dict[str, Any]] = functools.cache(typing.get_type_hints)
Process = Callable[[Any, Request], Response | None]
_LOG = logging.getLogger(__name__)
# websockets logs it with a traceback for each connection that a browser opens and never uses
_LOG.addFilter(lambda record: record.msg != "opening handshake failed")
# Viser stores each broadcast under a key. Each part of an upload has its own key, so Viser would store all of them.
messages.FileTransferPartAck.redundancy_key = (  # type: ignore[method-assign]
    lambda ack: f"{type(ack).__name__}-{zlib.crc32(ack.transfer_uuid.encode()) % 64}"  # type: ignore[assignment]
)
# Viser warns of values with a wrong length, and Python stores the text of each warning. `is_sent` drops such messages.
for module in (infra._messages, _gui_api):
    module.warnings = SimpleNamespace(warn=lambda *_, **__: None)  # type: ignore[attr-defined]
_consume = infra._infra._message_consumer


async def _message_consumer(*arguments: Any) -> None:
    """Handles a viewer's messages. Invalid bytes close the connection without a traceback in the log."""
    try:
        await _consume(*arguments)
    except Exception:  # noqa: BLE001 - they may contain any value
        raise ConnectionClosedError(None, None) from None


infra._infra._message_consumer = _message_consumer  # type: ignore[assignment]


def start_server(host: str, port: int, label: str) -> tuple[viser.ViserServer, str]:
    """Returns a Viser server and the address that opens it, with the token. A taken port is replaced by the next free.

    Raises ConfigError for a host that is not an address of this machine.
    """
    try:
        socket.create_server((host, 0)).close()
    except OSError as error:  # Viser would wait for ever
        require(False, "host", "an address of this machine", host, str(error))
    token = secrets.token_urlsafe(16)
    serve = websockets.asyncio.server.serve

    def guarded_serve(*args: Any, process_request: Process, **options: Any) -> Any:
        options["max_size"] = MAXIMUM_MESSAGE_BYTES
        options["create_connection"] = shedding()
        options["logger"] = _LOG
        select = options["select_subprotocol"]
        # the name is part of the close frame of another version, which has at most 125 bytes
        options["select_subprotocol"] = lambda place, names: select(place, [name for name in names if len(name) <= 40])
        return serve(*args, process_request=guarded(process_request, token), **options)

    handlers = ("_handle_file_transfer_start", "_handle_file_transfer_part")
    limited: dict[str, Any] = {name: bounded(getattr(GuiApi, name)) for name in handlers}
    limits = mock.patch.multiple(GuiApi, **limited)
    unsaid = contextlib.redirect_stdout(io.StringIO())  # Viser prints an address without the token
    with unsaid, limits, mock.patch.object(websockets.asyncio.server, "serve", guarded_serve):
        server = viser.ViserServer(host, port, label, verbose=False)

    def admit(handler: infra.WebsockMessageHandler) -> None:
        handler._handle_incoming_message = admitting(  # type: ignore[method-assign]
            handler._handle_incoming_message, server.gui
        )

    admit(server._websock_server)
    server._websock_server.on_client_connect(admit)
    shown = "127.0.0.1" if host in ("0.0.0.0", "localhost") else host
    return server, f"http://{shown}:{server.get_port()}/{token}/"


def shedding() -> type[ServerConnection]:
    """Returns a class of connections that limits those without a token: they could use up the process's open files."""
    opening: deque[ServerConnection] = deque()

    class Shedding(ServerConnection):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            opening.append(self)
            if len(opening) > MOST_OPENING and (oldest := opening.popleft()).state is State.CONNECTING:
                oldest.transport.abort()

    return Shedding


def admitting(handle: Callable[..., Any], gui: GuiApi) -> Callable[..., Any]:
    """Drops messages that the page's controls cannot send. Viser would set any attribute of a control they name."""

    async def answer(client: int, message: Any) -> None:
        if is_sent(message, gui._gui_input_handle_from_uuid):
            await handle(client, message)

    return answer


def is_sent(message: Any, controls: dict[str, Any]) -> bool:
    """Returns whether a control of the page can have sent a message.

    Viser converts values to any type, and stores an uploaded file as the value of any control that is named with it.
    """
    updates, fields = isinstance(message, messages.GuiUpdateMessage), vars(message)
    if not (updates or (isinstance(message, SENT) and all(map(is_short, fields.values())) and is_typed(message))):
        return False
    name = fields.get("uuid", fields.get("source_component_uuid"))
    control = controls.get(name) if isinstance(name, str) else None
    if updates:
        given = message.updates if isinstance(message.updates, dict) else {}
        if control is None or given.keys() != {"value"}:
            return False
        value = given["value"]
        return replaces(value, control._impl.value) and value in getattr(control, "options", [value])
    if isinstance(message, messages.ScenePointerMessage):
        rays = message.ray_origin and message.ray_direction
        return bool(message.event_type == "click" and rays and message.screen_pos)
    upload = "source_component_uuid" not in fields or isinstance(control, GuiUploadButtonHandle)
    return upload and isinstance(fields.get("content", b""), bytes)


def is_typed(message: Any) -> bool:
    """Returns whether fields have the types that Viser declares. It ends the connection of a camera with others."""
    if isinstance(message, messages.ViewerCameraMessage):
        return True
    kinds = _kinds(type(message))
    try:
        for name, value in vars(message).items():
            msgspec.convert(value, kinds[name])
    except (msgspec.ValidationError, KeyError):
        return False
    return True


def is_short(value: Any) -> bool:
    """Returns whether a field of a message is bounded and finite. The size of bytes is bounded by `bounded`."""
    if isinstance(value, tuple):
        return len(value) <= 4 and all(map(is_short, value))
    if isinstance(value, (int, float)):  # larger integers cannot be sent to the other viewers; False for NaN
        return abs(value) <= LARGEST_NUMBER
    return value is None or isinstance(value, bytes) or (isinstance(value, str) and len(value) <= LONGEST_TEXT)


def replaces(value: Any, present: Any) -> bool:
    """Returns whether a value has the type of a control's present value."""
    if isinstance(present, tuple):
        return isinstance(value, (list, tuple)) and len(value) == len(present) and all(map(replaces, value, present))
    if isinstance(value, int):
        return isinstance(present, (int, float)) and is_short(value)
    return isinstance(value, (float, str)) and type(value) is type(present) and is_short(value)


def bounded(handle: Callable[..., None]) -> Callable[..., None]:
    """Drops the uploads of the viewer with the most bytes if all incomplete uploads together are too large."""

    def answer(gui: GuiApi, client: int, message: Any) -> None:
        sizes: Counter[int] = Counter({client: len(getattr(message, "content", b""))})
        for state in list(gui._current_file_upload_states.values()):
            sizes[state["client_id"]] += state["transferred_bytes"] + PART_BYTES * len(state["parts"]) + UPLOAD_BYTES
        if sizes.total() > MAXIMUM_UNFINISHED_BYTES:
            gui._drop_uploads_from_client(sizes.most_common(1)[0][0])  # type: ignore[arg-type]
        handle(gui, client, message)  # ignores parts of dropped uploads

    return answer


def require_taken(client: viser.ClientHandle) -> None:
    """Raises ConfigError if an earlier file still waits to be sent to a viewer."""
    waiting = list(client._websock_connection.get_message_buffer().message_from_id.values())
    count = sum(isinstance(message, messages.FileTransferPart) for message in waiting)
    require(count == 0, "download", "complete before the next", f"{count} waiting parts")


def stop_server(server: viser.ViserServer) -> None:
    """Ends a server and its thread."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def guarded(process: Process, token: str) -> Process:
    """Passes on requests whose path begins with the token, without it. Refuses all others, and those of other pages."""

    def answer(connection: Any, request: Request) -> Response | None:
        path, mark, query = request.path.partition("?")
        given, _, rest = path.removeprefix("/").partition("/")
        own = {f"{scheme}://{host}".lower() for host in request.headers.get_all("Host") for scheme in ("http", "https")}
        foreign = any(origin.lower() not in own for origin in request.headers.get_all("Origin"))
        # bytes that are not valid text have become lone surrogates here
        if foreign or not hmac.compare_digest(given.encode(errors="replace"), token.encode()):
            headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(REFUSAL))})
            return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, REFUSAL)
        # Viser answers a name that no file can have with status 500; the files of its page have shorter ones
        response = process(connection, replace(request, path=f"/{rest[:200]}{mark}{query}"))
        if response is not None:
            response.headers["Referrer-Policy"] = "no-referrer"
        return response

    return answer


def updates(show: Callable[[], Any]) -> bool:
    """Changes the view of all viewers. Returns False after a failure, and the caller tries again.

    viser wakes its event loop from this thread without a lock. This fails at times while a viewer comes or goes.
    """
    try:
        show()
    except Exception as error:  # noqa: BLE001 - one viewer's connection must not end the session of all
        traceback.print_exception(error, file=sys.stderr)
        return False
    return True


def clamped(slider: Any) -> float:
    """Returns the value of a slider within its range, or its lower limit for NaN."""
    value = float(slider.value)
    return float(slider.min) if math.isnan(value) else min(max(value, float(slider.min)), float(slider.max))
