"""The options of `python -m tools.error_vs_time`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from hgn.config import Precision, Split
from hgn.schema import Bound, FrameCount, NonNegative, Positive, require, require_bounds
from tools.report import ReportConfig

UNTIMED = ("baseline", "chaos")  # systems without run times


@dataclass(frozen=True)
class ErrorVsTimeConfig(ReportConfig):
    """The options of `python -m tools.error_vs_time`."""

    # writes OUT.json (or the file `json`), OUT.png (error against run time), OUT_batched.png (side by side) and
    # OUT_frames.png (over frames)
    out: str
    # data set whose scenes the solver simulates again with a finer step, as the reference; null: draws `earlier` again
    data: str | None = None
    # JSON of reports on the same scenes: their rows are not measured again. An interrupted report continues this way
    earlier: tuple[str, ...] = ()
    # files of python -m hgn.export or names of shipped weights; null: all shipped weights that fit the data
    weights: tuple[str, ...] | None = None
    split: Split = "test"  # of the data set
    scenes: Positive[int] = 20  # first scenes of the split
    frames: FrameCount = 300  # of each rollout
    # fp32, tf32, fp16 where supported; null: all on a GPU (tf32 for GNS), fp32 on a CPU
    precisions: tuple[Precision, ...] | None = None
    mpm_grids: tuple[Annotated[int, Bound("at least 8", lambda value: value >= 8)], ...] = (32, 48, 64)  # cells a unit
    mpm_frames: FrameCount = 300  # of the solver's rollouts, which take most of the time
    resimulate: bool = True  # false: the data is the reference; with mpm_grids=[] perturbation=0 no solver runs
    # initial displacement, domain units, by which the solver is compared with itself (chaos floor); 0: no such row
    perturbation: NonNegative[float] = 1e-6
    times_last: bool = False  # true: measures all errors before all run times, on a device that is shared until then
    seconds: Positive[float] | None = None  # time limit, after which no measurement starts; null: none

    def __post_init__(self) -> None:
        require_bounds(self)
        require(self.out != "", "out", "a file name without its ending", self.out)
        remedy = "make one with python -m datagen, or give earlier=[report.json] to draw a report again"
        require(bool(self.data or self.earlier), "data", "a data set", self.data, remedy)
        names = [Path(file).name for file in self.weights or ()]
        require(len(set(names)) == len(names), "weights", "files of different names", names)
