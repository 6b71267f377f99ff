"""hgn.renamed: old names are answered with today's, and files of before load."""

from dataclasses import replace

import pytest

from hgn.config import DatagenConfig, MpmConfig, NetworkConfig, SceneConfig, TrainConfig
from hgn.data.identity import dataset_identity
from hgn.evaluate import EvaluateConfig
from hgn.export import ExportConfig
from hgn.network.build import build_network
from hgn.renamed import KEYS, current_names, stored_names
from hgn.rollout import RolloutConfig
from hgn.runtime.weights import WeightsInfo, load_weights, save_weights
from hgn.schema import ConfigError, from_mapping, from_stored, to_mapping


@pytest.mark.parametrize(
    ("config", "mapping", "message"),
    [
        (RolloutConfig, {"path": "fast"}, "path is not a known key; it is called backend now; write backend=triton"),
        (
            EvaluateConfig,
            {"weights": "a", "data": "b"} | {"path": "plain"},
            "it is called backend now; write backend=torch",
        ),
        (TrainConfig, {"training": {"path": "auto"}}, "it is called training.backend now; write training.backend=auto"),
        (TrainConfig, {"path": "fast"}, "path is not a known key; known keys: scene, "),
        (RolloutConfig, {"backend": "fast"}, "backend must be one of .*, got 'fast'; fast is called triton now"),
        (RolloutConfig, {"precision": "half"}, "precision must be one of .*, got 'half'; half is called fp16 now"),
        (TrainConfig, {"training": {"precision": "highest"}}, "training.precision must .*; highest is called fp32 now"),
        (ExportConfig, {"checkpoint": "a", "out": "b", "half": True}, "write stored_precision=fp16"),
        (
            TrainConfig,
            {"network": {"momentum": "linear"}},
            "network.momentum is not a known key; it is always angular now; leave it out, and train other weights anew",
        ),
        (TrainConfig, {"network": {"obstacle_distances": True}}, "it is always False now; leave it out"),
    ],
)
def test_old_names_are_answered(config, mapping, message):
    """An old key or value is refused in one line that says what it is called now; where a command never had it, it is
    an unknown key."""
    with pytest.raises(ConfigError, match=message) as caught:
        from_mapping(config, mapping)
    assert "\n" not in str(caught.value)


def test_data_of_before_settings():
    """A data set from before a setting of the solver was made without what it sets, whatever new data have."""
    stored = to_mapping(MpmConfig(sand_friction_angle_deg=45.0))
    for key in ("transfer_speed_m_s", "time_integration", "water_density_relaxation_s", "sand_grain_diameter_m"):
        del stored[key]
    config = from_stored(MpmConfig, stored, "mpm")
    assert (config.transfer_speed_m_s, config.time_integration) == (None, "symplectic_euler")
    assert (config.water_density_relaxation_s, config.sand_grain_diameter_m) == (None, 0.0)
    assert config.sand_friction_angle_deg == 45.0
    assert from_stored(MpmConfig, to_mapping(MpmConfig()), "mpm") == MpmConfig()


def test_files_of_before(tmp_path, monkeypatch):
    """A stored section is read with the names that it was written with; of weights, too."""
    monkeypatch.setitem(KEYS, "network.breadth", "network.width")
    config = NetworkConfig(width=8, levels=2)
    stored = to_mapping(config)
    stored["breadth"] = stored.pop("width")
    assert from_stored(NetworkConfig, stored, "network") == config
    network = build_network(config)
    info = WeightsInfo(config, 60.0, 1 / 64)
    save_weights(tmp_path / "new.safetensors", network, info)
    monkeypatch.setattr("hgn.runtime.weights.to_mapping", lambda info: to_mapping(info) | {"network": stored})
    save_weights(tmp_path / "old.safetensors", network, info)
    assert b"breadth" in (tmp_path / "old.safetensors").read_bytes()
    for name in ("new", "old"):
        assert load_weights(tmp_path / f"{name}.safetensors")[1] == info


def test_files_with_settings_that_left():
    """They load where a setting said what is always so now, or nothing to a network of absolute inputs; others are
    refused by its name."""
    for inputs, told, loads in (
        ("absolute", {"momentum": "linear"}, True),
        ("relative", {}, True),
        ("relative", {"momentum": "angular"}, True),
        ("relative", {"momentum": "linear"}, False),
        ("absolute", {"obstacle_distances": False}, True),
        ("relative", {"obstacle_distances": False}, True),
        ("relative", {"obstacle_distances": True}, False),
    ):
        stored = to_mapping(NetworkConfig(inputs=inputs)) | told
        if loads:
            assert from_stored(NetworkConfig, stored, "network") == NetworkConfig(inputs=inputs)
            continue
        (name,) = told
        with pytest.raises(ConfigError, match=rf"network\.{name} is not a known key; it is always .* now"):
            from_stored(NetworkConfig, stored, "network")


def test_identity_keeps_its_names(monkeypatch):
    """A data set is identified by the keys that it was generated with, whatever they are called today."""
    config = replace(DatagenConfig(), scene=SceneConfig(obstacle_count=3))
    before = dataset_identity(config)
    monkeypatch.setitem(KEYS, "scene.obstacles", "scene.obstacle_count")
    scene = dataset_identity(config)["scene"]
    assert scene["obstacles"] == 3 and "obstacle_count" not in scene
    assert current_names(scene, "scene") == current_names(before["scene"], "scene")
    assert from_stored(SceneConfig, scene, "scene") == config.scene
    assert stored_names(to_mapping(config.mpm), "mpm") == to_mapping(config.mpm)
