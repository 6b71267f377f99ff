"""hgn.renamed: settings of earlier releases are answered with today's, and files of before load."""

import dataclasses
from dataclasses import replace
from importlib import import_module

import pytest

import hgn.config
from datagen.solve import SolveConfig
from hgn.config import DatagenConfig, MpmConfig, NetworkConfig, SceneConfig, TrainConfig
from hgn.data.identity import dataset_identity
from hgn.evaluate import EvaluateConfig
from hgn.export import ExportConfig
from hgn.network.build import build_network
from hgn.renamed import KEYS, REMOVED, REMOVED_CHOICES, Removed, current_names, removed_remedy, stored_names
from hgn.rollout import RolloutConfig
from hgn.runtime.weights import WeightsInfo, find_weights, load_weights, save_weights
from hgn.schema import ConfigError, from_mapping, from_stored, section_of, to_mapping

LAST = "commit a0b88cb, before release 0.2.0"
SECTIONS = (SceneConfig, MpmConfig, NetworkConfig)


@pytest.fixture
def removed(monkeypatch):
    """Settings that were removed, beside those that were."""
    monkeypatch.setitem(REMOVED, "network.depth", Removed(3, "train other weights"))
    monkeypatch.setitem(REMOVED, "network.colour", Removed())
    monkeypatch.setitem(REMOVED, "mpm.swirl", Removed(0.5))
    monkeypatch.setitem(REMOVED, "rollout.film", Removed(remedy="render with tools.render"))
    monkeypatch.setitem(REMOVED_CHOICES, "backend", {"abacus": "take backend=cpu"})


ALWAYS, NETWORK = "it was removed and is always {} now", "network.{} is not a known key; "
GIVEN = {EvaluateConfig: {"weights": "a", "data": "b"}, ExportConfig: {"checkpoint": "a", "out": "b"}}
GIVEN |= {SolveConfig: {"scene": "a"}}
ANSWERS = [
    (RolloutConfig, "path", "fast", "path is not a known key; it is called backend now; write backend=triton"),
    (EvaluateConfig, "path", "plain", "now; write backend=torch"),
    (TrainConfig, "training.path", "auto", "it is called training.backend now; write training.backend=auto"),
    (TrainConfig, "training.accelerator", "gpu", "is called training.device now; write training.device=cuda"),
    (TrainConfig, "path", "fast", "path is not a known key; known keys: scene, "),  # it never had this one
    (RolloutConfig, "backend", "fast", "backend must be one of .*, got 'fast'; fast is called triton now"),
    (RolloutConfig, "precision", "half", "precision must be one of .*, got 'half'; half is called fp16 now"),
    (TrainConfig, "training.precision", "highest", "training.precision must .*; highest is called fp32 now"),
    (ExportConfig, "half", True, "write stored_precision=fp16"),
    (TrainConfig, "network.depth", 4, f"{NETWORK.format('depth')}{ALWAYS.format(3)}, not 4; train other weights"),
    (TrainConfig, "network.contact_gate", "cell", f"{ALWAYS.format('cell')}; leave it out"),
    (TrainConfig, "network.rest_levels", 1, f"{ALWAYS.format(2)}, not 1; leave it out"),
    (TrainConfig, "network.maximum_neighbours", 64, f"{ALWAYS.format(None)}, not 64; leave it"),
    (TrainConfig, "network.static_spacing_cells", 1.0, "it was removed; leave it out; commit a0b88cb"),
    (TrainConfig, "network.kind", "gns_particles", f"network.kind must be .*, got 'gns_particles'; {LAST}"),
    (SolveConfig, "mpm.wall_contact", "stick", f"{ALWAYS.format('slip')}, not stick; leave it"),
    (TrainConfig, "mpm.time_step", "fixed", "it was removed; mpm.fixed_time_step_s is null for adaptive steps"),
    (TrainConfig, "mpm.sand_friction_law", "mohr_coulomb", "from mpm.method: mohr_coulomb with corrected, comp"),
    (RolloutConfig, "film", 3, "film is not a known key; it was removed; render with tools.render"),
    (RolloutConfig, "backend", "abacus", "backend must be one of .*, got 'abacus'; take backend=cpu"),
]


@pytest.mark.parametrize(("config", "key", "value", "message"), ANSWERS)
def test_old_names_are_answered(config, key, value, message, removed):
    """An old key, value or setting is refused in one line that says what replaces it."""
    for part in reversed(key.split(".")):
        value = {part: value}
    with pytest.raises(ConfigError, match=message) as caught:
        from_mapping(config, GIVEN.get(config, {}) | value)
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
    """They load where removed settings say what is always so now, or where these have no effect; others are refused by
    the setting's name. So is a kind of network, and weights that shipped once."""
    contacts = {"contact_gate": "cell", "contact_forces": "normal", "contact_reach_cells": 3.0}
    older = {"material_embedding": 16, "wall_distance_cells": 8.0}  # keys of 0.1.0
    rests = {"rest_levels": 2, "rest_large_materials": ["sand", "snow"]}
    relative, resting = NetworkConfig(inputs="relative"), {"rest_threshold": 0.1}
    gns = NetworkConfig(kind="gns", levels=1)
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
        (relative, older | contacts | rests | resting, None),
        (relative, older | contacts | rests | resting | {"rest_levels": 1}, "rest_levels"),
        (relative, older | contacts | rests | resting | {"rest_large_materials": None}, "rest_large_materials"),
        (relative, older | contacts | resting | {"rest_large_materials": ["sand", "snow"]}, "rest_levels"),
        (gns, {"maximum_neighbours": None, "static_spacing_cells": 0.25}, None),
        (gns, {"maximum_neighbours": 64}, "maximum_neighbours"),
    ):
        stored = to_mapping(config) | told
        if refused is None:
            assert from_stored(NetworkConfig, stored, "network") == config
            continue
        with pytest.raises(ConfigError, match=rf"network\.{refused} is not a known key; it was removed and is always"):
            from_stored(NetworkConfig, stored, "network")
    with pytest.raises(ConfigError, match=rf"network\.kind must be .*; {LAST}, is the last with it"):
        from_stored(NetworkConfig, to_mapping(gns) | {"kind": "gns_particles"}, "network")
    for name in REMOVED_CHOICES["weights"]:
        with pytest.raises(ConfigError, match=f"got '{name}'; {LAST}"):
            find_weights(name)


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
    removed = {key.removeprefix("mpm."): row.value for key, row in REMOVED.items() if key.startswith("mpm.")}
    assert stored.items() >= removed.items() and stored["swirl"] == 0.5
    assert from_stored(MpmConfig, stored, "mpm") == config.mpm


def test_the_table_is_sound():
    """What it calls removed is no setting, and what it renames to is one."""
    fields = {f"{section_of(cls)}.{name}" for cls in SECTIONS for name in to_mapping(cls())}
    assert not fields & (REMOVED.keys() | KEYS.keys())
    assert all(key in fields for key in KEYS.values() if key.startswith(("scene.", "mpm.", "network.")))


FIRST_RELEASE = {  # settings of 0.1.0
    "scene": """domain_size cell_size gravity obstacle_count obstacle_shapes obstacle_size group_count group_shapes
        group_size materials particles_per_cell clearance_cells maximum_initial_speed initial_speed_share
        lone_particles""",
    "mpm": """youngs_modulus_pa poisson_ratio density_kg_m3 sand_friction_angle_deg sand_friction_law
        sand_volume_correction snow_hardening snow_critical_compression snow_critical_stretch
        snow_maximum_hardening water_equation water_volume_update water_minimum_volume_ratio
        minimum_singular_value time_step fixed_time_step_s stability_fraction speed_fraction transfer_speed_m_s
        wall_cells wall_contact collider_band_cells collider_friction collider_projection device
        scenes_per_launch maximum_substeps_per_frame""",
    "dataset": """folder training_scenes validation_scenes test_scenes frames frame_rate_hz seed early_episodes
        episodes_per_shard workers maximum_attempts pool ray_address array_task array_tasks""",
    "service": "host port connections",
    "solve": "scene out frames frame_rate_hz mpm",
    "upload": "data to follow poll_s",
    "network": """kind cell_size levels message_passing_steps width velocity_history material_embedding
        wall_distance_cells obstacle_features materials maximum_neighbours static_spacing_cells""",
    "training": """maximum_updates maximum_minutes batch_scenes optimizer weight_decay learning_rate final_learning_rate
        warmup_updates weights ema_decay noise_std huber noise_smooth noise_at_rest grid_jitter frame_importance
        symmetry rollout_share rollout_every rollout_scenes rollout_frames rollout_pull seed accelerator devices
        nodes precision path minimum_episodes generate maximum_skipped_updates log_every checkpoint_every
        monitor_every monitor_scenes monitor_frame_stride monitor_rollout_frames monitor_particles_per_batch""",
    "train": "scene mpm dataset network training run",
    "export": "checkpoint out half",
    "average": "weights out shares half",
    "rollout": "weights out render scene seed data episode frames device path precision",
    "evaluate": """weights data split scenes frame_stride rollout_frames particles_per_batch device path precision
        json""",
    "render": "out rollout others names data episode frames gif every fps size",
}


@pytest.mark.parametrize("section", FIRST_RELEASE)
def test_settings_of_the_first_release_are_answered(section):
    """Each setting of release 0.1.0 is one of today, or was renamed to one of today, or the reason of its removal is
    given."""
    name, others = f"{section.title()}Config", {"render": "tools.render", "service": "datagen.service.__main__"}
    others |= {"solve": "datagen.solve", "upload": "datagen.upload"}
    cls = vars(hgn.config).get(name) or getattr(import_module(others.get(section, f"hgn.{section}")), name)
    fields = {field.name for field in dataclasses.fields(cls)}
    for key in FIRST_RELEASE[section].split():
        new = KEYS.get(f"{section}.{key}", KEYS.get(key, key)).rpartition(".")[2]
        assert key in fields or new in fields or removed_remedy(section, key, None), key
