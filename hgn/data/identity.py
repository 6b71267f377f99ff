"""Computes the identity of a data set: all settings that its trajectories depend on, and no others.

Counts, folder, workers, device and launch size are not part of it. A data set can therefore grow on other machines.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hgn.config import DatagenConfig, SceneConfig, is_mesh_file
from hgn.renamed import stored_names
from hgn.scene.episode import SCHEMA_VERSION
from hgn.scene.shapes import mesh_sha256
from hgn.schema import ConfigError, to_mapping

# settings of the solver that change trajectories only by rounding
_NOT_PHYSICS = ("device", "scenes_per_launch")
_MESH_DIGEST = re.compile(r" [0-9a-f]{64}\b")  # after the name of a mesh file
# settings of scenes that older data sets do not have; they are omitted at their defaults
_LATER_OPTIONS = (
    "pure_direction_fraction", "colliding_scene_fraction", "zero_gravity_fraction", "tilted_gravity_fraction",
    "maximum_tilted_gravity", "funnel_scene_fraction", "funnel_hole", "kinds",
    "own_physics",
)  # fmt: skip


def dataset_identity(config: DatagenConfig) -> dict[str, Any]:
    """Returns the mapping that defines the episodes: scenes, physics, frames, rate, seed, schema, a finer grid.

    Keys are those of the first release, so the identity does not change. Mesh files are represented by their content.
    Raises: ConfigError for an unreadable mesh file.
    """
    shapes = config.scene.obstacle_shapes
    named = [f"{Path(shape).name} {mesh_sha256(shape)}" if is_mesh_file(shape) else shape for shape in shapes]
    scene = stored_names(to_mapping(config.scene), "scene")
    defaults = stored_names(to_mapping(SceneConfig()), "scene")
    for option in _LATER_OPTIONS:
        if scene[option] == defaults[option]:
            del scene[option]
    lengths: dict[str, float] = {"frames": config.dataset.frames}
    if config.dataset.long_fraction > 0:
        lengths |= {"long_fraction": config.dataset.long_fraction, "long_frames": config.dataset.long_frames}
    reference = config.reference
    return {
        **({} if reference is None else {"reference": reference}),
        "schema_version": SCHEMA_VERSION,
        "scene": scene | {"obstacle_shapes": named},
        "mpm": physics_settings(config),
        **lengths,
        "frame_rate_hz": config.dataset.frame_rate_hz,
        "seed": config.dataset.seed,
    }


def physics_settings(config: DatagenConfig) -> dict[str, Any]:
    """Returns the solver's settings that trajectories depend on, as stored with each episode."""
    settings = stored_names(to_mapping(config.mpm), "mpm")
    return {key: value for key, value in settings.items() if key not in _NOT_PHYSICS}


def identity_hash(identity: Mapping[str, Any]) -> str:
    """Returns the sha256 of the identity as canonical JSON."""
    text = json.dumps(identity, sort_keys=True, allow_nan=False, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def identity_differences(stored: Mapping[str, Any], requested: Mapping[str, Any], path: str = "") -> list[str]:
    """Returns a line for each different key: `scene.obstacle_count is 5 there, 3 is requested`."""
    lines = []
    for key in sorted(stored.keys() | requested.keys()):
        name = f"{path}.{key}" if path else key
        left, right = stored.get(key, "nothing"), requested.get(key, "nothing")
        if isinstance(left, Mapping) and isinstance(right, Mapping):
            lines += identity_differences(left, right, name)
        elif left != right:
            there, here = (_MESH_DIGEST.sub("", str(value)) for value in (left, right))
            line = f"{name} is {there} there, {here} is requested"
            if there == here and isinstance(left, list) and isinstance(right, list):  # only the content of meshes
                changed = [_MESH_DIGEST.sub("", str(value)) for value in right if value not in left]
                line = f"{name}: {', '.join(changed)} was changed"
            lines.append(line)
    return lines


def require_same_dataset(
    stored: Mapping[str, Any],
    config: DatagenConfig,
    folder: object,
    folder_keys: str = "out=... or dataset.folder=...",
) -> None:
    """Checks that a folder's data set (its manifest's `config`) is the data set of a configuration.

    `folder_keys` are the settings that name the folder.

    Raises: ConfigError naming the first keys that differ, and the remedy.
    """
    differences = identity_differences(stored, dataset_identity(config))
    if differences:
        shown = "; ".join(differences[:3]) + (f"; and {len(differences) - 3} more" if len(differences) > 3 else "")
        raise ConfigError(
            f"{folder} contains another data set: {shown}; choose another folder ({folder_keys}) or the same settings"
        )
