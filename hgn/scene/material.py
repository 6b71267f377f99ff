"""The materials that scenes are made of; an episode stores the index into `MATERIALS`."""

from __future__ import annotations

from hgn.schema import ConfigError

MATERIALS: tuple[str, ...] = ("water", "sand", "snow")
WATER, SAND, SNOW = range(3)
# what particles of one material may differ in, by the names that MpmConfig gives the defaults
MATERIAL_PARAMETERS: tuple[str, ...] = (
    "youngs_modulus_pa",
    "poisson_ratio",
    "density_kg_m3",
    "sand_friction_angle_deg",
    "snow_hardening",
)


def material_index(name: str, field: str = "material") -> int:
    """The index of a material name in `MATERIALS`.

    Raises: ConfigError when the name is unknown.
    """
    if name not in MATERIALS:
        raise ConfigError(f"{field} must be one of {', '.join(MATERIALS)}, got {name!r}")
    return MATERIALS.index(name)
