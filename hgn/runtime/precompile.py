"""Compiles Triton kernels before they are needed, in child processes.

Triton compiles a kernel at its first launch, one kernel after the other, in a second or more each. This takes a minute
before a training's first update. The children fill Triton's cache on disk. Kernels that are not in it are compiled at
their first launch, or by the threads of hgn.kernels.triton_compat before a simulation's first frame.
"""

import contextlib
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Self

import torch

from hgn.config import NetworkConfig
from hgn.runtime.backend import triton_unsupported_reason
from hgn.runtime.precompile_program import FrameJob, PrecompileJob, job_text
from hgn.step_config import StepConfig
from hgn.system.machine import available_cpus
from hgn.system.processes import Program, last_message

MOST_PROCESSES = 12  # largest number of compiling processes
CELL_FRACTIONS = (0.1, 0.4, 1.2)  # finest cells per particle, from dense to spread groups
COMMAND = (sys.executable, "-m", "hgn.runtime.precompile_program")


class Precompilation:
    """Processes that compile kernels."""

    def __init__(
        self, job: PrecompileJob | FrameJob, processes: int | None = None, command: Sequence[str] = COMMAND
    ) -> None:
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


def precompile_frames(
    networks: Sequence[tuple[NetworkConfig, StepConfig]],
    precisions: Sequence[str],
    device: torch.device,
    particles: Sequence[int],
) -> Precompilation | None:
    """Starts to compile the kernels of simulations with these particle counts; None without backend triton."""
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
    """Returns pairs of particles and finest cells, from dense to spread groups. Kernels depend on the row count."""
    some = sorted(set(particles))
    some = sorted({some[0], some[len(some) // 2], some[-1]})
    return tuple((count, max(1, int(fraction * count))) for count in some for fraction in CELL_FRACTIONS)
