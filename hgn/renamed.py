"""Names of earlier releases: the one table by which they are answered with today's, and by which old files load.

A command line or YAML file with an old name is refused, and the message gives the new one. Checkpoints, weights and
manifests keep the names that they were written with, and load.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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
# Old value to new value, by the new key's last name.
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

# Choices of config groups, old to new, as on a command line: the name `mechanics` is that of an experiment and weights.
CHOICES = {"scene=mechanics": "scene=motion", "dataset=mechanics": "dataset=motion"}


# Settings younger than some data sets, of the solver: what it did before it had them.
BEFORE: dict[str, Any] = {
    "mpm.transfer_speed_m_s": None,
    "mpm.time_integration": "symplectic_euler",
    "mpm.water_density_relaxation_s": None,
    "mpm.sand_grain_diameter_m": 0.0,
}


# Settings of relative inputs that left, and what they always are now.
GONE: dict[str, Any] = {"network.momentum": "angular", "network.obstacle_distances": False}


# Prefixes of logged metrics, old to new: metrics.jsonl of earlier runs stays as it is.
METRICS = {"trivial/": "baseline/", "one_step_gain/": "baseline_ratio/", "own_states/": "pushforward/"}


def current_metrics(record: Mapping[str, float]) -> dict[str, float]:
    """A record of metrics.jsonl under today's names."""
    result = {}
    for name, value in record.items():
        old = next((prefix for prefix in METRICS if name.startswith(prefix)), "")
        result[METRICS.get(old, "") + name.removeprefix(old)] = value
    return result


def current_value(key: str, value: Any) -> Any:
    """A value as it is called today; `key` may be dotted, and of an item of a list."""
    values = VALUES.get(key.rpartition(".")[2].partition("[")[0], {})
    return values.get(value, value) if isinstance(value, (str, bool)) else value


def current_names(mapping: Mapping[str, Any], section: str = "") -> dict[str, Any]:
    """A stored mapping with today's keys and values; `section` is its dotted name in the configuration. What a setting
    did before there was one stands where it is missing.
    """
    result = {key.removeprefix("mpm."): value for key, value in BEFORE.items()} if section == "mpm" else {}
    for old, value in mapping.items():
        key = KEYS.get(_join(section, old), _join(section, old))
        inner = current_names(value, key) if isinstance(value, Mapping) else current_value(key, value)
        result[key.rpartition(".")[2]] = inner
    for key, always in GONE.items():
        owner, _, name = key.rpartition(".")
        # another value is that of no network of today, and refused by the key's name
        if section == owner and (result.get(name) == always or result.get("inputs") != "relative"):
            result.pop(name, None)
    return result


def stored_names(mapping: Mapping[str, Any], section: str) -> dict[str, Any]:
    """A section of today's configuration with the keys that data sets are identified by: those they began with."""
    old_keys = {new: old.rpartition(".")[2] for old, new in KEYS.items()}
    return {old_keys.get(_join(section, key), key): value for key, value in mapping.items()}


def key_remedy(key: str, value: Any) -> str | None:
    """What to write instead of an old key, which is dotted; none for a key that was not renamed."""
    if key not in KEYS:
        return None
    value = current_value(KEYS[key], value)
    example = f"={value}" if isinstance(value, (str, int, float)) else ""
    return f"it is called {KEYS[key]} now; write {KEYS[key]}{example}"


def gone_remedy(key: str) -> str | None:
    """What to do about a key that left, whose name ends as in the configuration; none for another."""
    key = ".".join(key.split(".")[-2:])
    return f"it is always {GONE[key]} now; leave it out, and train other weights anew" if key in GONE else None


def value_remedy(key: str, value: Any) -> str:
    """What to write instead of an old value; empty for a value that was not renamed."""
    new = current_value(key, value)
    return "" if new is value else f"{value} is called {new} now"


def _join(section: str, key: str) -> str:
    return f"{section}.{key}" if section else key
