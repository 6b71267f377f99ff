"""The options of `python -m tools.error_vs_time`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hgn.config import PRECISIONS
from hgn.data.manifest import SPLITS
from hgn.schema import require, require_non_negative, require_one_of, require_positive

UNTIMED = ("trivial", "chaos")  # rows without run times


@dataclass(frozen=True)
class ErrorVsTimeConfig:
    """What is compared, on what, and how long. See conf/command/error_vs_time.yaml."""

    out: str
    data: str | None = None
    earlier: tuple[str, ...] = ()
    weights: tuple[str, ...] | None = None
    split: str = "test"
    scenes: int = 20
    frames: int = 300
    frame_stride: int = 10
    precisions: tuple[str, ...] | None = None
    backend: str = "auto"
    mpm_grids: tuple[int, ...] = (32, 48, 64)
    mpm_steps: tuple[float, ...] = (1.0, 0.5)
    reference_step: float = 0.25
    repeated_frames: int = 51
    mpm_frames: int = 300
    mpm_timed_frames: int = 12
    resimulate: bool = True
    perturbation: float = 1e-6
    batch_scenes: int = 8
    timed_scenes: int = 3
    timed_frames: int = 100
    timed_seconds: float = 0.5
    rounds: int = 2
    sinkhorn_points: int = 1024
    sinkhorn_scenes: int = 20
    sinkhorn_blur: float = 0.01
    rest_speed: float = 1e-4
    training_hours: tuple[float, ...] | None = None
    generation_hours: float | None = None
    seconds: float | None = None
    device: str = "auto"
    json: str | None = None

    def __post_init__(self) -> None:
        require(self.out != "", "out", "a file name without its ending", self.out)
        require(
            bool(self.data or self.earlier),
            "data",
            "a data set",
            self.data,
            "make one with python -m datagen, or give earlier=[report.json] to draw a report again",
        )
        require_one_of(self, "split", SPLITS)
        require_positive(
            self,
            "scenes",
            "frame_stride",
            "batch_scenes",
            "timed_scenes",
            "timed_seconds",
            "rounds",
            "sinkhorn_points",
            "sinkhorn_blur",
        )
        require_non_negative(self, "perturbation", "rest_speed")
        require(self.frames >= 2, "frames", "at least 2", self.frames)
        for name in ("timed_frames", "mpm_timed_frames"):
            require(getattr(self, name) >= 4, name, "at least 4", getattr(self, name))
        for name in ("mpm_frames", "repeated_frames"):
            require(getattr(self, name) >= 2, name, "at least 2", getattr(self, name))
        require_non_negative(self, "sinkhorn_scenes")
        if self.seconds is not None:
            require_positive(self, "seconds")
        require(0 < self.reference_step <= 1, "reference_step", "above 0 and at most 1", self.reference_step)
        for i, step in enumerate(self.mpm_steps):
            require(0 < step <= 1, f"mpm_steps[{i}]", "above 0 and at most 1", step)
        for i, grid in enumerate(self.mpm_grids):
            require(grid >= 8, f"mpm_grids[{i}]", "at least 8", grid)
        for i, name in enumerate(self.precisions or ()):
            require(name in PRECISIONS, f"precisions[{i}]", f"one of {', '.join(PRECISIONS)}", name)
        require_one_of(self, "backend", ("auto", "torch", "triton"))
        names = [Path(file).name for file in self.weights or ()]
        require(len(set(names)) == len(names), "weights", "files of different names", names)
        if self.training_hours is not None:
            told, count = len(self.training_hours), len(self.weights or ())
            require(told == count, "training_hours", f"a list of {count}, one for each of weights", told)
