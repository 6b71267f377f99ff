"""Settings of `python -m tools.scaling`; read without torch."""

from dataclasses import dataclass, field
from typing import Annotated

from hgn.config import NetworkConfig, Precision
from hgn.schema import OneOrMore, Positive, one_of, require, require_bounds
from tools.report import ReportConfig


@dataclass(frozen=True)
class ScalingConfig(ReportConfig):
    """The options of `python -m tools.scaling`."""

    devices: OneOrMore | None = None  # largest number; null: all GPUs, or two processes on a CPU
    scenes: OneOrMore = 8  # on each device
    particles: OneOrMore = 4_296  # of a scene, on average
    batches: OneOrMore = 8  # of each device; a sample is one update on each batch
    # of training; triton is skipped without GPUs
    backends: tuple[Annotated[str, one_of("torch", "triton")], ...] = ("torch", "triton")
    precision: Precision = "tf32"  # or fp32, fp16 (backend triton; backend torch then takes tf32)
    network: NetworkConfig = field(default_factory=NetworkConfig)  # that is trained
    # after which contenders are sampled no more, but five times at least and 20 times at most
    seconds: Positive[float] = 30.0

    def __post_init__(self) -> None:
        require_bounds(self)
        require(self.device in ("auto", "cpu", "cuda"), "device", "auto, cpu or cuda", self.device)
        require(self.network.kind == "hgn", "network.kind", "hgn", self.network.kind)
