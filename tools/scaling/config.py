"""The options of `python -m tools.scaling`. See conf/command/scaling.yaml."""

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
    particle_spread: float = 0.17  # standard deviation of a scene's particles, as a share of their mean
    batches: int = 8  # of each device; one sample is an update on each of them
    paths: tuple[str, ...] = ("plain", "fast")  # the fast one where there are GPUs
    precision: str = "high"  # as for training; the plain path takes high for half
    message_mb: tuple[float, ...] = (25.0,)  # sizes of messages that are timed beside the one that training uses
    network: NetworkConfig = field(default_factory=NetworkConfig)
    node_devices: int = 8  # of the clusters that the model tells of
    update_ms: float | None = None  # of one device alone: the model of that, and nothing is measured
    backward_ms: float = 0.0  # of these; 0: all gradients leave at the end, as on the fast path
    rounds: int = 20  # samples of each contender
    seconds: float = 30.0  # at most for all contenders, once three rounds are done
    device: str = "auto"
    json: str | None = None

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
        for i, path in enumerate(self.paths):
            require(path in ("plain", "fast"), f"paths[{i}]", "plain or fast", path)
        for i, value in enumerate(self.message_mb):
            require(value > 0, f"message_mb[{i}]", "> 0", value)
        require(self.device in ("auto", "cpu", "cuda"), "device", "auto, cpu or cuda", self.device)
        require(self.network.kind == "hgn", "network.kind", "hgn", self.network.kind)
