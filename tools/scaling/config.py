"""The options of `python -m tools.scaling`."""

from __future__ import annotations

from dataclasses import dataclass, field

from hgn.config import NetworkConfig, Precision
from hgn.schema import NonNegative, OneOrMore, Positive, require, require_bounds


@dataclass(frozen=True)
class ScalingConfig:
    """`python -m tools.scaling`: how training is timed on several devices of this machine."""

    devices: OneOrMore | None = None  # at most; none: all GPUs, or two processes on a CPU
    scenes: OneOrMore = 8  # on each device
    particles: OneOrMore = 4_296  # of a scene
    # of a scene's particles, standard deviation as a fraction of the mean; the paper's random scenes: 0.17
    particle_spread: NonNegative[float] = 0.17
    batches: OneOrMore = 8  # of each device; one sample is an update on each of them
    backends: tuple[str, ...] = ("torch", "triton")  # of training; triton where there are GPUs
    precision: Precision = "tf32"  # as for training; or fp32, fp16 (where backend torch takes tf32)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    rounds: Positive[int] = 20  # samples of each contender
    seconds: Positive[float] = 30.0  # at most for all contenders, once five rounds are done
    device: str = "auto"  # or cpu, cuda
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        require_bounds(self)
        for i, backend in enumerate(self.backends):
            require(backend in ("torch", "triton"), f"backends[{i}]", "torch or triton", backend)
        require(self.device in ("auto", "cpu", "cuda"), "device", "auto, cpu or cuda", self.device)
        require(self.network.kind == "hgn", "network.kind", "hgn", self.network.kind)
