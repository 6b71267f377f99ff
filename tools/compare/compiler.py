"""Compiles a share of a tree's kernels for tools.compare, python -P compiler.py SETTINGS SHARE SHARES, and ends.

Started by path like server.py: hgn and tools.bench are the tree's, and nothing of tools.compare may be imported.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import torch

from hgn.config import NetworkConfig, TrainingConfig
from hgn.kernels import precompile
from hgn.kernels.update.op import UpdateSettings
from hgn.network.grid import build_hierarchy
from hgn.runtime.backend import KERNEL_PRECISION
from hgn.schema import from_mapping
from tools.bench.contenders import checked_workload
from tools.bench.fast import OBSTACLE_CELL_SIZE
from tools.bench.states import Workload, state_of


def compile_share(settings: dict[str, Any], share: int, shares: int) -> int:
    """Compiles every `shares`-th kernel of all cases, from number `share` on; how many those are."""
    jobs = _jobs(settings)
    precompile.use_target(settings["capability"])
    found: precompile.Launches = {}
    for job in jobs:  # all before the first is compiled: what is would be launched
        found |= precompile.launches_of(job)
    mine = list(found.values())[share::shares]
    for function, data in mine:
        kernel = function.preload(data)
        precompile.triton.runtime.driver.active.launcher_cls(kernel.src, kernel.metadata)  # C, compiled as well
    return len(mine)


def _jobs(settings: dict[str, Any]) -> list[precompile.PrecompileJob | precompile.FrameJob]:
    """The cases. The updates that are checked, without noise, launch the same kernels."""
    network = from_mapping(NetworkConfig, settings["network"])
    precision, capability, particles = settings["precision"], settings["capability"], settings["particles"]
    training = TrainingConfig()
    jobs: list[precompile.PrecompileJob | precompile.FrameJob] = []
    frames: set[int] = set()
    for case in settings["cases"]:
        kind, _, count = case.partition("_")
        if kind == "frame":
            frames |= {int(count), checked_workload(Workload(int(count), 1), "frame").particles}
            continue
        scenes = int(count)
        update = UpdateSettings(scenes, training.noise_std, training.grid_jitter, OBSTACLE_CELL_SIZE)
        cells = tuple(scenes * of_scene for of_scene in _cells(network, particles))
        kernels = KERNEL_PRECISION[precision]
        jobs.append(
            precompile.PrecompileJob(network, update, kernels, False, False, scenes * particles, cells, capability)
        )
    sizes = tuple((count, _cells(network, count)[0]) for count in sorted(frames))
    return [*jobs, precompile.FrameJob(((network, precision),), sizes, capability)]


def _cells(network: NetworkConfig, particles: int) -> tuple[int, ...]:
    """Active cells of each level of a scene."""
    state = state_of(Workload(particles, 1), network, torch.device("cpu"))
    origin_S3 = torch.zeros_like(state.domain_S3)
    grid = build_hierarchy(state.position_N3, state.scene_N, origin_S3, network.cell_size, network.levels)
    return tuple(level.cell_count for level in grid.levels)


if __name__ == "__main__":
    print(compile_share(json.loads(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])))
