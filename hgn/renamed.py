"""Settings of earlier releases: the one table that answers their names and lets old files load.

| what changed | table | on a command line | in checkpoints, weights and manifests |
|---|---|---|---|
| a key | KEYS | refused with the new key | loads |
| a value | VALUES | refused with the new value | loads |
| a setting was removed | REMOVED | refused with the reason | loads with the fixed value, else refused |
| a choice of a config group was renamed | CHOICES | refused with the new choice | |
| a value or a choice was removed | REMOVED_CHOICES | refused with the reason | refused |
| a setting of the solver was added | BEFORE | | gets what the solver did before |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

ANY = object()


@dataclass(frozen=True)
class Removed:
    """The value that a removed setting always has now, and what to do instead of setting it.

    With ANY a setting has no fixed value, and stored files load whatever they say of it.
    """

    value: Any = ANY
    remedy: str = "leave it out"


# `section.key`; the section is the name of the dataclass without Config: network, mpm, scene, dataset, training,
# train, evaluate, rollout, error_vs_time. Fixed values of `scene` and `mpm` stay in the identity of data sets.
REMOVED: dict[str, Removed] = {
    "training.gradient_messages": Removed("fp32"),
    "training.grid_jitter": Removed(True),
    "training.maximum_skipped_updates": Removed(100),
    "training.monitor_frame_stride": Removed(4),
    "training.monitor_particles_per_batch": Removed(32_768),
    "training.monitor_scenes": Removed(5),
    "training.nodes": Removed(remedy="leave it out: the launcher starts processes on every machine"),
    "training.noise_weight_power": Removed(2.0),
    "training.quiet_weight": Removed(4.0),
}

# Values that a setting or a config group no longer takes, by the last part of its key, and what to do instead.
REMOVED_CHOICES: dict[str, dict[Any, str]] = {}

# Old key to new key, as on a command line; a key stays in its section.
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
    "scene.initial_speed_share": "scene.moving_group_fraction",
    "shares": "coefficients",  # of hgn.average
    "cursor": "sampler_state",  # in checkpoints
}

# Old value to new value, by the last part of the new key.
_BACKENDS = {"plain": "torch", "fast": "triton"}
_PRECISIONS = {"highest": "fp32", "high": "tf32", "half": "fp16"}
VALUES: dict[str, dict[Any, str]] = {
    "backend": _BACKENDS,
    "backends": _BACKENDS,
    "precision": _PRECISIONS,
    "precisions": _PRECISIONS,
    "stored_precision": {True: "fp16", False: "fp32"},
    "system": {"trivial": "baseline"},  # in reports of tools.error_vs_time
}

# Choices of config groups, old to new, as on a command line.
CHOICES = {"scene=mechanics": "scene=motion", "dataset=mechanics": "dataset=motion"}

# Settings of the solver that data sets of 0.1.0 lack, and what the solver did then.
BEFORE: dict[str, Any] = {
    "mpm.time_integration": "symplectic_euler",
    "mpm.water_density_relaxation_s": None,
    "mpm.sand_grain_diameter_m": 0.0,
}

# Prefixes of metrics in metrics.jsonl.
METRICS = {"trivial/": "baseline/", "one_step_gain/": "baseline_ratio/", "own_states/": "pushforward/"}


def current_metrics(record: Mapping[str, float]) -> dict[str, float]:
    """Returns a record of metrics.jsonl under today's names."""
    result = {}
    for name, value in record.items():
        old = next((prefix for prefix in METRICS if name.startswith(prefix)), "")
        result[METRICS.get(old, "") + name.removeprefix(old)] = value
    return result


def current_value(key: str, value: Any) -> Any:
    """Returns today's name of a value; `key` may be dotted, or that of an item of a list."""
    values = VALUES.get(_last(key), {})
    return values.get(value, value) if isinstance(value, (str, bool)) else value


def current_names(mapping: Mapping[str, Any], section: str = "") -> dict[str, Any]:
    """Returns a stored mapping with today's keys and values.

    `section` is its dotted name in the configuration. Settings of the solver that are younger than the file are added,
    removed ones are dropped. A removed one with another value than the fixed one stays, for `from_mapping` to refuse.
    """
    result = {key.removeprefix("mpm."): value for key, value in BEFORE.items()} if section == "mpm" else {}
    for old, value in mapping.items():
        key = KEYS.get(_join(section, old), _join(section, old))
        removed = REMOVED.get(key)
        if removed is None or removed.value not in (ANY, value):
            inner = current_names(value, key) if isinstance(value, Mapping) else current_value(key, value)
            result[key.rpartition(".")[2]] = inner
    return result


def stored_names(mapping: Mapping[str, Any], section: str) -> dict[str, Any]:
    """Returns a section of today's configuration as it identifies a data set: with the first release's keys, and with
    the fixed values of removed settings.
    """
    old_keys = {new: old.rpartition(".")[2] for old, new in KEYS.items()}
    owners = {key.rpartition("."): removed.value for key, removed in REMOVED.items()}
    fixed = {name: value for (owner, _, name), value in owners.items() if owner == section and value is not ANY}
    return fixed | {old_keys.get(_join(section, key), key): value for key, value in mapping.items()}


def renamed_remedy(key: str, value: Any) -> str | None:
    """Returns what to write instead of an old key, which is dotted, or None for a key that was not renamed."""
    if key not in KEYS:
        return None
    value = current_value(KEYS[key], value)
    example = f"={value}" if isinstance(value, (str, int, float)) else ""
    return f"it is called {KEYS[key]} now; write {KEYS[key]}{example}"


def removed_remedy(section: str, key: str) -> str | None:
    """Returns what to do about a removed setting, or None for any other."""
    removed = REMOVED.get(_join(section, key))
    if removed is None:
        return None
    return f"it was removed{'' if removed.value is ANY else f' and is always {removed.value} now'}; {removed.remedy}"


def value_remedy(key: str, value: Any) -> str:
    """Returns what to write instead of an old value, or an empty text for any other value."""
    if not isinstance(value, (str, bool)):
        return ""
    new = current_value(key, value)
    renamed = "" if new is value else f"{value} is called {new} now"
    return REMOVED_CHOICES.get(_last(key), {}).get(value, renamed)


def _last(key: str) -> str:
    """The last part of a dotted key, without the number of an item."""
    return key.rpartition(".")[2].partition("[")[0]


def _join(section: str, key: str) -> str:
    return f"{section}.{key}" if section else key
