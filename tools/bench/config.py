"""The options of `python -m tools.bench`."""

from dataclasses import dataclass, field, replace
from typing import Annotated

from hgn.config import NetworkConfig, Precision
from hgn.schema import OneOrMore, Positive, one_of, require, require_bounds
from tools.report import ReportConfig

FRAME_CASES = ("frame", "torch_frame", "gns_frame", "mpm_frame")
TRAIN_CASES = ("train", "torch_train", "gns_train")
CASES = (*FRAME_CASES, *TRAIN_CASES)


@dataclass(frozen=True)
class BenchConfig(ReportConfig):
    """The options of `python -m tools.bench`."""

    # frame, train (the fastest backend), torch_frame, torch_train, gns_frame, gns_train, mpm_frame (the solver);
    # null: all that differ on this machine
    cases: tuple[Annotated[str, one_of(*CASES)], ...] | None = None
    particles: tuple[OneOrMore, ...] | None = None  # of a scene; null: 4296, 40000, 400000 on a GPU, 4296 on a CPU
    # scenes side by side, with the smallest number of particles; null: 1, 8, 32 on a GPU, 1 on a CPU
    scenes: tuple[OneOrMore, ...] | None = None
    # fp32, tf32, fp16 (backend triton); null: tf32 and fp16 on a GPU, fp32 on a CPU
    precisions: tuple[Precision, ...] | None = None
    network: NetworkConfig = field(default_factory=NetworkConfig)  # GNS has its width, and 10 steps
    # after which contenders that take turns are sampled no more, but five times at least and 50 times at most
    seconds: Positive[float] = 20.0

    def __post_init__(self) -> None:
        require_bounds(self)
        require(self.network.kind == "hgn", "network.kind", "hgn", self.network.kind)

    @property
    def gns(self) -> NetworkConfig:
        """The graph network-based simulator (Sanchez-Gonzalez et al. 2020) that is timed."""
        return replace(self.network, kind="gns", levels=1, message_passing_steps=10)
