"""`python -m datagen.service +experiment=obstacles out=data/obstacles`: generates a data set and serves it over HTTP.

Training reads it from any machine with `dataset.folder=http://HOST:PORT`, while it grows. After Ctrl-C or SIGTERM the
folder can be resumed. Started on a complete data set, the command only serves.
"""

from __future__ import annotations

import errno
import ipaddress
import socket
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hgn.command import run_command
from hgn.schema import Bounded, ConfigError, Port, from_mapping
from hgn.system.machine import allow_open_files

if TYPE_CHECKING:
    from datagen.pool.worker import Backend

_OPEN_FILES = 65536
_SERVICE_KEYS = ("host", "port", "health_port")


@dataclass(frozen=True)
class ServiceConfig(Bounded):
    """`python -m datagen.service`: the server, in addition to the settings of `python -m datagen`."""

    host: str = "127.0.0.1"  # address to listen on; any other needs a token in $HGN_DATASET_TOKEN
    port: Port = 8000  # 0: any free port
    health_port: Port | None = None  # second port for /healthz, which answers even if the service is busy; null: no


def main(mapping: dict[str, Any], backend: Backend | None = None) -> int:
    """Serves until it is stopped. The exit code is 128 + the signal."""
    from datagen.generate import datagen_config, require_local_folder, stop_signals
    from datagen.pool.progress import make_progress
    from datagen.service.health import HealthPage
    from datagen.service.log import UnhurriedLog
    from datagen.service.supervisor import Supervisor
    from hgn.data.identity import require_same_dataset
    from hgn.data.manifest import MANIFEST_NAME, Manifest
    from hgn.data.storage import dataset_token

    progress = make_progress(mapping.get("progress", "bar"))
    config = datagen_config(mapping, _SERVICE_KEYS)
    service = from_mapping(ServiceConfig, {key: mapping[key] for key in _SERVICE_KEYS if key in mapping})
    require_local_folder(config)
    folder = Path(config.dataset.folder)
    if (folder / MANIFEST_NAME).exists():
        require_same_dataset(Manifest.load(folder).config, config, folder)
    token = dataset_token()
    with ExitStack() as stack, stop_signals() as stop:
        listener = stack.enter_context(_listen(service.host, service.port, token))
        log = stack.enter_context(UnhurriedLog())
        page = None
        if service.health_port is not None:
            page = stack.enter_context(HealthPage(_listen(service.host, service.health_port, token)))
        # imported here, because it takes a second, and the pool's processes import this file without using it
        from datagen.service.server import make_app, make_server, telling

        with Supervisor(config, progress, backend) as supervisor:
            app = make_app(
                folder, token, lambda: replace(supervisor.state, log_error=log.error or supervisor.state.log_error)
            )
            every_second = None if page is None else telling(page, app)
            server = make_server(app, open_files=allow_open_files(_OPEN_FILES), every_second=every_second)

            def end(_: object = None) -> None:
                server.should_exit = True

            supervisor.on_unusable = end
            stop.call(end)
            if supervisor.unusable is None:
                host, port, *_ = listener.getsockname()
                host = f"[{host}]" if ":" in host else host
                progress.message(
                    f"serving {folder} at http://{host}:{port}" + ("" if token is None else ", with a token")
                )
                server.run(sockets=[listener])
        if supervisor.unusable is not None:
            raise ConfigError(supervisor.unusable)
    return stop.exit_code


def _listen(host: str, port: int, token: str | None) -> socket.socket:
    """Returns the socket to serve on.

    Raises: ConfigError if the port is taken, the host is not an address of this machine, or everybody could read.
    """
    from hgn.data.storage import TOKEN_VARIABLE

    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        if token is None and not ipaddress.ip_address(address[0]).is_loopback:
            raise ConfigError(
                f"host must be a loopback address without a token, got {host!r}; set {TOKEN_VARIABLE} in the "
                "environment of the service and of its readers"
            )
        return socket.create_server(address[:2], family=family, backlog=1024)
    except (OSError, UnicodeError) as error:  # UnicodeError: text that cannot be a host name
        number, cause = (error.errno, error.strerror) if isinstance(error, OSError) else (None, error)
        remedies = {
            errno.EADDRINUSE: "stop the program there or choose another port=... (0: any free one)",
            errno.EACCES: "choose a port of 1024 or more",
        }
        remedy = remedies.get(number or 0, "choose host=127.0.0.1, or an address of this machine")
        raise ConfigError(f"host and port must be available, got {host}:{port} ({cause}); {remedy}") from None


if __name__ == "__main__":
    run_command(main, "service")
