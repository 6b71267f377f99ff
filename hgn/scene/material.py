"""The materials of scenes. Episodes store the index into `MATERIALS`.

docs/how_to/add_material.md lists the steps for a new material. Append its name here, so that old indices stay valid.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from hgn.schema import ConfigError, require

if TYPE_CHECKING:
    import numpy as np

MATERIALS: tuple[str, ...] = ("water", "sand", "snow", "elastic")
WATER, SAND, SNOW, ELASTIC = range(4)
PAPER_MATERIALS = MATERIALS[:3]  # defaults of data and networks
FLUIDS: tuple[int, ...] = (WATER,)  # materials without a deformation gradient; their only memory is their volume
MATERIAL_BITS = 4  # bits of a particle's label in the solver for the material, below those for the scene
MATERIAL_MASK = (1 << MATERIAL_BITS) - 1
assert len(MATERIALS) <= 1 << MATERIAL_BITS
# constants that may differ between particles of one material; MpmConfig has the defaults
MATERIAL_PARAMETERS: tuple[str, ...] = (
    "youngs_modulus_pa",
    "poisson_ratio",
    "density_kg_m3",
    "sand_friction_angle_deg",
    "snow_hardening",
    "snow_critical_compression",
    "snow_critical_stretch",
    "water_tension",
    "water_viscosity_pa_s",
)
# what scenes draw and networks have as inputs: friction of surfaces, parameters of materials, elastic bodies, motion of
# obstacles
OWN_PHYSICS = ("friction", "parameters", "elastic", "moving")
# Parameters that networks have as inputs, in the order of their columns, and the ranges that random scenes draw.
INPUT_PARAMETERS: dict[str, tuple[float, float]] = {
    "youngs_modulus_pa": (1.25e5, 2e6), "density_kg_m3": (500.0, 2000.0), "sand_friction_angle_deg": (15.0, 45.0),
    "snow_hardening": (5.0, 15.0), "snow_critical_compression": (0.01, 0.05), "snow_critical_stretch": (0.002, 0.01),
    "water_viscosity_pa_s": (0.25, 64.0),
}  # fmt: skip
# The ranges of these are powers of two wide; the network sees their logarithms.
LOGARITHMIC = ("youngs_modulus_pa", "density_kg_m3", "water_viscosity_pa_s")


def acts_on(parameter: str, material: str) -> bool:
    """Returns whether a parameter acts on a material. The others of a name such as sand_… act on all materials."""
    owner = parameter.partition("_")[0]
    return owner == material or owner not in MATERIALS


def material_index(name: str) -> int:
    """Returns the index of a material name in `MATERIALS`.

    Raises: ConfigError when the name is unknown.
    """
    require(name in MATERIALS, "material", f"one of {', '.join(MATERIALS)}", name)
    return MATERIALS.index(name)


def elastic_particles(material_N: np.ndarray, materials: Sequence[str]) -> np.ndarray:
    """Returns for indices into `materials` whether a particle is of an elastic body, bool [N]."""
    import numpy as np  # here, because all commands read this file for --help

    return np.array([name == MATERIALS[ELASTIC] for name in materials])[material_N]


MATERIAL_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")  # names of an imported set's materials


def require_materials(owner: str, material_N: np.ndarray, materials: Sequence[str]) -> None:
    """Raises ConfigError unless field `owner` contains indices into `materials`, and these are valid names."""
    require(isinstance(materials, (tuple, list)), f"{owner}: materials", "a list of names", materials)
    for name in materials:
        if MATERIAL_NAME.fullmatch(name) is None:
            raise ConfigError(f"{owner}: materials must be names of lower-case letters, digits and _, got {name!r}")
    require(material_N.dtype.kind in "iu", owner, "whole numbers", str(material_N.dtype))
    for material in (material_N.min(), material_N.max()) if len(material_N) else ():
        rule = f"0 to {len(materials) - 1} ({', '.join(materials)})"
        require(0 <= material < len(materials), owner, rule, int(material))
