"""Plans the number of workers and their batch sizes, for one machine or a Ray cluster."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hgn.config import DatagenConfig
from hgn.scene.kinds import MAXIMUM_PARTICLES
from hgn.schema import require

GPU_SCENES_PER_LAUNCH = 416  # largest number of scenes; each team of thread blocks simulates several
GPU_NODES_PER_LAUNCH = 832 * 64**3  # grid nodes of all scenes, about 50 bytes each
GPU_EARLY_LAUNCH = 2  # number of scenes in the first launch if episodes are needed early
MAXIMUM_MAKERS = 32  # largest number of makers
_CLUSTER_THREADS = 2  # threads of a solver without a GPU


@dataclass(frozen=True)
class WorkerPlan:
    """Holds numbers of workers and batch sizes."""

    solvers: int
    threads: int | None  # threads of each solver; None on a GPU
    makers: int
    scenes_per_launch: int
    first_launch: int
    gpus: tuple[str, ...] = ()  # CUDA devices, assigned to the solvers in turn


def plan_workers(
    config: DatagenConfig, gpus: tuple[str, ...], cpu_count: int, memory_bytes: float, early: bool = False
) -> WorkerPlan:
    """Plans one solver per GPU, with makers on the cores. Without a GPU it plans one solver per two cores."""
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
    """Plans one solver per GPU of the cluster. Without GPUs it plans one solver per two cores of a node."""
    workers, launch = config.dataset.workers, config.mpm.scenes_per_launch
    gpus = int(sum(node.get("GPU", 0) for node in nodes))
    if config.mpm.device == "cuda" or (config.mpm.device == "auto" and gpus):
        with_gpus = [node for node in nodes if node.get("GPU", 0) >= 1]
        memory = min((node.get("memory", math.inf) / int(node["GPU"]) for node in with_gpus), default=math.inf)
        launch = launch or gpu_scenes_per_launch(config, memory)
        solvers, threads, first = workers or max(1, gpus), None, gpu_first_launch(launch, early)
    else:
        cores = [int(node["CPU"]) for node in nodes if node.get("CPU", 0) >= 1]
        threads = min(_CLUSTER_THREADS, *cores) if cores else 1
        solvers, launch = workers or max(1, sum(count // threads for count in cores)), launch or 1
        first = launch
    return WorkerPlan(solvers, threads, min(MAXIMUM_MAKERS, solvers), launch, first)


def gpu_scenes_per_launch(config: DatagenConfig, memory_bytes: float) -> int:
    """Returns a launch size that fills a GPU. It is smaller for large grids, and if frames would need too much memory.

    Frames of visible particles stay in host memory until they are published, and may fill half of it.
    """
    scene = config.scene
    nodes = math.prod(math.ceil(length / config.reference_cell_size) for length in scene.domain_size)
    particles = scene.group_count * scene.particles_per_cell * (scene.group_size / scene.cell_size) ** 3
    if scene.kinds:
        particles = MAXIMUM_PARTICLES
    held = memory_bytes / 2 / (12 * config.dataset.most_frames * max(particles, 1))
    gigabytes = f"{memory_bytes / 2e9 / max(held, 1e-9):.3g} GB of {memory_bytes / 2e9:.3g}"
    rule = "such that the frames of a scene's visible particles fit in half of a worker's memory"
    require(held >= 1 or not config.reference, "dataset.reference_cells", rule, gigabytes)
    return max(1, int(min(GPU_SCENES_PER_LAUNCH, GPU_NODES_PER_LAUNCH // nodes, held)))


def gpu_first_launch(launch: int, early: bool) -> int:
    """Returns the size of the first launch. It is small only if training or the service waits for episodes.

    A launch takes as long as its longest scene.
    """
    return min(launch, GPU_EARLY_LAUNCH) if early else launch


def visible_gpus() -> tuple[str, ...]:
    """Returns the CUDA devices that CUDA_VISIBLE_DEVICES allows, without starting CUDA."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    count = len(list(Path("/dev").glob("nvidia[0-9]*"))) or int(Path("/dev/dxg").exists())
    if visible is None:
        return tuple(str(i) for i in range(count))
    devices = tuple(device.strip() for device in visible.split(",") if device.strip())
    return () if count == 0 or "-1" in devices or "NoDevFiles" in devices else devices
