"""Compiles the kernels of a training's updates before they are needed, in child processes.

Triton compiles a kernel at its first launch, one kernel after the other, in a second or more each. This takes a minute
before a training's first update. The children fill Triton's cache on disk. Kernels that are not in it are compiled at
their first launch. Simulations compile theirs in threads (hgn.kernels.triton_compat) before their first frame.
"""

import contextlib
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Self

from hgn.runtime.precompile_program import PrecompileJob, job_text
from hgn.system.machine import available_cpus
from hgn.system.processes import Program, last_message

MOST_PROCESSES = 12  # largest number of compiling processes
COMMAND = (sys.executable, "-m", "hgn.runtime.precompile_program")


class Precompilation:
    """Processes that compile kernels."""

    def __init__(self, job: PrecompileJob, processes: int | None = None, command: Sequence[str] = COMMAND) -> None:
        """Starts `processes` with low priority, by default two fewer than there are cores."""
        processes = processes or max(1, min(MOST_PROCESSES, available_cpus() - 2))
        self._started = time.monotonic()
        self._files = contextlib.ExitStack()
        outputs = [self._files.enter_context(tempfile.TemporaryFile()) for _ in range(processes)]  # noqa: SIM115
        text = job_text(job)
        self._programs = [
            Program([*command, str(part), str(processes)], output, text) for part, output in enumerate(outputs)
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    @property
    def running(self) -> bool:
        return any(program.exit_code is None for program in self._programs)

    def wait(self, interrupted: Callable[[], bool] = lambda: False) -> str:
        """Waits until all have ended or `interrupted` returns True. Returns a message for the user."""
        while self.running:
            if interrupted():
                self.stop()
                return "backend triton: compiling was interrupted"
            time.sleep(0.05)
        seconds = time.monotonic() - self._started
        failed = [program for program in self._programs if program.exit_code != 0]
        if failed:
            return (
                f"backend triton: {len(failed)} of {len(self._programs)} processes that compile kernels ahead failed "
                f"(exit code {failed[0].exit_code}: {last_message(failed[0].output)}); "
                "what is missing is compiled when it is first used"
            )
        count = sum(int(last_message(program.output)) for program in self._programs)
        return f"backend triton: {count} kernels ready {seconds:.0f} s after the start"

    def stop(self) -> None:
        """Ends those that still run. The cache contains only complete kernels."""
        for program in self._programs:
            program.stop()
        self._files.close()
