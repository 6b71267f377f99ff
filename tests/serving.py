"""The dataset service's server, beside the tests."""

import socket
import threading
from contextlib import contextmanager

from datagen.service.server import make_server


@contextmanager
def serving(app, port=0, **limits):
    """The service's server with another app or without a pool, in a thread: itself and its port."""
    listener = socket.create_server(("127.0.0.1", port))
    server = make_server(app, **limits)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        yield server, listener.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join()
