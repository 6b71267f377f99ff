"""hgn.renamed: files of earlier releases load, or are refused with the setting that was removed."""

from dataclasses import replace

import pytest

from hgn.config import DatagenConfig, MpmConfig, NetworkConfig, SceneConfig, TrainConfig, TrainingConfig
from hgn.data.identity import dataset_identity
from hgn.network.build import build_network
from hgn.renamed import KEYS, REMOVED, Removed, current_names, stored_names
from hgn.runtime.weights import WeightsInfo, load_weights, save_weights
from hgn.schema import ConfigError, from_mapping, from_stored, section_of, to_mapping
from hgn.training.checkpoint import SECTION, Progress

SECTIONS = (SceneConfig, MpmConfig, NetworkConfig, TrainingConfig)


@pytest.fixture
def removed(monkeypatch):
    """Settings that were removed, beside those that were."""
    monkeypatch.setitem(REMOVED, "network.depth", Removed(3, "train other weights"))
    monkeypatch.setitem(REMOVED, "network.colour", Removed())
    monkeypatch.setitem(REMOVED, "mpm.swirl", Removed(0.5))


ALWAYS = "is not a known key; it was removed and is always"
ANSWERS = [
    ("network.depth", 4, f"network.depth {ALWAYS} 3 now, not 4; train other weights"),
    ("network.contact_gate", "cell", f"network.contact_gate {ALWAYS} cell now; leave it out"),
    ("training.noise_min_scale", 0.1, f"training.noise_min_scale {ALWAYS} 1.0 now, not 0.1; leave it out"),
    ("mpm.collider_friction", 0.25, f"mpm.collider_friction {ALWAYS} 0.0 now, not 0.25; write friction of each obst"),
    ("network.static_spacing_cells", 1.0, "it was removed; leave it out; commit a0b88cb"),
    ("mpm.time_step", "fixed", "it was removed; mpm.fixed_time_step_s is null for adaptive steps"),
    ("mpm.sand_friction_law", "mohr_coulomb", "from mpm.method: mohr_coulomb with corrected, comp"),
]


@pytest.mark.parametrize(("key", "value", "message"), ANSWERS)
def test_removed_settings_are_named(key, value, message, removed):
    """A removed setting is refused in one line with its fixed value, or with the setting that determines it."""
    section, _, name = key.partition(".")
    with pytest.raises(ConfigError, match=message) as caught:
        from_mapping(TrainConfig, {section: {name: value}})
    assert "\n" not in str(caught.value)


def test_settings_of_the_solver_in_data_sets():
    """A data set's settings of the solver are read as those of a method. Those of no method are refused by name, and so
    is a data set that is older than a setting."""
    for config in (
        MpmConfig(sand_friction_angle_deg=45.0),
        MpmConfig(method="taichi_elements", fixed_time_step_s=1e-3),
    ):
        stored = stored_names(to_mapping(config), "mpm")
        assert stored["time_step"] == ("adaptive" if config.fixed_time_step_s is None else "fixed")
        assert from_stored(MpmConfig, stored, "mpm") == config
    stored = stored_names(to_mapping(MpmConfig()), "mpm")
    for change in ({"sand_friction_law": "matsuoka_nakai"}, {"speed_fraction": 0.1}):
        with pytest.raises(ConfigError, match=r"mpm\.\w+ is not a known key; it was removed"):
            from_stored(MpmConfig, stored | change, "mpm")
    del stored["time_integration"]
    with pytest.raises(ConfigError, match="it was removed and follows from"):
        from_stored(MpmConfig, stored, "mpm")


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
    """They load where removed settings say what is always so now; others are refused by the setting's name."""
    contacts = {"contact_gate": "cell", "contact_forces": "normal", "contact_reach_cells": 3.0}
    older = {"material_embedding": 16, "wall_distance_cells": 8.0}  # keys of 0.1.0
    rests = {"rest_levels": 2, "rest_large_materials": ["sand", "snow"]}
    relative, resting = NetworkConfig(inputs="relative"), {"rest_threshold": 0.1}
    gns = NetworkConfig(kind="gns", levels=1)
    for config, told, refused in (
        (NetworkConfig(), {}, None),
        (NetworkConfig(), older, None),
        (NetworkConfig(), older | {"wall_distance_cells": 6.0}, "wall_distance_cells"),
        (NetworkConfig(), older | {"material_embedding": 8}, "material_embedding"),
        (relative, older | contacts | {"contact_forces": "any"}, "contact_forces"),
        (relative, older | contacts | {"contact_reach_cells": 2.0}, "contact_reach_cells"),
        (relative, older | contacts | rests | resting, None),
        (relative, older | contacts | rests | resting | {"rest_levels": 1}, "rest_levels"),
        (relative, older | contacts | rests | resting | {"rest_large_materials": None}, "rest_large_materials"),
        (gns, {"maximum_neighbours": None, "static_spacing_cells": 0.25}, None),
        (gns, {"maximum_neighbours": 64}, "maximum_neighbours"),
    ):
        stored = to_mapping(config) | told
        if refused is None:
            assert from_stored(NetworkConfig, stored, "network") == config
            continue
        with pytest.raises(ConfigError, match=rf"network\.{refused} is not a known key; it was removed and is always"):
            from_stored(NetworkConfig, stored, "network")


def test_identity_keeps_its_names(monkeypatch, removed):
    """The identity of a data set has the keys with which it was generated, whatever their present names, even if they
    are no settings any more."""
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
    removed = {key.removeprefix("mpm."): row.value for key, row in REMOVED.items() if key.startswith("mpm.")}
    assert stored.items() >= removed.items() and stored["swirl"] == 0.5
    assert from_stored(MpmConfig, stored, "mpm") == config.mpm


def test_the_table_is_sound():
    """No removed setting in the table is a present setting, and each new name is one."""
    fields = {f"{section_of(cls)}.{name}" for cls in SECTIONS for name in to_mapping(cls())}
    assert not fields & (REMOVED.keys() | KEYS.keys())
    assert all(key in fields for key in KEYS.values() if key.startswith(("scene.", "mpm.", "network.")))


def test_checkpoints_of_the_first_release():
    """They are refused with the release that exports them."""
    with pytest.raises(ConfigError, match=r"sampler_state must be given, .* release 0\.1\.0 with 0\.2\.0"):
        Progress.of({SECTION: {"updates": 3, "cursor": {"epoch": 1}}})
