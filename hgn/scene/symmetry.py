"""The symmetries of a scene's box that keep gravity, for augmentation in training.

A symmetry exchanges axes or mirrors them. With gravity along an axis there are eight if the other two sides are equal
(four quarter turns about gravity, each also mirrored). Otherwise there are four.
The box spans the solver's nodes: (n - 1) cells on an axis of n nodes. Its walls have the same number of nodes at both
ends, so particles rest at 2 and at 61 of 64 cells. A mirror therefore maps x to (n - 1) cells minus x, and nodes to
nodes. A mirror at the middle of the domain would move the walls by a cell.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import permutations, product

from hgn.schema import Vector, triple
from hgn.system.splitmix import splitmix64

CELL_BITS = 17  # bits for a number of cells, as in a cell's key
CODE_BITS = 3 + CELL_BITS  # bits of an axis: two for the source, one for the mirror, the others for the box's cells


@dataclass(frozen=True)
class Symmetry:
    """Coordinate i of the image is coordinate `source[i]`; if `mirrored[i]`, it is `cells[i]` cells minus that."""

    source: tuple[int, int, int] = (0, 1, 2)
    mirrored: tuple[bool, bool, bool] = (False, False, False)
    cells: tuple[int, int, int] = (0, 0, 0)  # number of cells between the solver's first node and its last
    cell_size: float = 1 / 64

    @property
    def mirror_sum(self) -> Vector:
        """Returns the sum of a mirrored coordinate and its image, domain units."""
        return triple(count * self.cell_size for count in self.cells)

    def direction(self, vector: Vector) -> Vector:
        """Returns the image of a direction, for example of gravity."""
        return triple(-vector[s] if m else vector[s] for s, m in zip(self.source, self.mirrored, strict=True))

    @cached_property
    def code(self) -> int:
        """Returns the symmetry as an integer below 2^60 for the kernels, without the cell size."""
        assert min(self.cells) >= 0 and max(self.cells) < 1 << CELL_BITS
        axes = zip(self.source, self.mirrored, self.cells, strict=True)
        return sum((s | m << 2 | cells << 3) << CODE_BITS * i for i, (s, m, cells) in enumerate(axes))


@lru_cache(maxsize=256)
def scene_symmetries(
    gravity: Vector, domain_size: Vector, cell_size: float, less: int = 1, dimensions: int = 3
) -> tuple[Symmetry, ...]:
    """Returns all exchanges and mirrors of axes that keep gravity and the domain, starting with the identity.

    Without gravity all 48 symmetries of a cube remain; with oblique gravity perhaps only the identity. `cell_size` is
    the solver's. Its box is `less` cells smaller than the domain; the box of an imported set is its domain. An axis
    without a whole number of cells is not mirrored. Axes with numbers from `dimensions` are unchanged.
    """
    x, y, z = (round(length / cell_size) - less for length in domain_size)
    cells = x, y, z
    whole = [
        less or abs(n * cell_size - length) < 1e-4 * cell_size for n, length in zip(cells, domain_size, strict=True)
    ]
    symmetries = []
    for s0, s1, s2 in permutations(range(3)):
        for m0, m1, m2 in product((False, True), repeat=3):
            symmetry = Symmetry((s0, s1, s2), (m0, m1, m2), cells, cell_size)
            moved = [s != axis or m for axis, (s, m) in enumerate(zip(symmetry.source, symmetry.mirrored, strict=True))]
            if any(moved[dimensions:]) or any(m and not w for m, w in zip(symmetry.mirrored, whole, strict=True)):
                continue
            if symmetry.direction(gravity) == gravity and [domain_size[s] for s in symmetry.source] == [*domain_size]:
                symmetries.append(symmetry)
    return tuple(symmetries)


def drawn_symmetry(symmetries: tuple[Symmetry, ...], seed: int) -> Symmetry:
    """Draws a symmetry uniformly by the sample's seed, independent of noise and grid jitter."""
    assert symmetries, "the scene's symmetries are not known"
    return symmetries[(splitmix64(seed) * len(symmetries)) >> 64]
