"""How many workers make a data set, and how much each takes at once: of a machine, or of a Ray cluster."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hgn.config import DatagenConfig

GPU_SCENES_PER_LAUNCH = 416  # several for each team; while they are simulated others are made, and staged
GPU_NODES_PER_LAUNCH = 832 * 64**3  # of the grids of all scenes, about 50 bytes each
GPU_EARLY_LAUNCH = 2  # where episodes are wanted early: such a launch has the whole GPU for each substep
MAXIMUM_MAKERS = 32
_CLUSTER_THREADS = 2  # of a solver without a GPU


@dataclass(frozen=True)
class WorkerPlan:
    """How many processes of each kind, and how much each takes at once."""

    solvers: int
    threads: int | None  # of each solver; none on a GPU
    makers: int
    scenes_per_launch: int
    first_launch: int
    gpus: tuple[str, ...] = ()  # CUDA devices, dealt out to the solvers in turn


def plan_workers(
    config: DatagenConfig, gpus: tuple[str, ...], cpu_count: int, memory_bytes: float, early: bool = False
) -> WorkerPlan:
    """One solver for two cores on a CPU; one for each GPU, with scene makers on the cores."""
    workers, launch = config.dataset.workers, config.mpm.scenes_per_launch
    if config.mpm.device == "cuda" or (config.mpm.device == "auto" and gpus):
        solvers = workers or max(1, len(gpus))
        launch = launch or gpu_scenes_per_launch(config, memory_bytes / solvers)
        makers = max(1, min(MAXIMUM_MAKERS, cpu_count - 1))
        return WorkerPlan(solvers, None, makers, launch, gpu_first_launch(launch, early), gpus)
    solvers = workers or max(1, cpu_count // 2)
    threads = max(1, cpu_count // solvers)
    return WorkerPlan(solvers, threads, 1, launch or 1, launch or 1)


def plan_cluster(config: DatagenConfig, nodes: Sequence[Mapping[str, float]], early: bool = False) -> WorkerPlan:
    """One solver for each GPU of the cluster; without one, for each two cores of a node."""
    workers, launch = config.dataset.workers, config.mpm.scenes_per_launch
    gpus = int(sum(node.get("GPU", 0) for node in nodes))
    if config.mpm.device == "cuda" or (config.mpm.device == "auto" and gpus):
        memory = min((node["memory"] for node in nodes if "memory" in node), default=math.inf)
        launch = launch or gpu_scenes_per_launch(config, memory)
        solvers, threads, first = workers or max(1, gpus), None, gpu_first_launch(launch, early)
    else:
        cores = [int(node["CPU"]) for node in nodes if node.get("CPU", 0) >= 1]
        threads = min(_CLUSTER_THREADS, *cores) if cores else 1
        solvers, launch = workers or max(1, sum(count // threads for count in cores)), launch or 1
        first = launch
    return WorkerPlan(solvers, threads, min(MAXIMUM_MAKERS, solvers), launch, first)


def gpu_scenes_per_launch(config: DatagenConfig, memory_bytes: float) -> int:
    """As many as give every part of a GPU work; fewer where their grids are large, or their frames, which the host
    holds until they are published, would take more than half of its memory.
    """
    scene = config.scene
    nodes = math.prod(math.ceil(length / scene.cell_size) for length in scene.domain_size)
    particles = scene.group_count * scene.particles_per_cell * (scene.group_size / scene.cell_size) ** 3
    held = memory_bytes / 2 / (12 * config.dataset.most_frames * max(particles, 1))
    return max(1, int(min(GPU_SCENES_PER_LAUNCH, GPU_NODES_PER_LAUNCH // nodes, held)))


def gpu_first_launch(launch: int, early: bool) -> int:
    """Few scenes where something waits for the first episodes; else all: a launch of few lasts as long as its longest
    scene, which costs more than it takes to make the others.
    """
    return min(launch, GPU_EARLY_LAUNCH) if early else launch


def visible_gpus() -> tuple[str, ...]:
    """The CUDA devices of this machine that CUDA_VISIBLE_DEVICES leaves, without starting CUDA."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    count = len(list(Path("/dev").glob("nvidia[0-9]*"))) or int(Path("/dev/dxg").exists())
    if visible is None:
        return tuple(str(i) for i in range(count))
    devices = tuple(device.strip() for device in visible.split(",") if device.strip())
    return () if count == 0 or "-1" in devices or "NoDevFiles" in devices else devices
