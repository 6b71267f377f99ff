"""The processes of trees: one each that is asked in lines of JSON, and before that some that compile."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Self

from hgn.system.processes import die_with_parent
from tools.compare.trees import Tree

PROGRAMS = Path(__file__).parent
LOG_LINES = 8  # that are told of a process that died
LEAST_PATIENCE_S = 60.0  # for an answer, however little time is left


class Children:
    """Starts processes of trees; they end with this one, and Ctrl-C reaches only this one."""

    def __init__(self, settings: dict[str, Any], room: Path, interpreter: bool) -> None:
        """`settings`: of the programs. `room`: for logs and caches. `interpreter`: kernels run in Triton's."""
        self.settings, self.room, self.interpreter = json.dumps(settings), room, interpreter
        self._processes: list[subprocess.Popen[str]] = []
        self._children: list[Child] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for process in self._processes:
            _end(process)
        for child in self._children:
            child.close()

    def serve(self, tree: Tree) -> Child:
        """The tree's process that answers."""
        child = Child(tree, self._start(tree, "server.py", (), subprocess.PIPE), self._log(tree))
        self._children.append(child)
        return child

    def compile(self, trees: Sequence[Tree], shares: int, stop: Callable[[], bool]) -> str:
        """Compiles all trees' kernels at once, `shares` processes each, until `stop` says so; what to tell of it."""
        started = time.monotonic()
        running = [
            (tree, self._start(tree, "compiler.py", (str(share), str(shares)), None))
            for tree in trees
            for share in range(shares)
        ]
        while any(process.poll() is None for _, process in running) and not stop():
            time.sleep(0.1)
        late = [process for _, process in running if process.poll() is None]
        for process in late:
            _end(process)
        told = f"compiled by {len(running)} processes in {time.monotonic() - started:.0f} s"
        if late:
            told += f"; {len(late)} of them were stopped, and the rest is compiled when it is first used"
        failed = {tree.name: tree for tree, process in running if process.returncode and process not in late}
        return "; ".join([told, *(f"{name} failed: {end_of(self._log(tree))}" for name, tree in failed.items())])

    def _log(self, tree: Tree) -> Path:
        return self._of(tree) / "log.txt"

    def _of(self, tree: Tree) -> Path:
        return self.room / f"process_{tree.number}"

    def _start(self, tree: Tree, program: str, arguments: Sequence[str], channel: int | None) -> subprocess.Popen[str]:
        self._of(tree).mkdir(parents=True, exist_ok=True)
        paths = [str(tree.folder), *filter(None, [os.environ.get("PYTHONPATH")])]
        own = {"PYTHONPATH": os.pathsep.join(paths), "TRITON_CACHE_DIR": str(self._of(tree) / "cache")}
        if self.interpreter:
            own["TRITON_INTERPRET"] = "1"
        with self._log(tree).open("a") as log:
            process = subprocess.Popen(
                [sys.executable, "-P", str(PROGRAMS / program), self.settings, *arguments],
                env={**os.environ, **own},
                cwd=tree.folder,
                stdin=channel or subprocess.DEVNULL,
                stdout=channel or log,
                stderr=log,
                text=True,
                preexec_fn=partial(die_with_parent, signal.SIGKILL),
                process_group=0,
            )
        self._processes.append(process)
        return process


class Child:
    """A tree's process that answers orders, in their order. One that died answers each with its end."""

    def __init__(self, tree: Tree, process: subprocess.Popen[str], log: Path) -> None:
        self.tree, self.process, self.log = tree, process, log
        self._answers: queue.Queue[dict[str, Any]] = queue.Queue()
        self._last: dict[str, Any] | None = None  # said from now on, for the process is at its end
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def tell(self, order: str, **arguments: Any) -> None:
        """Gives an order, whose answer is waited for later."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it died; `answer` tells
            self.process.stdin.write(json.dumps({"order": order, **arguments}) + "\n")
            self.process.stdin.flush()

    def answer(self, patience_s: float) -> dict[str, Any]:
        """The next answer; `error` in it says what went wrong. Who lets us wait for too long is ended."""
        if self._last is not None:
            return self._last
        patience_s = max(LEAST_PATIENCE_S, patience_s)
        try:
            found = self._answers.get(timeout=patience_s)
        except queue.Empty:
            _end(self.process)
            found = {"error": f"no answer in {patience_s:.0f} s: {end_of(self.log)}", "ended": True}
        if "ended" in found:
            self._last = found
        return found

    def ask(self, order: str, patience_s: float, **arguments: Any) -> dict[str, Any]:
        self.tell(order, **arguments)
        return self.answer(patience_s)

    def close(self) -> None:
        """What is left once the process has ended."""
        assert self.process.stdin is not None
        self._reader.join()
        with contextlib.suppress(BrokenPipeError):  # of an order that nobody has read
            self.process.stdin.close()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout:
            for line in self.process.stdout:
                if line.endswith("\n"):  # it may have died in the midst of one
                    self._answers.put(json.loads(line))
        code = self.process.wait()
        self._answers.put({"error": f"the process died (exit code {code}): {end_of(self.log)}", "ended": True})


def end_of(log: Path) -> str:
    """The last lines of a log, in one."""
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return " | ".join(lines[-LOG_LINES:]) or "no message"


def _end(process: subprocess.Popen[str]) -> None:
    """Ends a process and what it has started, and waits for it."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
