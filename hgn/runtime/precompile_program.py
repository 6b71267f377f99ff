"""python -m hgn.runtime.precompile_program: compiles kernels into Triton's cache on disk.

Updates make their launches on tensors without memory, so no second list of kernels and variants exists. The tensors'
sizes are guesses, on which few variants depend. Other variants are compiled at first use.
"""

import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass

import torch

from hgn.config import NetworkConfig
from hgn.kernels.triton_compat import Launches, compile_launches, noted_launches, use_target
from hgn.kernels.update.op import Updates, UpdateSettings
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.schema import from_mapping, to_mapping

NICENESS = 10  # low priority of the compiling processes


@dataclass(frozen=True)
class PrecompileJob:
    """A training whose kernels are compiled ahead."""

    network: NetworkConfig
    settings: UpdateSettings
    precision: str
    several_ranks: bool
    averages: bool  # whether the training averages its parameters
    particles: int  # approximate number of particles in an update
    cells: tuple[int, ...]  # approximate number of cells on each level
    capability: int  # capability of the GPU: 90 for an H100


def launches_of(job: PrecompileJob, device: str = "meta") -> Launches:
    """Returns every kernel of a job with its specialisation, by a key of both. Needs a GPU, or `use_target`."""
    with noted_launches() as launches:
        with torch.device(device):
            network = HierarchicalGraphNetwork(job.network)
        nothing = torch.zeros(5, device=device)
        reduce: Callable[[torch.Tensor], None] | None = (lambda _: None) if job.several_ranks else None
        updates = Updates(network, job.settings, job.precision, nothing[:2], counters=nothing, reduce=reduce)
        updates.average = torch.zeros_like(updates.values) if job.averages else None
        updates.allocate(job.particles, job.cells)
        updates.launches()
        if "moving" in job.network.own_physics:
            updates.allocate_moving(1)
            updates.launches()
    return launches


def compile_part(job: PrecompileJob, part: int, parts: int) -> int:
    """Compiles every `parts`-th kernel, starting with number `part`. Returns the number of these kernels."""
    mine = list(launches_of(job).values())[part::parts]
    return len(compile_launches(mine))


def job_text(job: PrecompileJob) -> str:
    return json.dumps(to_mapping(job))


def job_of(text: str) -> PrecompileJob:
    return from_mapping(PrecompileJob, json.loads(text))


def main() -> None:
    os.nice(NICENESS)
    part, parts = map(int, sys.argv[1:])
    job = job_of(sys.stdin.read())
    use_target(job.capability)
    print(compile_part(job, part, parts))


if __name__ == "__main__":
    main()
