"""The options of `python -m tools.error_vs_time`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from hgn.config import Precision, Split
from hgn.schema import Bound, FrameCount, NonNegative, Positive, one_of, require, require_bounds

UNTIMED = ("baseline", "chaos")  # rows without run times
StepFraction = Annotated[float, Bound("above 0 and at most 1", lambda value: 0 < value <= 1)]
TimedFrames = Annotated[int, Bound("at least 4", lambda value: value >= 4)]


@dataclass(frozen=True)
class ErrorVsTimeConfig:
    """What is compared, on what, and how long."""

    # writes OUT.json, OUT.png (error against run time), OUT_batched.png (side by side), OUT_frames.png (over frames)
    out: str
    # a data set; its scenes are simulated again with a finer step, which is the reference. null: only draws `earlier`
    # again
    data: str | None = None
    # JSON of reports on the same scenes: what they hold is not measured again, and drawn beside what is. A report that
    # was cut off goes on with its own file
    earlier: tuple[str, ...] = ()
    # files of python -m hgn.export or names of shipped weights, of this data; null: all shipped that fit the data
    weights: tuple[str, ...] | None = None
    split: Split = "test"
    scenes: Positive[int] = 20
    frames: FrameCount = 300
    frame_stride: Positive[int] = 10  # every tenth frame for the one-step error
    # fp32, tf32, fp16 where a network's backend knows it; null: all on a GPU (tf32 for GNS), fp32 on a CPU
    precisions: tuple[Precision, ...] | None = None
    # of the networks: torch, triton; auto: triton wherever it runs
    backend: Annotated[str, one_of("auto", "torch", "triton")] = "auto"
    mpm_grids: tuple[Annotated[int, Bound("at least 8", lambda value: value >= 8)], ...] = (32, 48, 64)  # cells a unit
    mpm_steps: tuple[StepFraction, ...] = (1.0, 0.5)  # fractions of the limit of stability
    mpm_frames: FrameCount = 300  # of the solver's rollouts, which take most of the time
    mpm_timed_frames: TimedFrames = 300  # of the solver, whose frames take longest when material has landed
    resimulate: bool = True  # false: the data itself is the reference; with mpm_grids=[] perturbation=0 no solver runs
    # domain units, at most, of each coordinate: how far the solver departs from itself; 0: not asked
    perturbation: NonNegative[float] = 1e-6
    batch_scenes: Positive[int] = 8  # of a network's rollouts, side by side
    timed_batches: tuple[Positive[int], ...] = (8, 64, 256)  # scenes side by side: each has its best
    timed_scenes: Positive[int] = 3
    timed_frames: TimedFrames = 100  # at most
    timed_seconds: Positive[float] = 0.5  # of each timed rollout, about: the slow take fewer frames, at least six
    rounds: Positive[int] = 2  # of each timed scene
    # all errors, then all run times: where others use the device for a while; else a contender's one after the other,
    # so that a run that is cut off has whole rows
    times_last: bool = False
    sinkhorn_scenes: NonNegative[int] = 20  # of the test scenes
    # when they are over, what has not begun is left out, and said; the most important comes first
    seconds: Positive[float] | None = None
    device: str = "auto"
    json: str | None = None  # another name for OUT.json; --json FILE does the same

    def __post_init__(self) -> None:
        require_bounds(self)
        require(self.out != "", "out", "a file name without its ending", self.out)
        remedy = "make one with python -m datagen, or give earlier=[report.json] to draw a report again"
        require(bool(self.data or self.earlier), "data", "a data set", self.data, remedy)
        require(len(self.timed_batches) > 0, "timed_batches", "one number of scenes or more", self.timed_batches)
        names = [Path(file).name for file in self.weights or ()]
        require(len(set(names)) == len(names), "weights", "files of different names", names)
