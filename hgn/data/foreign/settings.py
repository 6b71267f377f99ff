"""Settings of an import."""

from dataclasses import dataclass, field

from hgn.scene.material import MATERIAL_NAME
from hgn.schema import FolderName, OneOrMore, Positive, require, require_bounds


@dataclass(frozen=True)
class ImportConfig:
    """`python -m hgn.import_trajectories`, which also takes `from`: the folder to read."""

    out: FolderName  # a new folder for the data set
    history: OneOrMore = 5  # frames before frame 0, at least network.velocity_history
    # names by particle type, as in {7: goop}, in addition to the format's
    materials: dict[str, str] = field(default_factory=dict)
    boundary_types: tuple[int, ...] | None = None  # particle types that are obstacles; null: the format's
    # low and high of each axis, in the set's unit of length; null: as in metadata.json
    bounds: tuple[tuple[float, float], ...] | None = None
    dimensions: int | None = None  # 2 or 3; null: as in metadata.json
    dt: Positive[float] | None = None  # seconds between frames; null: as in metadata.json
    radius: Positive[float] | None = None  # reach of neighbours and size of cells; null: as in metadata.json
    gravity: tuple[float, ...] | None = None  # length per second squared; null: as in metadata.json, or estimated

    def __post_init__(self) -> None:
        require_bounds(self)
        for kind, name in self.materials.items():
            rule = "a name of lower-case letters, digits and _"
            require(MATERIAL_NAME.fullmatch(name) is not None, f"materials[{kind}]", rule, name)
