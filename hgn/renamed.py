"""Settings in stored files of earlier releases: their present names and values.

| what changed | table | in checkpoints, weights and manifests |
|---|---|---|
| a key | KEYS | loads |
| a setting was removed | REMOVED | loads with the fixed value, else refused; refused on a command line too |
| a setting of the solver became a part of its method | METHODS | loads as the method |
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hgn.solver_method import CONSTANTS, METHODS, TAICHI_ELEMENTS_STEP_S

ANY = object()


@dataclass(frozen=True)
class Removed:
    """The value that a removed setting always has now, and the remedy for its use.

    With ANY a setting has no fixed value, and stored files load with any value.
    """

    value: Any = ANY
    remedy: str = "leave it out"


LAST_COMMIT = "commit a0b88cb, before release 0.2.0, is the last with it"
TRAIN_ANEW = "leave it out; weights with another value must be trained anew"


# `section.key`; the section is the name of the dataclass without Config. Fixed values of `scene` and `mpm` stay in the
# identity of data sets.
REMOVED: dict[str, Removed] = {
    "scene.clearance_cells": Removed(2.0),
    "scene.maximum_tilted_gravity": Removed(19.6),
    **{f"mpm.{key}": Removed(value) for key, value in CONSTANTS.items()},
    **{f"datagen.{key}": Removed(remedy=f"write dataset.{key}") for key in ("pool", "array_task", "array_tasks")},
    "datagen.connections": Removed(1024),
    "import.format": Removed(remedy="leave it out: the files determine it"),
    "card.name": Removed(remedy="edit the heading of the card"),
    "mpm.collider_friction": Removed(0.0, "write friction of each obstacle into the scene file"),
    "network.contact_forces": Removed("normal", TRAIN_ANEW),
    "network.contact_gate": Removed("cell", TRAIN_ANEW),
    "network.contact_reach_cells": Removed(3.0, TRAIN_ANEW),
    "network.material_embedding": Removed(16, TRAIN_ANEW),
    "network.maximum_neighbours": Removed(None, f"leave it out; {LAST_COMMIT}"),
    "network.rest_large_materials": Removed(["sand", "snow"], "leave it out: all materials but water"),
    "network.rest_levels": Removed(2),
    "network.static_spacing_cells": Removed(remedy=f"leave it out; {LAST_COMMIT}"),
    "network.wall_distance_cells": Removed(8.0, TRAIN_ANEW),
    "training.noise_min_scale": Removed(1.0, "leave it out: all frames have equal noise"),
    "training.pushforward_pull": Removed(remedy="leave it out: it is 0.1"),
}

# Settings of `network` in 0.1.0 that are in `step` now.
STEP = ("rest_threshold", "wall_clearance", "obstacle_clearance")
REMOVED |= {f"network.{key}": Removed(remedy=f"write step.{key}") for key in STEP}

# Old key to new key. A key stays in its section.
KEYS = {"scene.initial_speed_share": "scene.moving_group_fraction"}


def current_names(mapping: Mapping[str, Any], section: str = "") -> dict[str, Any]:
    """Returns a stored mapping with the present keys.

    `section` is its dotted name in the configuration. Removed settings are dropped. With another value
    than the fixed one they stay, and `from_mapping` refuses them.
    """
    result = {}
    for old, value in mapping.items():
        key = _join(section, str(old))  # keys of a checkpoint may be numbers
        key = KEYS.get(key, key)
        removed = REMOVED.get(key)
        if removed is None or removed.value not in (ANY, value):
            result[_last(key)] = current_names(value, key) if isinstance(value, Mapping) else value
    return _current_solver(result) if section == "mpm" else result


def _current_solver(stored: dict[str, Any]) -> dict[str, Any]:
    """Returns settings of the solver with `method` instead of the values that it determines.

    Values that belong to no method stay, and `from_mapping` refuses them.
    """
    result = dict(stored)
    for method, choices in METHODS.items():
        if choices._asdict().items() <= stored.items():
            result = {key: value for key, value in stored.items() if key not in choices._fields} | {"method": method}
    if result.pop("time_step", None) == "adaptive":
        result["fixed_time_step_s"] = None
    return result


def with_step(mapping: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the mapping of a weights file or checkpoint with a section `step`.

    0.1.0 wrote the constraints of a frame into the network's settings.
    """
    network = mapping.get("network")
    if "step" in mapping or not isinstance(network, Mapping):
        return dict(mapping)
    return {**mapping, "step": {key: network[key] for key in STEP if key in network}}


def stored_names(mapping: Mapping[str, Any], section: str) -> dict[str, Any]:
    """Returns a section of the present configuration in the form that identifies a data set.

    It has the first release's keys, and the fixed values of removed settings.
    """
    old_keys = {new: _last(old) for old, new in KEYS.items()}
    owners = {key.rpartition("."): removed.value for key, removed in REMOVED.items()}
    fixed = {name: value for (owner, _, name), value in owners.items() if owner == section and value is not ANY}
    result = fixed | {old_keys.get(_join(section, key), key): value for key, value in mapping.items()}
    if section == "mpm":
        step_s = result["fixed_time_step_s"]
        result |= METHODS[result.pop("method")]._asdict() | {"time_step": "adaptive" if step_s is None else "fixed"}
        result |= {"fixed_time_step_s": TAICHI_ELEMENTS_STEP_S if step_s is None else step_s}
    return result


def removed_remedy(section: str, key: str, value: Any) -> str | None:
    """Returns the remedy for a removed setting with this value; None for any other setting."""
    removed = REMOVED.get(_join(section, key))
    if section == "mpm" and key == "time_step":
        return "it was removed; mpm.fixed_time_step_s is null for adaptive steps"
    if section == "mpm" and key in METHODS["corrected"]._fields:
        values = ", ".join(f"{getattr(choices, key)} with {method}" for method, choices in METHODS.items())
        return f"it was removed and follows from mpm.method: {values}; other data need the release that made them"
    if removed is None:
        return None
    if removed.value is ANY:
        return f"it was removed; {removed.remedy}"
    other = "" if value == removed.value else f", not {value}"
    return f"it was removed and is always {removed.value} now{other}; {removed.remedy}"


def _last(key: str) -> str:
    return key.rpartition(".")[2]


def _join(section: str, key: str) -> str:
    return f"{section}.{key}" if section else key
