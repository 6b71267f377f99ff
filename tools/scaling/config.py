"""The options of `python -m tools.scaling`."""

from __future__ import annotations

from dataclasses import dataclass, field

from hgn.config import PRECISIONS, NetworkConfig
from hgn.schema import require, require_non_negative, require_one_of, require_positive


@dataclass(frozen=True)
class ScalingConfig:
    """`python -m tools.scaling`: how training is timed on several devices of this machine."""

    devices: int | None = None  # at most; none: all GPUs, or two processes on a CPU
    scenes: int = 8  # on each device
    particles: int = 4_296  # of a scene
    # of a scene's particles, standard deviation as a share of the mean; the paper's random scenes: 0.17
    particle_spread: float = 0.17
    batches: int = 8  # of each device; one sample is an update on each of them
    backends: tuple[str, ...] = ("torch", "triton")  # of training; triton where there are GPUs
    precision: str = "tf32"  # as for training; or fp32, fp16 (where backend torch takes tf32)
    message_mb: tuple[float, ...] = (25.0,)  # sizes of messages that are timed beside the one that backend torch uses
    network: NetworkConfig = field(default_factory=NetworkConfig)
    node_devices: int = 8  # of the clusters that the model tells of
    update_ms: float | None = None  # of one device alone: prints the model of such an update, and measures nothing
    backward_ms: float = 0.0  # of these; 0: all gradients leave at the end, as on backend triton
    rounds: int = 20  # samples of each contender
    seconds: float = 30.0  # at most for all contenders, once three rounds are done
    device: str = "auto"  # or cpu, cuda
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        require_positive(self, "rounds", "seconds")
        require_non_negative(self, "particle_spread", "backward_ms")
        require_one_of(self, "precision", PRECISIONS)
        if self.update_ms is not None:
            require_positive(self, "update_ms")
            require(self.backward_ms <= self.update_ms, "backward_ms", "at most update_ms", self.backward_ms)
        for name in ("scenes", "particles", "batches", "node_devices"):
            require(getattr(self, name) >= 1, name, "at least 1", getattr(self, name))
        require(self.devices is None or self.devices >= 1, "devices", "at least 1", self.devices)
        for i, backend in enumerate(self.backends):
            require(backend in ("torch", "triton"), f"backends[{i}]", "torch or triton", backend)
        for i, value in enumerate(self.message_mb):
            require(value > 0, f"message_mb[{i}]", "> 0", value)
        require(self.device in ("auto", "cpu", "cuda"), "device", "auto, cpu or cuda", self.device)
        require(self.network.kind == "hgn", "network.kind", "hgn", self.network.kind)
