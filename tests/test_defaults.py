"""Tests the composed settings of all commands: dataclasses define the defaults once, and experiments contain only
differences.
"""

import inspect
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from hgn import play
from hgn.command import _compose
from hgn.command_help import help_lines
from hgn.config import DEFAULT_WEIGHTS, TrainingConfig, config_directory
from hgn.runtime.simulator import Simulator
from hgn.runtime.weights import shipped_weights
from hgn.schema import ConfigError, field_comments

# of train every key, of the other command lines those with other values
RESOLVED = yaml.safe_load((Path(__file__).parent / "resolved.yaml").read_text())


def flat(mapping, path=""):
    result: dict[str, Any] = {}
    for key, value in mapping.items():
        result |= flat(value, f"{path}{key}.") if isinstance(value, Mapping) else {f"{path}{key}": value}
    return result


@pytest.mark.parametrize("line", RESOLVED)
def test_resolved(line, monkeypatch):
    """Each experiment composes to the stored values; a key that is younger than they has its default."""
    command, *arguments = line.split()
    monkeypatch.setattr("sys.argv", [command, *arguments])
    (composed,) = _compose(command)
    values = flat(composed)
    expected = {key: value for key, value in RESOLVED["train"].items() if key in values} | RESOLVED[line]
    assert {key: values.get(key) for key in expected} == expected


def test_no_value_is_typed_twice():
    """A group's or command's file does not repeat what the files and the dataclass that it begins with say."""
    for folder in ("scene", "mpm", "dataset", "network", "training", "command"):
        for file in (config_directory() / folder).glob("*.yaml"):
            own = yaml.safe_load(file.read_text()) or {}
            base = beginning(file)
            repeated = [key for key, value in own.items() if key in base and base[key] == value]
            assert not repeated, f"{folder}/{file.name}: {repeated}"


def beginning(file):
    """What a file's `defaults` give before its own keys."""
    from hgn.hydra_compat import dataclass_of
    from hgn.schema import default_mapping

    cls = dataclass_of(file)
    values = default_mapping(cls) if cls else {}
    for name in (yaml.safe_load(file.read_text()) or {}).get("defaults", []):
        other = file.with_name(f"{name}.yaml")
        if other.is_file():
            values |= beginning(other) | (yaml.safe_load(other.read_text()) or {})
    return values


def test_all_take_the_same_weights():
    """Where nothing is said, a program and each command that simulates with one network take `mechanics`."""
    assert DEFAULT_WEIGHTS == "mechanics" and DEFAULT_WEIGHTS in shipped_weights()
    values = {}
    for file in sorted((config_directory() / "command").glob("*.yaml")):
        weights = (beginning(file) | yaml.safe_load(file.read_text())).get("weights")
        if isinstance(weights, str) and weights != "???":
            values[file.stem] = weights
    values["Simulator.load"] = inspect.signature(Simulator.load).parameters["weights"].default
    names = ("evaluate", "play", "rollout", "stability_network", "Simulator.load")
    assert values == dict.fromkeys(names, DEFAULT_WEIGHTS)


@pytest.mark.parametrize(("scene", "message"), [("funel", "did you mean funnel"), ("my.yaml", "existing YAML file")])
def test_play_answers_a_mistyped_scene_before_it_loads_weights(monkeypatch, scene, message):
    """A wrong scene name is refused before PyTorch and the weights are loaded, which takes long on a busy machine."""
    monkeypatch.setitem(sys.modules, "hgn.runtime.simulator", None)
    with pytest.raises(ConfigError, match=message):
        play.play_page(play.PlayConfig(scene=scene))


def test_help_shows_comments(monkeypatch):
    """Each key of the training has its value and the dataclass's own comment beside it."""
    monkeypatch.setattr("sys.argv", ["train", "training.batch_scenes=3"])
    (composed,) = _compose("train")
    lines = list(help_lines(composed, config_directory(), "train"))
    assert "  batch_scenes: 3 # frames of random scenes in one update, on each device" in lines
    for name, comment in field_comments(TrainingConfig).items():
        assert any(line.startswith(f"  {name}: ") and line.endswith(comment) for line in lines), name
    assert any(line.startswith("# +experiment=demo or gns") for line in lines)
