"""The options of `python -m tools.compare`. See conf/command/compare.yaml."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from hgn.config import PRECISIONS, NetworkConfig
from hgn.schema import require, require_one_of, require_positive

DEFAULT_CASES = ("update_8", "update_32", "frame_4296", "frame_40000", "frame_400000")
DEFAULT_PROFILE = "update_32"
INTERPRETED_PARTICLES, INTERPRETED_WIDTH = 200, 32  # at most: Triton's interpreter takes seconds for a handful
_CASE = re.compile(r"(update|frame)_([1-9][0-9]*)")


@dataclass(frozen=True)
class CompareConfig:
    """`python -m tools.compare`: which trees are timed, and on what."""

    trees: tuple[str, ...]
    out: str
    cases: tuple[str, ...] = DEFAULT_CASES
    profiles: tuple[str, ...] | None = None  # none: DEFAULT_PROFILE, where it is one of the cases
    seconds: float = 150.0  # for all of it; the third round and the last checks are made all the same
    rounds: int = 40
    precision: str = "half"
    particles: int = 4_296  # of each scene of an update
    network: NetworkConfig = field(default_factory=NetworkConfig)
    device: str = "auto"

    def __post_init__(self) -> None:
        require(len(self.trees) > 0, "trees", "a list with at least one tree", [], "as in 'trees=[main,.]'")
        require(self.out != "", "out", "the name of a JSON file", self.out)
        require(len(self.cases) > 0, "cases", "a list with at least one case", [], "as in 'cases=[update_32]'")
        for name in ("trees", "cases"):
            values = getattr(self, name)
            for i, value in enumerate(values):
                require(value not in values[:i], f"{name}[{i}]", "named once", value, "leave it out")
        for i, case in enumerate(self.cases):
            rule = "update_SCENES or frame_PARTICLES"
            require(_CASE.fullmatch(case) is not None, f"cases[{i}]", rule, case, "as in update_32 or frame_40000")
        for i, case in enumerate(self.profiles or ()):
            require(case in self.cases, f"profiles[{i}]", "one of the cases", case, f"add it to cases={self.cases}")
        require_positive(self, "seconds", "rounds", "particles")
        require_one_of(self, "precision", PRECISIONS)
        require(self.network.kind == "hgn", "network.kind", "hgn", self.network.kind)

    @property
    def profiled(self) -> tuple[str, ...]:
        if self.profiles is None:
            return tuple(case for case in self.cases if case == DEFAULT_PROFILE)
        return self.profiles

    def require_tiny(self) -> None:
        """Refuses what Triton's interpreter, which runs the kernels where there is no GPU, would take hours for.

        Raises: ConfigError.
        """
        without = "without a GPU, in Triton's interpreter"
        remedy = "take a GPU, or cases=[update_1,frame_20] particles=20 network.width=16 network.levels=2"
        width = self.network.width
        require(width <= INTERPRETED_WIDTH, "network.width", f"at most {INTERPRETED_WIDTH} {without}", width, remedy)
        for i, case in enumerate(self.cases):
            kind, count = parts_of(case)
            particles = count * self.particles if kind == "update" else count
            rule = f"of at most {INTERPRETED_PARTICLES} particles {without}"
            require(particles <= INTERPRETED_PARTICLES, f"cases[{i}]", rule, case, remedy)


def parts_of(case: str) -> tuple[str, int]:
    """update_32 is ("update", 32)."""
    kind, _, count = case.partition("_")
    return kind, int(count)
