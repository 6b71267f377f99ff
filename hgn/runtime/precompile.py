"""Triton kernels compiled before they are needed, by child processes.

Triton compiles a kernel when it is first launched, one after the other, a second or more each: a minute before a
training's first update, and again in the midst of a simulation that grows. The children fill its cache on disk; what
they miss is compiled as ever.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Self

import torch

from hgn.config import NetworkConfig
from hgn.runtime.backend import triton_unsupported_reason
from hgn.runtime.precompile_program import FrameJob, PrecompileJob, job_text
from hgn.step_config import StepConfig
from hgn.system.machine import available_cpus
from hgn.system.processes import die_with_parent

MOST_PROCESSES = 12
CELL_FRACTIONS = (0.1, 0.4, 1.2)  # of the particles
COMMAND = (sys.executable, "-m", "hgn.runtime.precompile_program")


class Precompilation:
    """Processes that compile; they end with this one, and Ctrl-C reaches only this one."""

    def __init__(
        self, job: PrecompileJob | FrameJob, processes: int | None = None, command: Sequence[str] = COMMAND
    ) -> None:
        """Starts them: as many as there are cores but two, where `processes` does not say; they yield to all others."""
        processes = processes or max(1, min(MOST_PROCESSES, available_cpus() - 2))
        self._started = time.monotonic()
        self._files = contextlib.ExitStack()
        self._messages = [self._files.enter_context(tempfile.TemporaryFile()) for _ in range(processes)]  # noqa: SIM115
        self._processes = [
            subprocess.Popen(
                [*command, str(part), str(processes)],
                stdin=subprocess.PIPE,
                stdout=message,
                stderr=message,
                preexec_fn=partial(die_with_parent, signal.SIGINT),
                process_group=0,
            )
            for part, message in enumerate(self._messages)
        ]
        for process in self._processes:
            assert process.stdin is not None
            with contextlib.suppress(BrokenPipeError), process.stdin:  # if it has ended already, `wait` tells
                process.stdin.write(job_text(job).encode())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    @property
    def running(self) -> bool:
        return any(process.poll() is None for process in self._processes)

    def wait(self, interrupted: Callable[[], bool] = lambda: False) -> str:
        """Waits until all have ended or `interrupted` says so; what to tell the user."""
        while self.running:
            if interrupted():
                self.stop()
                return "backend triton: compiling was interrupted"
            time.sleep(0.05)
        seconds = time.monotonic() - self._started
        texts = [self._message(i) for i in range(len(self._processes))]
        failed = [i for i, process in enumerate(self._processes) if process.returncode != 0]
        if failed:
            return (
                f"backend triton: {len(failed)} of {len(self._processes)} processes that compile kernels ahead failed "
                f"(exit code {self._processes[failed[0]].returncode}: {texts[failed[0]]}); "
                "what is missing is compiled when it is first used"
            )
        count = sum(int(text) for text in texts)
        return f"backend triton: {count} kernels ready {seconds:.0f} s after the start"

    def stop(self) -> None:
        """Ends those that still run; the cache holds whole kernels only."""
        for process in self._processes:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        self._files.close()

    def _message(self, index: int) -> str:
        """The last line that the process wrote."""
        file = self._messages[index]
        file.seek(0)
        lines = file.read().decode("utf-8", "replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "no message")


def precompile_frames(
    networks: Sequence[tuple[NetworkConfig, StepConfig]],
    precisions: Sequence[str],
    device: torch.device,
    particles: Sequence[int],
) -> Precompilation | None:
    """Compiles what simulations of so many particles launch, however far they spread; none where nothing is."""
    if device.type != "cuda" or torch.version.hip is not None:
        return None
    pairs = [
        (network, step, precision)
        for network, step in dict.fromkeys(networks)
        for precision in dict.fromkeys(precisions)
        if network.kind == "hgn" and triton_unsupported_reason(device, network, precision) is None
    ]
    if not pairs:
        return None
    major, minor = torch.cuda.get_device_capability(device)
    return Precompilation(FrameJob(tuple(pairs), frame_sizes(particles), 10 * major + minor))


def frame_sizes(particles: Sequence[int]) -> tuple[tuple[int, int], ...]:
    """Particles, and cells of the finest level from dense groups to where they lie spread: kernels differ by rows."""
    some = sorted(set(particles))
    some = sorted({some[0], some[len(some) // 2], some[-1]})
    return tuple((count, max(1, int(fraction * count))) for count in some for fraction in CELL_FRACTIONS)
