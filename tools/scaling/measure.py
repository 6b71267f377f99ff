"""The timed processes, one for each device. In turns, different numbers of them train together.

A timed update on several ranks consists of noise, jitter, grid, forward and backward pass, the average of gradients,
and Adam. Lightning, logging and reading of data are not included.
"""

import datetime
import itertools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from hgn.config import TrainingConfig
from hgn.data.batch import Batch
from hgn.data.sampler import balanced_parts
from hgn.network.base import ParticleNetwork
from hgn.runtime.backend import set_matmul_precision, triton_unsupported_reason
from hgn.runtime.parity import relative_error
from hgn.system.machine import available_cpus
from hgn.training.distributed import averaging_options
from hgn.training.gradients import GradientGuard
from hgn.training.torch_updates import batch_loss
from hgn.training.updates import build_optimizer
from tools.bench.contenders import bench_network
from tools.bench.states import Workload, batch_of_scenes
from tools.bench.triton_contenders import device_samples, triton_updates
from tools.report import PASS
from tools.scaling.config import ScalingConfig
from tools.timing import Timed, alternate, statistics

# Bound of the relative error of the averaged gradients. It is larger than rounding errors: the order of sums on a GPU
# varies, which flips activations next to their kink, and TF32 increases this effect.
GRADIENT_BOUND = 2e-2
WARM_UPDATES = 3
ROUNDS = 20  # number of samples of a contender
SPREAD = 0.17  # standard deviation of the number of particles over the paper's random scenes, as a fraction of the mean
PATIENCE = datetime.timedelta(minutes=2)


@dataclass
class Contender(Timed):
    """Some of the devices, which train at the same time, together or independently."""

    backend: str  # torch or triton
    devices: int
    averaged: bool
    spread: float  # as SPREAD, for the timed scenes
    particles: float  # mean number of particles of one update on each device
    update: "TorchUpdates | TritonUpdates | None" = None  # None in processes that only wait
    check: str = PASS
    milliseconds: list[float] = field(default_factory=list)  # times of one update
    batches: int = 1  # number of updates of one sample

    def sample(self) -> float:
        """Returns the milliseconds of the slowest rank of this contender; all other processes wait."""
        taken = torch.zeros(1)
        dist.barrier()
        if self.update is not None:
            started = time.perf_counter()
            self.update.run()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            taken.fill_(time.perf_counter() - started)
        dist.all_reduce(taken, dist.ReduceOp.MAX)
        return 1e3 * float(taken) / self.batches


class TorchUpdates:
    """Training updates of one rank by autograd, on batches on its device."""

    def __init__(self, config: ScalingConfig, batches: list[Batch], device: torch.device) -> None:
        self.batches, self.device = batches, device
        training, network = TrainingConfig(batch_scenes=config.scenes), bench_network(config.network, device).train()
        self.optimizer: torch.optim.Optimizer = build_optimizer(network, training)
        self.guard = GradientGuard(torch.zeros(5, device=device))
        self.loss: nn.Module = _Loss(network, training)
        self.parameters = list(network.parameters())

    def average(self, group: dist.ProcessGroup) -> None:
        """Averages gradients over the ranks of `group` from now on."""
        devices = [self.device] if self.device.type == "cuda" else None
        self.loss = DistributedDataParallel(self.loss, devices, process_group=group, **averaging_options())

    def run(self) -> None:
        """One update on each batch."""
        for batch in self.batches:
            self.optimizer.zero_grad()
            self.loss(batch).backward()
            self.guard.check(self.parameters, self.optimizer)
            self.optimizer.step()

    def gradients(self) -> torch.Tensor:
        """Returns the gradients of the first batch."""
        self.optimizer.zero_grad()
        self.loss(self.batches[0]).backward()
        return torch.cat([p.grad.flatten() for p in self.parameters if p.grad is not None])

    def weights(self) -> torch.Tensor:
        return torch.cat([p.detach().flatten() for p in self.parameters])


class TritonUpdates:
    """Training updates of one rank by hgn.kernels.update, on episodes of one window."""

    def __init__(self, config: ScalingConfig, batches: list[Batch], device: torch.device) -> None:
        network = bench_network(config.network, device)
        training = TrainingConfig(batch_scenes=config.scenes, noise_correlated_fraction=0.0)
        self.make = partial(triton_updates, network, training, config.precision, device)
        self.ours = self.make()
        self.chunk = [device_samples(batch) for batch in batches]
        self.rates = [TrainingConfig.learning_rate] * len(self.chunk)

    def average(self, group: dist.ProcessGroup) -> None:
        """Averages gradients over the ranks of `group` from now on."""
        reduce = partial(dist.all_reduce, group=group)
        self.ours = self.make(reduce=reduce, ranks=dist.get_world_size(group))
        self.gradients()

    def run(self) -> None:
        """One update on each batch."""
        self.ours.run(self.chunk, self.rates)

    def gradients(self) -> torch.Tensor:
        """Returns the gradients of the first batch, from Adam's first moment m: an update makes it 0.9 m + 0.1 g."""
        before = self.ours.first_moment.clone()
        self.ours.run(self.chunk[:1], [0.0])
        return (self.ours.first_moment - 0.9 * before) * 10

    def weights(self) -> torch.Tensor:
        return self.ours.values


class _Loss(nn.Module):
    """The loss as a forward pass, as DistributedDataParallel requires."""

    def __init__(self, network: ParticleNetwork, training: TrainingConfig) -> None:
        super().__init__()
        self.network, self.training_config = network, training

    def forward(self, batch: Batch) -> torch.Tensor:
        return batch_loss(self.network, batch, self.training_config)


def measure(rank: int, count: int, config: ScalingConfig, device_type: str, folder: Path) -> None:
    """Runs one of `count` processes; the first writes FOLDER/rows.json. If one fails, all raise."""
    device = torch.device(device_type, rank) if device_type == "cuda" else torch.device(device_type)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    else:
        torch.set_num_threads(max(1, available_cpus() // count))
    set_matmul_precision(_torch_precision(config, device))
    # while nothing is timed, processes communicate through this group, which does not use the devices
    dist.init_process_group(
        "gloo", init_method=f"file://{folder / 'store'}", rank=rank, world_size=count, timeout=PATIENCE
    )
    backend = "nccl" if device.type == "cuda" else "gloo"
    sizes = [size for size in (1, 2, 4, 8, 16, 32, 64) if size < count] + [count]
    groups = {size: dist.new_group(range(size), PATIENCE, backend) for size in sizes if size > 1}
    contenders = _contenders(config, sizes, device)
    for contender in contenders:
        _prepare(contender, config, rank, groups, device)
    ready = [contender for contender in contenders if contender.check == PASS]
    for contender, times in zip(ready, alternate(ready, ROUNDS, _until(config.seconds)), strict=True):
        contender.milliseconds = times
    for contender in contenders:
        _check_weights(contender, groups, rank)
    if rank == 0:
        (folder / "rows.json").write_text(json.dumps([_row(c, config, device) for c in contenders]))
    dist.barrier()
    dist.destroy_process_group()


def _torch_precision(config: ScalingConfig, device: torch.device) -> str:
    """Returns the precision for backend torch, which does not support fp16; a CPU does not support TF32."""
    return "tf32" if device.type == "cuda" and config.precision != "fp32" else "fp32"


def _contenders(config: ScalingConfig, sizes: list[int], device: torch.device) -> list[Contender]:
    contenders = []
    for backend in config.backends:
        if backend == "triton" and triton_unsupported_reason(device, config.network, config.precision):
            continue
        for size, averaged, spread in itertools.product(sizes, (False, True), (0.0, SPREAD)):
            if averaged == (size > 1) or (not averaged and spread == 0):
                particles = float(_particles(config, size, spread).sum(-1).mean())
                contender = Contender(backend, size, averaged, spread, particles)
                contender.batches, contender.warm_up = config.batches, -(-WARM_UPDATES // config.batches)
                contenders.append(contender)
    return contenders


def _particles(config: ScalingConfig, ranks: int, spread: float) -> np.ndarray:
    """Returns the particles of each scene, balanced over ranks as in training, int64 [batches, ranks, scenes]."""
    normal = np.stack(
        [np.random.default_rng([rank, 7]).standard_normal((config.batches, config.scenes)) for rank in range(ranks)], 1
    )
    count_BRS = np.maximum((config.particles * np.clip(1 + spread * normal, 0.2, 3.0)).round(), 1).astype(int)
    return np.stack([count_K[balanced_parts(count_K, ranks)] for count_K in count_BRS.reshape(config.batches, -1)])


def _batches(config: ScalingConfig, rank: int, ranks: int, spread: float, device: torch.device) -> list[Batch]:
    """Returns this rank's scenes of each update."""
    counts = _particles(config, ranks, spread)[:, rank].tolist()
    return [
        batch_of_scenes(
            [Workload(count, 1) for count in mine], config.network, device, (index * ranks + rank) * config.scenes
        )
        for index, mine in enumerate(counts)
    ]


def _prepare(
    contender: Contender, config: ScalingConfig, rank: int, groups: dict[int, dist.ProcessGroup], device: torch.device
) -> None:
    if rank < contender.devices:
        batches = _batches(config, rank, contender.devices, contender.spread, device)
        made = TorchUpdates if contender.backend == "torch" else TritonUpdates
        contender.update = made(config, batches, device)
        if contender.averaged:
            _average(contender, groups[contender.devices])
    _agree(contender)


def _average(contender: Contender, group: dist.ProcessGroup) -> None:
    """Starts averaging gradients, and compares the average with the mean of the ranks' own gradients."""
    assert contender.update is not None
    expected = contender.update.gradients().clone()
    dist.all_reduce(expected, group=group)
    expected /= dist.get_world_size(group)
    contender.update.average(group)
    error = relative_error(contender.update.gradients(), expected)
    if not error <= GRADIENT_BOUND:
        contender.check = f"relative error of averaged gradients {error:.1e} exceeds {GRADIENT_BOUND:.0e}"


def _check_weights(contender: Contender, groups: dict[int, dist.ProcessGroup], rank: int) -> None:
    """Checks that parameters are bitwise equal on all ranks after the timed updates."""
    if contender.update is not None and contender.averaged:
        weights = contender.update.weights()
        first = weights.clone()
        dist.broadcast(first, 0, group=groups[contender.devices])
        if contender.check == PASS and not torch.equal(weights, first):
            contender.check = f"weights of rank {rank} differ from those of rank 0 after the updates"
    _agree(contender)


def _agree(contender: Contender) -> None:
    """Shares the first failed check with all processes."""
    checks: list[Any] = [None] * dist.get_world_size()
    dist.all_gather_object(checks, contender.check)
    contender.check = next((check for check in checks if check != PASS), PASS)


def _until(seconds: float) -> Callable[[], bool]:
    """Returns a function that returns, equally on all ranks, whether the seconds are over."""
    started, over = time.monotonic(), torch.zeros(1)

    def is_over() -> bool:
        over.fill_(float(time.monotonic() - started > seconds))
        dist.broadcast(over, 0)
        return bool(over)

    return is_over


def _row(contender: Contender, config: ScalingConfig, device: torch.device) -> dict[str, Any]:
    row: dict[str, Any] = {
        "case": "weak_scaling",
        "backend": contender.backend,
        "precision": _torch_precision(config, device) if contender.backend == "torch" else config.precision,
        "devices": contender.devices,
        "scenes": config.scenes,
        "particles": config.particles,
        "particle_spread": contender.spread,
        "spread": "random" if contender.spread else "equal",
        "particles_per_update": contender.particles,
        "averaged": contender.averaged,
        "check": contender.check,
        "ms": None,
    }
    if contender.check == PASS:
        row |= statistics(contender.milliseconds)
    return row
