"""The rules of settings: what breaks one is refused in a line that says field, rule and value."""

import pytest

from hgn.average import AverageConfig
from hgn.config import DatasetConfig, NetworkConfig, SceneConfig, TrainConfig, TrainingConfig
from hgn.schema import ConfigError
from hgn.step_config import StepConfig

GNS = {"kind": "gns", "levels": 1}
RELATIVE = {"inputs": "relative"}


def train_on_six_frames(frames=6, **training):
    dataset = DatasetConfig(frames=frames)
    return TrainConfig(dataset=dataset, network=NetworkConfig(), training=TrainingConfig(**training))


def step_of(inputs="absolute", dimensions=3, **step):
    return TrainConfig(
        network=NetworkConfig(inputs=inputs, dimensions=dimensions), step=StepConfig(**step), imported=True
    )


def average_of(count, coefficients=None):
    return AverageConfig(("a.safetensors",) * count, "out.safetensors", coefficients)


RULES = {
    NetworkConfig: [
        ({"kind": "gnn"}, "kind must be one of hgn, gns, got 'gnn'"),
        ({"kind": "gns"}, "levels must be 1 for gns"),
        ({"inputs": "Relative"}, "inputs must be one of absolute, relative, got 'Relative'"),
        (RELATIVE | {"velocity_history": 1}, "velocity_history must be at least 2 with inputs=relative"),
        (GNS | RELATIVE, "inputs must be absolute for gns, got 'relative'"),
    ],
    StepConfig: [
        ({"rest_threshold": float("nan")}, "rest_threshold must be a finite number >= 0"),
        ({"rest_threshold": -0.1}, "rest_threshold must be a finite number >= 0, got -0.1"),
        ({"wall_clearance": (-0.1, 0.1)}, r"wall_clearance\[0\] must be a finite number >= 0, got -0.1"),
        ({"wall_clearance": (0.1, float("inf"))}, r"wall_clearance\[1\] must be a finite number >= 0, got inf"),
        ({"wall_clearance": (float("nan"), 0)}, r"wall_clearance\[0\] must be a finite number >= 0, got nan"),
        ({"obstacle_clearance": 0.0}, "obstacle_clearance must be a finite number > 0, got 0.0"),
        ({"obstacle_clearance": float("nan")}, "obstacle_clearance must be a finite number > 0, got nan"),
    ],
    step_of: [
        ({"rest_threshold": 0.3}, "step.rest_threshold must be 0 with inputs=absolute, got 0.3"),
        (RELATIVE | {"rest_threshold": 0.3, "dimensions": 2}, "step.rest_threshold must be 0 with dimensions=2"),
        ({"obstacle_clearance": 1e-3, "dimensions": 2}, "step.obstacle_clearance must be null with dimensions=2"),
    ],
    SceneConfig: [
        ({"obstacle_shapes": ("torus",)}, r"obstacle_shapes\[0\] must be one of half_box, .*, or a mesh file"),
        ({"pure_direction_fraction": 1.5}, "pure_direction_fraction must be .*, got 1.5"),
        ({"colliding_scene_fraction": -0.1}, "colliding_scene_fraction must be .*, got -0.1"),
        ({"funnel_hole": (0.1, 0.05)}, r"funnel_hole must be 0 < smallest <= largest, got \[0.1, 0.05\]"),
        (
            {"funnel_scene_fraction": 0.5, "obstacle_count": 3},
            "obstacle_count must be at least 4 where funnel_scene_fraction is above 0, got 3",
        ),
        ({"zero_gravity_fraction": float("nan")}, "zero_gravity_fraction must be .*, got nan"),
        (
            {"zero_gravity_fraction": 0.6, "tilted_gravity_fraction": 0.5},
            r"tilted_gravity_fraction must be at most 1 - zero_gravity_fraction \(0.6\), got 0.5",
        ),
        (
            {"colliding_scene_fraction": 0.1},
            "maximum_initial_speed must be above 0 where colliding_scene_fraction is, got 0.0",
        ),
    ],
    train_on_six_frames: [
        ({"symmetry": "square"}, "symmetry must be one of none, gravity, got 'square'"),
        ({"pushforward_fraction": 1.0}, "pushforward_fraction must be 0 or more and below 1, got 1.0"),
        ({"pushforward_pull": 1.5}, "pushforward_pull must be from 0 to 1, got 1.5"),
        ({"pushforward_every": 0}, "pushforward_every must be .*got 0"),
        (
            {"pushforward_fraction": 0.5, "frames": 2},
            "dataset.frames must be at least 3 where training.pushforward_fraction > 0, got 2",
        ),
    ],
    average_of: [
        ({"count": 1}, "weights must be at least two files, got 1"),
        ({"count": 2, "coefficients": (0.5, 0.3, 0.2)}, "coefficients must be one for each of the 2 files, got 3"),
        ({"count": 2, "coefficients": (0.7, 0.4)}, "coefficients must be 1 together, got 1.1"),
    ],
}


@pytest.mark.parametrize(
    ("settings", "options", "message"), [(settings, *rule) for settings, rules in RULES.items() for rule in rules]
)
def test_what_breaks_a_rule_is_named(settings, options, message):
    """Of networks, random scenes, trainings and averages: values alone, and values that contradict each other."""
    with pytest.raises(ConfigError, match=message):
        settings(**options)
