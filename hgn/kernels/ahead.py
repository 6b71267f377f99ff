"""python -m hgn.kernels.ahead: compiles a share of a training's kernels into Triton's cache on disk, and launches none.

The launches are those of Updates on tensors without memory, so that no kernel and no specialisation is named twice;
only sizes are guessed (they choose between few variants), and what is guessed wrong is compiled when it is first used.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
import triton
from triton.backends.compiler import GPUTarget

from hgn.config import NetworkConfig
from hgn.kernels.update.op import Updates, UpdateSettings
from hgn.network.network import HierarchicalGraphNetwork
from hgn.schema import from_mapping

NICENESS = 10


@dataclass(frozen=True)
class AheadJob:
    """What is trained, and on what."""

    network: NetworkConfig
    settings: UpdateSettings
    precision: str  # as the kernels call it
    several_ranks: bool
    averages: bool  # the weights over the updates
    particles: int  # of an update, about
    cells: tuple[int, ...]  # of each level, about
    capability: int  # of the GPU: 90 for an H100


def launches_of(job: AheadJob, device: str = "meta") -> dict[str, tuple[Any, str]]:
    """Every kernel of an update with what it is specialised for, by a key of both; Triton's driver needs a target."""
    found: dict[str, tuple[Any, str]] = {}

    def note(*, fn: Any, compile: dict[str, Any], **_: Any) -> bool:
        data = compile["specialization_data"]
        found.setdefault(data, (fn.jit_function, data))
        return True  # neither compiled nor launched

    triton.knobs.runtime.jit_cache_hook = note
    try:
        with torch.device(device):
            network = HierarchicalGraphNetwork(job.network)
        nothing = torch.zeros(5, device=device)
        reduce: Callable[[torch.Tensor], None] | None = (lambda _: None) if job.several_ranks else None
        updates = Updates(network, job.settings, job.precision, nothing[:2], nothing, reduce)
        updates.average = torch.zeros_like(updates.values) if job.averages else None
        updates.allocate(job.particles, job.cells)
        updates.launches()
    finally:
        triton.knobs.runtime.jit_cache_hook = None
    return found


def compile_share(job: AheadJob, share: int, shares: int) -> int:
    """Compiles every `shares`-th kernel from number `share` on; how many those are."""
    mine = list(launches_of(job).values())[share::shares]
    for function, data in mine:
        kernel = function.preload(data)
        triton.runtime.driver.active.launcher_cls(kernel.src, kernel.metadata)  # C, compiled as well
    return len(mine)


def job_text(job: AheadJob) -> str:
    return json.dumps(asdict(job))


def job_of(text: str) -> AheadJob:
    mapping = json.loads(text)
    network = from_mapping(NetworkConfig, mapping.pop("network"))
    settings = UpdateSettings(**mapping.pop("settings"))
    return AheadJob(network, settings, **{**mapping, "cells": tuple(mapping["cells"])})


def use_target(capability: int) -> None:
    """Lets Triton compile for a GPU without a context on it, which would take memory from those who train."""
    driver = triton.runtime.driver.active
    driver.get_current_device = lambda: 0
    driver.get_current_stream = lambda device: 0
    driver.get_current_target = lambda: GPUTarget("cuda", capability, 32)


def main() -> None:
    os.nice(NICENESS)
    share, shares = map(int, sys.argv[1:])
    job = job_of(sys.stdin.read())
    use_target(job.capability)
    print(compile_share(job, share, shares))


if __name__ == "__main__":
    main()
