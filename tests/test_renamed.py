"""hgn.renamed: settings of earlier releases are answered with today's, and files of before load."""

from dataclasses import replace

import pytest

from hgn.config import DatagenConfig, MpmConfig, NetworkConfig, SceneConfig, TrainConfig
from hgn.data.identity import dataset_identity
from hgn.evaluate import EvaluateConfig
from hgn.export import ExportConfig
from hgn.network.build import build_network
from hgn.renamed import KEYS, REMOVED, REMOVED_CHOICES, Removed, current_names, stored_names
from hgn.rollout import RolloutConfig
from hgn.runtime.weights import WeightsInfo, load_weights, save_weights
from hgn.schema import ConfigError, from_mapping, from_stored, section_of, to_mapping

SECTIONS = (SceneConfig, MpmConfig, NetworkConfig)


@pytest.fixture
def removed(monkeypatch):
    """Settings that were removed, beside those that were."""
    monkeypatch.setitem(REMOVED, "network.depth", Removed(3, "train other weights"))
    monkeypatch.setitem(REMOVED, "network.colour", Removed())
    monkeypatch.setitem(REMOVED, "mpm.swirl", Removed(0.5))
    monkeypatch.setitem(REMOVED, "rollout.film", Removed(remedy="render with tools.render"))
    monkeypatch.setitem(REMOVED_CHOICES, "backend", {"abacus": "take backend=cpu"})


@pytest.mark.parametrize(
    ("config", "mapping", "message"),
    [
        (RolloutConfig, {"path": "fast"}, "path is not a known key; it is called backend now; write backend=triton"),
        (EvaluateConfig, {"weights": "a", "data": "b", "path": "plain"}, "now; write backend=torch"),
        (TrainConfig, {"training": {"path": "auto"}}, "it is called training.backend now; write training.backend=auto"),
        (TrainConfig, {"path": "fast"}, "path is not a known key; known keys: scene, "),  # it never had this one
        (RolloutConfig, {"backend": "fast"}, "backend must be one of .*, got 'fast'; fast is called triton now"),
        (RolloutConfig, {"precision": "half"}, "precision must be one of .*, got 'half'; half is called fp16 now"),
        (TrainConfig, {"training": {"precision": "highest"}}, "training.precision must .*; highest is called fp32 now"),
        (ExportConfig, {"checkpoint": "a", "out": "b", "half": True}, "write stored_precision=fp16"),
        (
            TrainConfig,
            {"network": {"depth": 4}},
            "network.depth is not a known key; it was removed and is always 3 now, not 4; train other weights",
        ),
        (TrainConfig, {"network": {"contact_gate": "cell"}}, "it was removed and is always cell now; leave it out"),
        (TrainConfig, {"network": {"rest_levels": 1}}, "it was removed and is always 2 now, not 1; leave it out"),
        (RolloutConfig, {"film": 3}, "film is not a known key; it was removed; render with tools.render"),
        (RolloutConfig, {"backend": "abacus"}, "backend must be one of .*, got 'abacus'; take backend=cpu"),
    ],
)
def test_old_names_are_answered(config, mapping, message, removed):
    """An old key, value or setting is refused in one line that says what replaces it."""
    with pytest.raises(ConfigError, match=message) as caught:
        from_mapping(config, mapping)
    assert "\n" not in str(caught.value)


def test_data_of_before_settings():
    """A data set from before a setting of the solver was made without what it sets, whatever new data have."""
    stored = to_mapping(MpmConfig(sand_friction_angle_deg=45.0))
    for key in ("time_integration", "water_density_relaxation_s", "sand_grain_diameter_m"):
        del stored[key]
    config = from_stored(MpmConfig, stored, "mpm")
    assert config.time_integration == "symplectic_euler"
    assert (config.water_density_relaxation_s, config.sand_grain_diameter_m) == (None, 0.0)
    assert config.sand_friction_angle_deg == 45.0
    assert from_stored(MpmConfig, to_mapping(MpmConfig()), "mpm") == MpmConfig()


def test_files_of_before(tmp_path, monkeypatch, removed):
    """Weights are read with the names that they were written with, and with settings that were removed since; another
    value of these is refused, unless any is as good."""
    monkeypatch.setitem(KEYS, "network.breadth", "network.width")
    config = NetworkConfig(width=8, levels=2)
    stored = to_mapping(config) | {"depth": 3, "colour": "red"}
    stored["breadth"] = stored.pop("width")
    network, info = build_network(config), WeightsInfo(config, 60.0, 1 / 64)
    monkeypatch.setattr("hgn.runtime.weights.to_mapping", lambda info: to_mapping(info) | {"network": stored})
    save_weights(tmp_path / "old.safetensors", network, info)
    assert b"breadth" in (tmp_path / "old.safetensors").read_bytes()
    assert load_weights(tmp_path / "old.safetensors")[1] == info
    stored["depth"] = 4
    save_weights(tmp_path / "other.safetensors", network, info)
    with pytest.raises(
        ConfigError, match=r"network\.depth is not a known key; it was removed and is always 3 now, not 4"
    ):
        load_weights(tmp_path / "other.safetensors")


def test_networks_of_before():
    """They load where removed settings say what is always so now, or where these have no effect; others are refused by
    the setting's name."""
    contacts = {"contact_gate": "cell", "contact_forces": "normal", "contact_reach_cells": 3.0}
    older = {"material_embedding": 16, "wall_distance_cells": 8.0}  # keys of 0.1.0
    rests = {"rest_levels": 2, "rest_large_materials": ["sand", "snow"]}
    relative, resting = NetworkConfig(inputs="relative"), NetworkConfig(inputs="relative", rest_threshold=0.1)
    for config, told, refused in (
        (NetworkConfig(), {}, None),
        (NetworkConfig(), older, None),
        (NetworkConfig(), older | {"contact_gate": "particle", "contact_reach_cells": 1.5, "rest_levels": 1}, None),
        (NetworkConfig(), older | {"wall_distance_cells": 6.0}, "wall_distance_cells"),
        (NetworkConfig(), older | {"material_embedding": 8}, "material_embedding"),
        (relative, {}, None),
        (relative, older | contacts | {"rest_levels": 3}, None),
        (relative, older | contacts | {"contact_forces": "any"}, "contact_forces"),
        (relative, older | contacts | {"contact_reach_cells": 2.0}, "contact_reach_cells"),
        (relative, older | {"contact_forces": "normal", "contact_reach_cells": 3.0}, "contact_gate"),  # younger
        (resting, older | contacts | rests, None),
        (resting, older | contacts | rests | {"rest_levels": 1}, "rest_levels"),
        (resting, older | contacts | rests | {"rest_large_materials": None}, "rest_large_materials"),
        (resting, older | contacts | {"rest_large_materials": ["sand", "snow"]}, "rest_levels"),
    ):
        stored = to_mapping(config) | told
        if refused is None:
            assert from_stored(NetworkConfig, stored, "network") == config
            continue
        with pytest.raises(ConfigError, match=rf"network\.{refused} is not a known key; it was removed and is always"):
            from_stored(NetworkConfig, stored, "network")


def test_identity_keeps_its_names(monkeypatch, removed):
    """A data set is identified by the keys that it was generated with, whatever they are called today or whether they
    are settings any more."""
    config = replace(DatagenConfig(), scene=SceneConfig(obstacle_count=3))
    before = dataset_identity(config)
    assert before["mpm"]["swirl"] == 0.5
    monkeypatch.setitem(KEYS, "scene.obstacles", "scene.obstacle_count")
    identity = dataset_identity(config)
    scene = identity["scene"]
    assert scene["obstacles"] == 3 and "obstacle_count" not in scene
    assert current_names(scene, "scene") == current_names(before["scene"], "scene")
    assert from_stored(SceneConfig, scene, "scene") == config.scene
    stored = stored_names(to_mapping(config.mpm), "mpm")
    assert stored == to_mapping(config.mpm) | {"swirl": 0.5} | {
        key.removeprefix("mpm."): row.value for key, row in REMOVED.items() if key.startswith("mpm.")
    }
    assert from_stored(MpmConfig, stored, "mpm") == config.mpm


def test_the_table_is_sound():
    """What it calls removed is no setting, and what it renames to is one."""
    fields = {f"{section_of(cls)}.{name}" for cls in SECTIONS for name in to_mapping(cls())}
    assert not fields & (REMOVED.keys() | KEYS.keys())
    assert all(key in fields for key in KEYS.values() if key.startswith(("scene.", "mpm.", "network.")))
