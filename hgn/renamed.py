"""Settings of earlier releases: errors for their names on command lines, and conversion of old files.

| what changed | table | on a command line | in checkpoints, weights and manifests |
|---|---|---|---|
| a key | KEYS | refused with the new key | loads |
| a value | VALUES | refused with the new value | loads |
| a setting was removed | REMOVED | refused with the reason | loads with the fixed value, else refused |
| a choice of a config group was renamed | CHOICES | refused with the new choice | |
| a value or a choice was removed | REMOVED_CHOICES | refused with the reason | refused |
| a setting of the solver became a part of its method | METHODS | refused with the method | loads as the method |
| a setting of the solver was added | BEFORE | | gets what the solver did before |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from hgn.solver_method import CONSTANTS, METHODS, TAICHI_ELEMENTS_STEP_S

ANY = object()


@dataclass(frozen=True)
class Removed:
    """The value that a removed setting always has now, and the remedy for its use.

    With ANY a setting has no fixed value, and stored files load with any value. Files also load if other settings of
    the section make the setting ineffective.
    """

    value: Any = ANY
    remedy: str = "leave it out"
    has_effect: Callable[[Mapping[str, Any]], bool] = lambda section: True

    def allows(self, value: Any, section: Mapping[str, Any]) -> bool:
        """Returns whether a stored section with this value gives the same results now."""
        return self.value is ANY or value == self.value or not self.has_effect(section)


def _relative(network: Mapping[str, Any]) -> bool:
    return network.get("inputs", "absolute") != "absolute"


def _rests(network: Mapping[str, Any]) -> bool:
    return bool(network.get("rest_threshold"))


def _rests_otherwise(network: Mapping[str, Any]) -> bool:
    """Returns whether the materials that rest on larger cells are other than all except water."""
    materials = set(network.get("materials", ()))
    large = network.get("rest_large_materials")
    return _rests(network) and (materials if large is None else set(large)) != materials - {"water"}


LAST_COMMIT = "commit a0b88cb, before release 0.2.0, is the last with it"
REPORTS_COMMIT = "commit e7e6c37 is the last with it"
GRIDS = f"tools.error_vs_time and cases=[gallery] compare grids; {REPORTS_COMMIT}"
TRAIN_ANEW = "leave it out; weights with another value must be trained anew"


# `section.key`; the section is the name of the dataclass without Config: network, mpm, scene, dataset, training,
# train, evaluate, render, bench, scaling. Fixed values of `scene` and `mpm` stay in the identity of data sets.
REMOVED: dict[str, Removed] = {
    "dataset.maximum_attempts": Removed(3),
    "dataset.ray_address": Removed(None, "set $RAY_ADDRESS"),
    "scene.clearance_cells": Removed(2.0),
    "scene.maximum_tilted_gravity": Removed(19.6),
    **{f"mpm.{key}": Removed(value) for key, value in CONSTANTS.items()},
    "network.contact_forces": Removed("normal", TRAIN_ANEW, _relative),
    "network.contact_gate": Removed("cell", TRAIN_ANEW, _relative),
    "network.contact_reach_cells": Removed(3.0, TRAIN_ANEW, _relative),
    "network.material_embedding": Removed(16, TRAIN_ANEW),
    "network.maximum_neighbours": Removed(None, f"leave it out; {LAST_COMMIT}"),
    "network.rest_large_materials": Removed("all but water", "leave it out", _rests_otherwise),
    "network.rest_levels": Removed(2, "leave it out", _rests),
    "network.static_spacing_cells": Removed(remedy=f"leave it out; {LAST_COMMIT}"),
    "network.wall_distance_cells": Removed(8.0, TRAIN_ANEW, lambda network: not _relative(network)),
    "dataset.early_episodes": Removed(remedy="leave it out: trainings and the service generate few scenes first"),
    "training.gradient_messages": Removed("fp32"),
    "training.huber": Removed(),
    "training.weight_decay": Removed(),
    "training.grid_jitter": Removed(True),
    "training.maximum_skipped_updates": Removed(100),
    "training.monitor_frame_stride": Removed(4),
    "training.monitor_particles_per_batch": Removed(32_768),
    "training.monitor_scenes": Removed(5),
    "training.nodes": Removed(remedy="leave it out: the launcher starts processes on every machine"),
    "training.noise_weight_power": Removed(2.0),
    "training.quiet_weight": Removed(4.0),
    "evaluate.particles_per_batch": Removed(32_768),
    "bench.public_gns": Removed(remedy=REPORTS_COMMIT),
    "bench.rounds": Removed(50, "set seconds for a shorter measurement"),
    "error_vs_time.earlier": Removed(remedy="leave it out: make docs draws the figures from the JSON"),
    "error_vs_time.seconds": Removed(None, "take fewer scenes; after Ctrl-C the file has what was measured"),
    "error_vs_time.times_last": Removed(False),
    "scaling.rounds": Removed(20, "set seconds for a shorter measurement"),
    "render.gif": Removed(True, "give a file that ends in .png as out for a picture without animation"),
    "stability_network.picture": Removed(remedy="leave it out: python -m tools.render draws scenes"),
    "stability_solver.grid_cells": Removed(remedy=GRIDS),
    "stability_solver.picture": Removed(remedy="leave it out: make docs draws it from the JSON"),
    "render.fps": Removed(remedy="leave it out: animations play in real time"),
    "upload.follow": Removed(remedy="run the command again, as with watch -n 60: it copies what is new"),
    "upload.poll_s": Removed(remedy="run the command again, as with watch -n 60: it copies what is new"),
}

# Settings of `network` in 0.1.0 that are in `step` now.
STEP = ("rest_threshold", "wall_clearance", "obstacle_clearance")
REMOVED |= {f"network.{key}": Removed(remedy=f"write step.{key}") for key in STEP}

# Removed values of settings and config groups, by the last part of the key, and the remedy.
_GNS_PARTICLES = {"gns_particles": LAST_COMMIT}
REMOVED_CHOICES: dict[str, dict[Any, str]] = {
    "cases": dict.fromkeys(("apart", "hole"), "cases=[gallery] has such scenes")
    | dict.fromkeys(("leak", "guard"), "leave it out: tests check the same")
    | {"convergence": REPORTS_COMMIT, "grid": GRIDS},
    "kind": _GNS_PARTICLES,
    "network": _GNS_PARTICLES,
    "experiment": _GNS_PARTICLES,
    "weights": _GNS_PARTICLES
    | {
        name: f"{LAST_COMMIT}; its file hgn/weights/{name}.safetensors loads"
        for name in ("gns", "gns_no_obstacles", "no_obstacles", "obstacles_levels_3", "obstacles_steps_1")
    },
}

# Old key to new key, as on a command line. A key stays in its section.
KEYS = {
    "half": "stored_precision",
    "path": "backend",
    "paths": "backends",
    "training.path": "training.backend",
    "training.noise_smooth": "training.noise_correlated_fraction",
    "training.noise_at_rest": "training.noise_min_scale",
    "training.rollout_share": "training.pushforward_fraction",
    "training.rollout_every": "training.pushforward_every",
    "training.rollout_scenes": "training.pushforward_scenes",
    "training.rollout_frames": "training.pushforward_frames",
    "training.rollout_pull": "training.pushforward_pull",
    "training.weights": "training.init_weights",
    "training.accelerator": "training.device",
    "scene.initial_speed_share": "scene.moving_group_fraction",
    "shares": "coefficients",  # of hgn.average
    "cursor": "sampler_state",  # in checkpoints
}

# Old value to new value, by the last part of the new key.
_BACKENDS = {"plain": "torch", "fast": "triton"}
_PRECISIONS = {"highest": "fp32", "high": "tf32", "half": "fp16"}
VALUES: dict[str, dict[Any, str]] = {
    "backend": _BACKENDS,
    "device": {"gpu": "cuda"},
    "solver_device": {"gpu": "cuda"},
    "backends": _BACKENDS,
    "precision": _PRECISIONS,
    "precisions": _PRECISIONS,
    "stored_precision": {True: "fp16", False: "fp32"},
    "system": {"trivial": "baseline"},  # in reports of tools.error_vs_time
}

# Choices of config groups, old to new, as on a command line.
CHOICES = {"scene=mechanics": "scene=motion", "dataset=mechanics": "dataset=motion"}

# Settings that data sets and weights of 0.1.0 do not have, and the values that they had in effect.
BEFORE: dict[str, Any] = {
    "network.contact_forces": "any",
    "network.contact_gate": "particle",
    "network.contact_reach_cells": 1.5,
    "network.rest_large_materials": None,
    "network.rest_levels": 1,
    "mpm.time_integration": "symplectic_euler",
    "mpm.water_density_relaxation_s": None,
    "mpm.sand_grain_diameter_m": 0.0,
}

# Prefixes of metrics in metrics.jsonl.
METRICS = {"trivial/": "baseline/", "one_step_gain/": "baseline_ratio/", "own_states/": "pushforward/"}


def current_metrics(record: Mapping[str, float]) -> dict[str, float]:
    """Returns a record of metrics.jsonl with the present names."""
    result = {}
    for name, value in record.items():
        old = next((prefix for prefix in METRICS if name.startswith(prefix)), "")
        result[METRICS.get(old, "") + name.removeprefix(old)] = value
    return result


def current_value(key: str, value: Any) -> Any:
    """Returns the present name of a value. `key` may be dotted, or that of an item of a list."""
    values = VALUES.get(_last(key), {})
    return values.get(value, value) if isinstance(value, (str, bool)) else value


def current_names(mapping: Mapping[str, Any], section: str = "") -> dict[str, Any]:
    """Returns a stored mapping with the present keys and values.

    `section` is its dotted name in the configuration. Settings that are newer than the file are added, and removed
    settings are dropped. A removed setting with another value than the fixed one stays, and `from_mapping` refuses it.
    """
    # only networks of 0.1.0 have the key material_embedding
    if section == "mpm" or (section == "network" and "material_embedding" in mapping):
        before = {_last(key): value for key, value in BEFORE.items() if key.startswith(f"{section}.")}
        mapping = before | dict(mapping)
    result = {}
    for old, value in mapping.items():
        key = _join(section, str(old))  # keys of a checkpoint may be numbers
        key = KEYS.get(key, key)
        removed = REMOVED.get(key)
        if removed is None or not removed.allows(value, mapping):
            inner = current_names(value, key) if isinstance(value, Mapping) else current_value(key, value)
            result[key.rpartition(".")[2]] = inner
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
    old_keys = {new: old.rpartition(".")[2] for old, new in KEYS.items()}
    owners = {key.rpartition("."): removed.value for key, removed in REMOVED.items()}
    fixed = {name: value for (owner, _, name), value in owners.items() if owner == section and value is not ANY}
    result = fixed | {old_keys.get(_join(section, key), key): value for key, value in mapping.items()}
    if section == "mpm":
        step_s = result["fixed_time_step_s"]
        result |= METHODS[result.pop("method")]._asdict() | {"time_step": "adaptive" if step_s is None else "fixed"}
        result |= {"fixed_time_step_s": TAICHI_ELEMENTS_STEP_S if step_s is None else step_s}
    return result


def renamed_remedy(key: str, value: Any) -> str | None:
    """Returns the replacement for an old, dotted key; None for a key that was not renamed."""
    if key not in KEYS:
        return None
    value = current_value(KEYS[key], value)
    example = f"={value}" if isinstance(value, (str, int, float)) else ""
    return f"it is called {KEYS[key]} now; write {KEYS[key]}{example}"


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


def value_remedy(key: str, value: Any) -> str:
    """Returns the replacement for an old value; an empty text for any other value."""
    if not isinstance(value, (str, bool)):
        return ""
    new = current_value(key, value)
    renamed = "" if new is value else f"{value} is called {new} now"
    return REMOVED_CHOICES.get(_last(key), {}).get(value, renamed)


def _last(key: str) -> str:
    """Returns the last part of a dotted key, without the number of an item."""
    return key.rpartition(".")[2].partition("[")[0]


def _join(section: str, key: str) -> str:
    return f"{section}.{key}" if section else key
