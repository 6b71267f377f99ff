"""Training on an imported data set, which determines the settings that are null."""

from collections.abc import Mapping
from typing import Any

from hgn.config import NetworkConfig, TrainConfig, TrainingConfig
from hgn.data.manifest import Manifest, errors_in_config
from hgn.data.reader import EpisodeStore
from hgn.schema import require

FLAG = "+experiment=imported"


def settings_of_imported(mapping: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the composed settings with the imported set's values for those that +experiment=imported leaves null.

    `scene` and `dataset` become the set's. Noise and cells are the paper's, scaled by the set's radius.
    Raises: ConfigError for an imported set without that experiment, and for another set with it.
    """
    mapping = {key: dict(value) if isinstance(value, Mapping) else value for key, value in mapping.items()}
    folder, asked = mapping["dataset"]["folder"], bool(mapping.get("imported"))
    manifest = Manifest.load(folder) if EpisodeStore.available(folder) else None
    own = manifest.config.get("imported") if manifest is not None else None
    if own is None:
        remedy = "run it with from=FOLDER out=data/mine, and set dataset.folder=data/mine"
        require(not asked, "dataset.folder", "a data set of python -m hgn.import_trajectories", folder, remedy=remedy)
        return mapping
    rule = f"one of python -m datagen without {FLAG}"
    require(asked, "dataset.folder", rule, folder, remedy=f"it is imported; add {FLAG}, or use another folder")
    assert manifest is not None
    network, training = mapping["network"], mapping["training"]
    with errors_in_config(folder):
        left_open = {
            "cell_size": own["radius"],
            "dimensions": own["dimensions"],
            "materials": own["materials"],
            "obstacle_features": own["obstacles"],
            "velocity_history": own["history"],
        }
        network |= {key: value for key, value in left_open.items() if network.get(key) is None}
        if training.get("noise_std") is None:
            training["noise_std"] = TrainingConfig.noise_std * own["radius"] / NetworkConfig.cell_size
        training["generate"] = False
        splits = {"training_scenes": "train", "validation_scenes": "validation", "test_scenes": "test"}
        mapping["dataset"] |= {name: manifest.published(split) for name, split in splits.items()}
        mapping["dataset"] |= {"frame_rate_hz": manifest.config["frame_rate_hz"], "seed": manifest.config["seed"]}
        mapping["dataset"] |= {"frames": min(EpisodeStore(folder, "train").frames()), "long_fraction": 0.0}
        mapping["scene"] |= {
            "domain_size": own["domain_size"],
            "cell_size": own["obstacle_cell_size"],
            "gravity": own["gravity"],
            "tilted_gravity_fraction": float(own["several_gravities"]),
            "zero_gravity_fraction": 0.0,
            "obstacle_count": int(own["obstacles"]),
            "maximum_initial_speed": own["maximum_initial_speed"],
            "moving_group_fraction": 1.0,
            "pure_direction_fraction": 0.0,
            "colliding_scene_fraction": 0.0,
            "funnel_scene_fraction": 0.0,
        }
    return mapping


def require_network_fits(config: TrainConfig, manifest: Manifest) -> None:
    """Raises: ConfigError for a network that cannot be trained on this imported set."""
    own = manifest.config["imported"]
    require(
        config.network.dimensions == own["dimensions"],
        "network.dimensions",
        f"the data's {own['dimensions']}",
        config.network.dimensions,
    )
    if own["dimensions"] == 2:
        remedy = "import it again with radius=… for other cells"
        rule = f"the data's radius of {own['radius']:g}, from which the plane of its particles follows"
        require(
            config.network.cell_size == own["radius"],
            "network.cell_size",
            rule,
            config.network.cell_size,
            remedy=remedy,
        )
    unknown = [name for name in own["materials"] if name not in config.network.materials]
    require(not unknown, "network.materials", f"all of the data's {own['materials']}", list(config.network.materials))
