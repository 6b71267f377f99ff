"""Particles of a group from a file: npz or USD."""

from pathlib import Path

import numpy as np

from hgn.config import USD_ENDINGS
from hgn.scene.npz import read_npz
from hgn.scene.usd import read_usd_particles
from hgn.schema import ConfigError, Vector, require

ENDINGS = (".npz", *USD_ENDINGS)


def read_particles(path: Path, field: str, material: str, domain_size: Vector) -> tuple[np.ndarray, np.ndarray]:
    """Reads positions and velocities, float32 [N, 3], of a group of this material. Raises: ConfigError."""
    exists = path.suffix in ENDINGS and path.is_file()
    require(exists, field, "an existing .npz or USD file", path, "relative to the scene file")
    kind = "USD" if path.suffix in USD_ENDINGS else ".npz"
    try:
        if kind == "USD":
            arrays = read_usd_particles(path, material)
        else:
            names = ("position", "velocity", "velocities")
            arrays = {name: array for name, array in read_npz(path) if name in names}
    except ValueError as error:
        text = f"{path}: {error}" if kind == "USD" else str(error)
        raise ConfigError(f"{field} must be a readable {kind} file, got {text}") from error
    rule, remedy = "a file with arrays named position and velocity", "did you mean velocity?"
    require("velocities" not in arrays, field, rule, "velocities", remedy)
    require("position" in arrays, field, "a file with an array named position", path)
    for name, value in arrays.items():
        require(value.dtype.kind in "fiu", f"{field}: {name}", "of numbers", value.dtype.name)
        arrays[name] = value.astype(np.float32)
    shape = (arrays["position"].size // 3, 3)
    for name, value in arrays.items():
        require(value.shape == shape, f"{field}: {name}", f"of shape {shape}", value.shape)
        require(bool(np.isfinite(value).all()), f"{field}: {name}", "finite", float("nan"))
    position_N3 = arrays["position"]
    outside = int(((position_N3 < 0) | (position_N3 > np.array(domain_size))).any(axis=1).sum())
    require(len(position_N3) > 0, f"{field}: position", "of at least one particle", "none")
    require(outside == 0, f"{field}: position", "inside the domain", f"{outside} outside")
    return position_N3, arrays.get("velocity", np.zeros_like(position_N3))
