"""Runs programs as forks of a Python process with the training stack loaded, because loading PyTorch and Lightning
takes seconds and the tests start dozens of trainings. `python warm_server.py LISTENER MODULES` loads them once and,
before any thread or device exists, forks for each request of warm_client.py, which replaces the interpreter: arguments,
folder, environment, network, standard streams, signals and exit status are the same. The processes of pytest-xdist are
such programs too.
"""

import atexit
import contextlib
import ctypes
import gc
import json
import os
import random
import runpy
import select
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from types import ModuleType

PRELOADED = (
    *("hgn.training.lightning_compat", "tensorboard.compat.proto.summary_pb2", "hydra", "h5py"),
    *("torch.distributed.run", "torch.distributed.elastic.rendezvous.c10d_rendezvous_backend", "scipy.spatial"),
    *("torch.distributed.algorithms.ddp_comm_hooks.debugging_hooks", "hgn.hydra_compat", "hgn.training.monitor"),
    *("hgn.rollout", "hgn.evaluate", "hgn.export", "hgn.train", "hgn.training.session", "hgn.training.tensorboard"),
)
FOR_TESTS = ("datagen.mpm.device", "matplotlib.pyplot", "mpl_toolkits.mplot3d", "pxr.Usd", "scipy.stats", "trimesh")
REQUEST_BYTES = 1 << 20
VARIABLE = "HGN_TESTS_WARM"  # the folder with the interpreter, `python`, in the environment of a run's processes


class WarmServer:
    """Makes the interpreter, whose first caller has the server started."""

    def __init__(self, modules=()):
        self._modules = modules
        self._folder = tempfile.TemporaryDirectory(prefix="hgn-tests-")
        folder, here = Path(self._folder.name), Path(__file__).parent
        os.environ[VARIABLE] = str(folder)
        command = f'exec {sys.executable} -SEs {here / "warm_client.py"} {folder / "socket"} "$@"'
        (folder / "python").write_text(f"#!/bin/sh\n{command}\n")
        (folder / "python").chmod(0o755)
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(folder / "socket"))
        self._listener.listen(64)
        self._wake, self._ended = socket.socketpair()
        self._server: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._start_when_asked)
        self._thread.start()

    def _start_when_asked(self):
        environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
        environment |= {"PYTHONPATH": str(Path(__file__).parents[1]), "OMP_NUM_THREADS": "1"}
        if self._listener in select.select([self._listener, self._wake], [], [])[0]:
            number = self._listener.fileno()
            command = [sys.executable, __file__, str(number), *self._modules]
            self._server = subprocess.Popen(command, env=environment, pass_fds=[number])
        self._listener.close()  # where the server has ended, its clients are refused

    def stop(self):
        self._ended.close()
        self._thread.join()
        self._wake.close()
        if self._server is not None:
            self._server.kill()
            self._server.wait()
        self._folder.cleanup()


def serve(listener):
    """Forks for each request. Returns a request only in the child."""
    wake_read, wake_write = os.pipe()
    os.set_blocking(wake_write, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake_write)
    selector = selectors.DefaultSelector()
    selector.register(listener, selectors.EVENT_READ)
    selector.register(wake_read, selectors.EVENT_READ)
    children: dict[int, socket.socket] = {}
    while True:
        for key, _ in selector.select():
            if key.fileobj is listener:
                connection, _ = listener.accept()
                data, streams, _, _ = socket.recv_fds(connection, REQUEST_BYTES, 3)
                while not data.endswith(b"\n"):
                    data += connection.recv(REQUEST_BYTES)
                child = os.fork()
                if child == 0:
                    signal.set_wakeup_fd(-1)
                    for inherited in (listener, connection, *children.values()):
                        inherited.close()
                    selector.close()
                    os.close(wake_read), os.close(wake_write)
                    for target, stream in enumerate(streams):
                        os.dup2(stream, target)
                        os.close(stream)
                    return json.loads(data)
                for stream in streams:
                    os.close(stream)
                connection.sendall(f"{child}\n".encode())
                children[child] = connection
                selector.register(connection, selectors.EVENT_READ, child)
            elif key.fileobj == wake_read:
                os.read(wake_read, 4096)
                while children:
                    child, status = os.waitpid(-1, os.WNOHANG)
                    if child == 0:
                        break
                    connection = children.pop(child)
                    with contextlib.suppress(KeyError):  # a client that was killed is no longer listened to
                        selector.unregister(connection)
                    with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # its client was killed
                        connection.sendall(f"{os.waitstatus_to_exitcode(status)}\n".encode())
                    connection.close()
            elif key.data in children and not key.fileobj.recv(1):  # the client was killed: so is the program
                os.kill(key.data, signal.SIGKILL)
                selector.unregister(key.fileobj)


def enter_network(path):
    """Of the process whose network namespace is at that path."""
    if not Path(path).samefile("/proc/self/ns/net"):
        with Path(path).open() as namespace:
            if ctypes.CDLL(None, use_errno=True).setns(namespace.fileno(), 0):
                raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), path)


def run(request):
    """Runs a program as the interpreter does with these arguments."""
    for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    random.seed()
    enter_network(request["network"])
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["environment"])
    arguments = request["arguments"]
    while arguments[:1] == ["-u"]:
        arguments = arguments[1:]
    paths = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    if arguments[0] == "-m":
        sys.path[:0] = ["", *paths]
        sys.argv = arguments[1:]
        sys.modules.pop(arguments[1], None)  # runpy warns of a program that is loaded already
        runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
    elif arguments[0] == "-c":
        sys.path[:0] = ["", *paths]
        sys.argv = ["-c", *arguments[2:]]
        main = sys.modules["__main__"] = ModuleType("__main__")  # spawned processes run nothing of this file
        exec(arguments[1], main.__dict__)
    else:
        sys.path[:0] = [str(Path(arguments[0]).parent), *paths]
        sys.argv = arguments
        runpy.run_path(arguments[0], run_name="__main__")


def leave(code):
    """Ends as the interpreter does, but for taking all modules apart, which takes a second."""
    if code is not None and not isinstance(code, int):
        print(code, file=sys.stderr)
    threading._shutdown()
    atexit._run_exitfuncs()
    status = code & 0xFF if isinstance(code, int) else int(code is not None)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            status = 120  # the interpreter's, where nobody reads what it writes
    os._exit(status)


if __name__ == "__main__":
    import importlib

    gc.disable()  # until all is loaded

    from hydra.core.plugins import Plugins

    for name in (*PRELOADED, *sys.argv[2:]):
        importlib.import_module(name)
    from torch.distributed.elastic.rendezvous import dynamic_rendezvous

    # at each step of its state machine torchrun looks through all modules for the source of each frame
    dynamic_rendezvous.get_method_name = lambda: sys._getframe(2).f_code.co_name
    Plugins.instance()  # Hydra's own, of which each command would look for all
    gc.collect()
    gc.freeze()  # else each program's collections touch all that was loaded
    gc.enable()
    request = serve(socket.socket(fileno=int(sys.argv[1])))
    try:
        run(request)
    except SystemExit as ending:
        leave(ending.code)
    leave(None)
