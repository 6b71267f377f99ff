"""The symmetries of a scene's box that keep gravity: what training may show a network instead of the scene itself.

Each exchanges axes or mirrors them. Where gravity points along an axis and the other two sides are equal there are
eight, a square's: four quarter turns about gravity, each mirrored too; four where those sides differ.
The box is the solver's, from its first node to its last: (n - 1) cells on an axis of n nodes. Its walls are the same
number of nodes at both ends, so what rests on them rests at 2 and at 61 cells of 64. A mirror therefore takes x to
(n - 1) cells minus x, nodes to nodes; about the middle of the domain it would move the walls by a cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import permutations, product

from hgn.schema import Vector
from hgn.system.splitmix import splitmix64

CELL_BITS = 17  # as in a cell's key
CODE_BITS = 3 + CELL_BITS  # of an axis: where it comes from in two bits, whether mirrored, the box's cells


@dataclass(frozen=True)
class Symmetry:
    """Coordinate i of the image is coordinate `source[i]`, or `cells[i]` cells minus it where `mirrored[i]`."""

    source: tuple[int, int, int] = (0, 1, 2)
    mirrored: tuple[bool, bool, bool] = (False, False, False)
    cells: tuple[int, int, int] = (0, 0, 0)  # between the solver's first node and its last
    cell_size: float = 1 / 64

    @property
    def mirror_sum(self) -> Vector:
        """A mirrored coordinate and its image add up to this, domain units."""
        x, y, z = (count * self.cell_size for count in self.cells)
        return x, y, z

    def direction(self, vector: Vector) -> Vector:
        """The image of a vector that has no place, as gravity."""
        x, y, z = (-vector[s] if m else vector[s] for s, m in zip(self.source, self.mirrored, strict=True))
        return x, y, z

    @cached_property
    def code(self) -> int:
        """All but the cell size in one integer below 2^60, for the kernels."""
        assert min(self.cells) >= 0 and max(self.cells) < 1 << CELL_BITS
        axes = zip(self.source, self.mirrored, self.cells, strict=True)
        return sum((s | m << 2 | cells << 3) << CODE_BITS * i for i, (s, m, cells) in enumerate(axes))


@lru_cache(maxsize=256)
def scene_symmetries(
    gravity: Vector, domain_size: Vector, cell_size: float, less: int = 1, dimensions: int = 3
) -> tuple[Symmetry, ...]:
    """All exchanges and mirrors of axes that keep gravity and the domain; the identity first.

    Any gravity is allowed: without one all 48 symmetries of a cube remain, with an oblique one perhaps the identity
    alone. `cell_size` is the solver's, whose box is `less` than the domain by a cell. An imported set's is the domain;
    where that is no whole number of cells, an axis is not mirrored. Axes from `dimensions` on stay as they are.
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
    """One of them, each as likely; a function of the sample's seed alone, in another stream than noise and jitter."""
    assert symmetries, "the scene's symmetries are not known"
    return symmetries[(splitmix64(seed) * len(symmetries)) >> 64]
