"""The options of `python -m tools.error_vs_time`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from hgn.config import Precision, Split
from hgn.schema import Bound, FrameCount, NonNegative, Positive, require, require_bounds
from tools.report import ReportConfig

ENDINGS = (".json", ".png", "_batched.png", "_frames.png")  # of the files that a report writes
UNTIMED = ("baseline", "chaos")  # systems without run times


@dataclass(frozen=True)
class ErrorVsTimeConfig(ReportConfig):
    """The options of `python -m tools.error_vs_time`."""

    # writes OUT.json (or the file `json`), OUT.png (error against run time), OUT_batched.png (side by side) and
    # OUT_frames.png (over frames)
    out: str
    # data set of python -m datagen. Reference: the solver on its grid at a quarter of the largest stable step
    # (`resimulate`), or the data itself if its grid is finer than the networks'
    data: str
    # files of python -m hgn.export or names of shipped weights; null: all shipped weights that fit the data
    weights: tuple[str, ...] | None = None
    split: Split = "test"  # of the data set
    scenes: Positive[int] = 20  # first scenes of the split
    frames: FrameCount = 300  # of each rollout
    # fp32, tf32, fp16 where supported; null: all on a GPU (tf32 for GNS), fp32 on a CPU
    precisions: tuple[Precision, ...] | None = None
    mpm_grids: tuple[Annotated[int, Bound("at least 8", lambda value: value >= 8)], ...] = (32, 48, 64)  # cells a unit
    resimulate: bool = True  # false: the reference is the data; with mpm_grids=[] perturbation=0 no solver runs
    # initial displacement, domain units, by which the solver is compared with itself (chaos floor); 0: no such row
    perturbation: NonNegative[float] = 1e-6

    def __post_init__(self) -> None:
        require_bounds(self)
        require(self.out != "", "out", "a file name without its ending", self.out)
        names = [Path(file).name for file in self.weights or ()]
        require(len(set(names)) == len(names), "weights", "files of different names", names)
