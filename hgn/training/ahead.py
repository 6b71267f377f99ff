"""The fast path's kernels compiled before they are needed: by child processes, while the first episodes are made.

Triton compiles a kernel when it is first launched, one after the other: a minute before the first update on a machine
that has not run them. The children fill its cache on disk; what they miss is compiled as ever.
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

from hgn.config import SceneConfig, TrainConfig
from hgn.kernels.ahead import AheadJob, job_text
from hgn.kernels.update.op import UpdateSettings
from hgn.parent import die_with_parent
from hgn.runtime.path import KERNEL_PRECISION

MOST_PROCESSES = 12
COMMAND = (sys.executable, "-m", "hgn.kernels.ahead")


class AheadCompilation:
    """Processes that compile; they end with this one, and Ctrl-C reaches only this one."""

    def __init__(self, job: AheadJob, processes: int | None = None, command: Sequence[str] = COMMAND) -> None:
        """Starts them: half as many as there are cores, where `processes` does not say."""
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        processes = processes or max(1, min(MOST_PROCESSES, cores // 2))
        self._started = time.monotonic()
        self._files = contextlib.ExitStack()
        self._messages = [self._files.enter_context(tempfile.TemporaryFile()) for _ in range(processes)]  # noqa: SIM115
        self._processes = [
            subprocess.Popen(
                [*command, str(share), str(processes)],
                stdin=subprocess.PIPE,
                stdout=message,
                stderr=message,
                preexec_fn=partial(die_with_parent, signal.SIGINT),
                process_group=0,
            )
            for share, message in enumerate(self._messages)
        ]
        for process in self._processes:
            assert process.stdin is not None
            with contextlib.suppress(BrokenPipeError), process.stdin:  # if it has ended already, `wait` tells
                process.stdin.write(job_text(job).encode())

    def wait(self, interrupted: Callable[[], bool]) -> str:
        """Waits until all have ended or `interrupted` says so; what to tell the user."""
        while any(process.poll() is None for process in self._processes):
            if interrupted():
                self.stop()
                return "fast path: compiling was interrupted"
            time.sleep(0.05)
        seconds = time.monotonic() - self._started
        texts = [self._message(i) for i in range(len(self._processes))]
        failed = [i for i, process in enumerate(self._processes) if process.returncode != 0]
        if failed:
            return (
                f"fast path: {len(failed)} of {len(self._processes)} processes that compile kernels ahead failed "
                f"(exit code {self._processes[failed[0]].returncode}: {texts[failed[0]]}); "
                "what is missing is compiled before the first update"
            )
        count = sum(int(text) for text in texts)
        return f"fast path: {count} kernels ready {seconds:.0f} s after the start"

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


def job_of_training(config: TrainConfig, capability: tuple[int, int], several_ranks: bool) -> AheadJob:
    """What a training on such a GPU will compile; sizes follow from the scenes' distribution."""
    training, network = config.training, config.network
    particles, cells = _sizes(config.scene, network.levels)
    return AheadJob(
        network,
        UpdateSettings.of(training, config.scene.cell_size),
        KERNEL_PRECISION[training.precision],
        several_ranks,
        training.ema_decay > 0,
        training.batch_scenes * particles,
        tuple(training.batch_scenes * count for count in cells),
        10 * capability[0] + capability[1],
        training.rollout_scenes if training.rollout_share > 0 else 0,
    )


def _sizes(scene: SceneConfig, levels: int) -> tuple[int, list[int]]:
    """Particles and cells of each level of a scene as it begins, its groups being cubes."""
    edge = scene.group_size / scene.cell_size
    particles = scene.group_count * scene.particles_per_cell * edge**3
    cells, length = [], edge + 2  # cells beside a particle's are active too
    for _ in range(levels):
        cells.append(max(1, round(scene.group_count * length**3)))
        length = (length + 1) / 2
    return max(1, round(particles)), cells
