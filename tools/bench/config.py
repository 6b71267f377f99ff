"""The options of `python -m tools.bench`."""

from __future__ import annotations

from dataclasses import dataclass, field

from hgn.config import PRECISIONS, NetworkConfig
from hgn.schema import OneOrMore, Positive, require, require_bounds

PUBLIC_GNS_CASES = ("public_gns_frame", "public_gns_train")
CASES = ("frame", "train", "torch_frame", "torch_train", "gns_frame", "gns_train", *PUBLIC_GNS_CASES, "mpm_frame")


@dataclass(frozen=True)
class BenchConfig:
    """`python -m tools.bench`: what is timed."""

    # of frame, train (the fastest backend), torch_frame, torch_train, gns_frame, gns_train, public_gns_frame,
    # public_gns_train, mpm_frame; null: all that differ here
    cases: tuple[str, ...] | None = None
    particles: tuple[OneOrMore, ...] | None = None  # of one scene; null: 4296, 40000, 400000 on a GPU, 4296 on a CPU
    # side by side, of the smallest number of particles; null: 1, 8, 32 on a GPU, 1 on a CPU
    scenes: tuple[OneOrMore, ...] | None = None
    # fp32, tf32, fp16 (backend triton); null: tf32 and fp16 on a GPU, fp32 on a CPU
    precisions: tuple[str, ...] | None = None
    network: NetworkConfig = field(default_factory=NetworkConfig)
    gns: NetworkConfig = field(default_factory=lambda: NetworkConfig(kind="gns", levels=1, message_passing_steps=10))
    public_gns: str | None = None  # a folder with a copy of github.com/geoelements/gns, which needs PyTorch Geometric
    rounds: Positive[int] = 50  # samples of each contender
    seconds: Positive[float] = 20.0  # at most for contenders that take turns, once five rounds are done
    mpm_frames: int = 20  # of the solver in one sample
    device: str = "auto"  # or cpu, cuda, cuda:1
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        require_bounds(self)
        require(self.mpm_frames >= 4, "mpm_frames", "at least 4", self.mpm_frames)
        for name, known in (("cases", CASES), ("precisions", PRECISIONS)):
            for i, value in enumerate(getattr(self, name) or ()):
                require(value in known, f"{name}[{i}]", f"one of {', '.join(known)}", value)
        require(self.network.kind == "hgn", "network.kind", "hgn", self.network.kind)
        require(self.gns.kind == "gns", "gns.kind", "gns", self.gns.kind)
        for case in PUBLIC_GNS_CASES:
            given = self.public_gns is not None or case not in (self.cases or ())
            require(given, "public_gns", f"a folder with the public code for {case}", None)
