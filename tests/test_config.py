"""Tests the rules of settings: an error is one line with field, rule and value."""

import pytest

from datagen.solve import SolveConfig
from hgn.config import DatasetConfig, NetworkConfig, SceneConfig, TrainConfig, TrainingConfig
from hgn.evaluate import EvaluateConfig
from hgn.rollout import RolloutConfig
from hgn.schema import ConfigError, from_mapping
from hgn.step_config import StepConfig
from tools.bench.config import BenchConfig
from tools.curves import CurvesConfig
from tools.error_vs_time.settings import ErrorVsTimeConfig
from tools.render import RenderConfig
from tools.scaling.config import ScalingConfig
from tools.stability.network import StabilityNetworkConfig
from tools.stability.solver import StabilitySolverConfig

GNS = {"kind": "gns", "levels": 1}
RELATIVE = {"inputs": "relative"}


def train_on_six_frames(frames=6, **training):
    dataset = DatasetConfig(frames=frames)
    return TrainConfig(dataset=dataset, network=NetworkConfig(), training=TrainingConfig(**training))


def train_gns(**training):
    return TrainConfig(network=NetworkConfig(**GNS), training=TrainingConfig(**training))


def step_of(inputs="absolute", dimensions=3, **step):
    return TrainConfig(
        network=NetworkConfig(inputs=inputs, dimensions=dimensions), step=StepConfig(**step), imported=True
    )


def kinds_of(group_count=4, **kinds):
    return SceneConfig(kinds=kinds, group_count=group_count)


def command(cls, **given):
    """A command's options from a mapping, beside those that must be given."""
    return lambda **options: from_mapping(cls, given | options)


RULES = {
    NetworkConfig: [
        ({"kind": "gnn"}, "kind must be one of hgn, gns, got 'gnn'"),
        ({"kind": "gns"}, "levels must be 1 for gns"),
        ({"inputs": "Relative"}, "inputs must be one of absolute, relative, local, got 'Relative'"),
        (RELATIVE | {"velocity_history": 1}, "velocity_history must be at least 2 with inputs=relative"),
        (GNS | RELATIVE, "inputs must be absolute for gns, got 'relative'"),
    ],
    StepConfig: [
        ({"rest_threshold": float("nan")}, "rest_threshold must be a finite number >= 0"),
        ({"rest_threshold": -0.1}, "rest_threshold must be a finite number >= 0, got -0.1"),
        ({"wall_clearance": (-0.1, 0.1)}, r"wall_clearance\[0\] must be from 0 to 1e9, got -0.1"),
        ({"wall_clearance": (0.1, float("inf"))}, r"wall_clearance\[1\] must be from 0 to 1e9, got inf"),
        ({"wall_clearance": (float("nan"), 0)}, r"wall_clearance\[0\] must be from 0 to 1e9, got nan"),
        ({"obstacle_clearance": 0.0}, "obstacle_clearance must be a finite number > 0, got 0.0"),
        ({"obstacle_clearance": float("nan")}, "obstacle_clearance must be a finite number > 0, got nan"),
    ],
    train_gns: [({"cell_mean_weight": 2.0}, "training.cell_mean_weight must be 0 for gns, .*got 2.0")],
    step_of: [
        ({"inputs": "relative"}, "training.symmetry must be gravity with relative inputs .*, got 'none'"),
        ({"rest_threshold": 0.3}, "step.rest_threshold must be 0 with inputs=absolute, got 0.3"),
        (RELATIVE | {"rest_threshold": 0.3, "dimensions": 2}, "step.rest_threshold must be 0 with dimensions=2"),
        ({"obstacle_clearance": 1e-3, "dimensions": 2}, "step.obstacle_clearance must be null with dimensions=2"),
    ],
    command(SceneConfig): [
        ({"group_size": float("nan")}, "group_size must be a finite number > 0, got nan"),
        ({"materials": ["water", "lava"]}, r"materials\[1\] must be one of water, sand, snow, elastic, got"),
        ({"gravity": -9.8}, "gravity must be a list of 3 values, got -9.8; write it in brackets"),
    ],
    command(DatasetConfig): [({"frames": 1}, "frames must be at least 2, got 1")],
    command(SolveConfig, scene="s"): [
        ({"frames": 1}, "frames must be at least 2, got 1"),
        ({"out": "a.png"}, "out must be a name that ends in .vtkhdf, .hdf, .hdf5 or .h5, got 'a.png'"),
        ({"out": "a.usdc"}, "got 'a.usdc'; tools.render makes pictures, USD and PLY of a rollout"),
    ],
    command(RolloutConfig): [
        ({"frames": 1}, "frames must be at least 2, got 1"),
        ({"seed": -1}, "seed must be a finite number >= 0, got -1"),
        ({"data": "data"}, "data must be given together with episode, got 'data'; for example"),
        ({"scene": "funnel", "data": "d", "episode": "e"}, "scene must be left out if data is given, got 'funnel'"),
    ],
    command(EvaluateConfig, weights="w", data="d"): [
        ({"scenes": 0}, "scenes must be a finite number > 0, got 0"),
        ({"json": ""}, "json must be a file name, got ''"),
        ({"split": "moon"}, "split must be one of train, validation, test, got 'moon'"),
    ],
    command(TrainingConfig): [
        ({"learning_rate": -1.0}, "learning_rate must be a finite number > 0, got -1.0"),
        ({"noise_std": float("nan")}, "noise_std must be a finite number >= 0, got nan"),
    ],
    SceneConfig: [
        ({"obstacle_shapes": ("torus",)}, r"obstacle_shapes\[0\] must be one of half_box, .*, or a mesh file"),
        ({"pure_direction_fraction": 1.5}, "pure_direction_fraction must be .*, got 1.5"),
        ({"colliding_scene_fraction": -0.1}, "colliding_scene_fraction must be .*, got -0.1"),
        ({"funnel_hole": (0.1, 0.05)}, r"funnel_hole must be 0 < smallest <= largest, got \[0.1, 0.05\]"),
        ({"funnel_scene_fraction": 0.5, "obstacle_count": 3}, "obstacle_count must be at least 4 if .*, got 3"),
        ({"zero_gravity_fraction": float("nan")}, "zero_gravity_fraction must be .*, got nan"),
        ({"zero_gravity_fraction": 0.6, "tilted_gravity_fraction": 0.5}, r"must be at most 1 - .* \(0.6\), got 0.5"),
        ({"colliding_scene_fraction": 0.1}, "maximum_initial_speed must be above 0 if colliding_.* is, got 0.0"),
    ],
    kinds_of: [
        ({"lake": 1.0}, "kinds must be among obstacles, motion"),
        ({"pool": -1.0}, "kinds.pool must be a finite number >= 0, got -1.0"),
        ({"pool": 0.0}, "kinds must be numbers with at least one above 0"),
        ({"pool": 1.0, "group_count": 2}, r"group_count must be its default \(4\) if kinds"),
    ],
    train_on_six_frames: [
        ({"symmetry": "square"}, "symmetry must be one of none, gravity, got 'square'"),
        ({"pushforward_fraction": 1.0}, "pushforward_fraction must be 0 or more and below 1, got 1.0"),
        ({"pushforward_every": 0}, "pushforward_every must be .*got 0"),
        ({"pushforward_fraction": 0.5, "frames": 2}, "dataset.frames must be at least 3 if .*_fraction > 0, got 2"),
    ],
    command(BenchConfig): [
        ({"cases": ["frames"]}, r"cases\[0\] must be one of frame, torch_frame"),
        ({"particles": [0]}, r"particles\[0\] must be at least 1"),
        ({"precisions": ["fp8"]}, r"precisions\[0\] must be one of fp32, tf32, fp16"),
        ({"seconds": 0}, "seconds must be a finite number > 0"),
    ],
    command(CurvesConfig, out="curves"): [({"runs": ["a/x", "b/x"]}, "runs must be folders of different names")],
    command(ErrorVsTimeConfig, data="d", out="o"): [
        ({"mpm_grids": [4]}, r"mpm_grids\[0\] must be at least 8"),
        ({"weights": ["a/x.safetensors", "b/x.safetensors"]}, "weights must be files of different names"),
        ({"frames": 1}, "frames must be at least 2"),
        ({"precisions": ["fp8"]}, r"precisions\[0\] must be one of fp32, tf32, fp16"),
        ({"split": "all"}, "split must be one of train"),
    ],
    command(RenderConfig, rollout="r", out="o"): [
        ({"rollout": None}, "rollout must be a file, or else data and episode given"),
        ({"data": "folder"}, "rollout must be left out where data and episode are given"),
        ({"names": ["a", "b"]}, "names must be 1 different ones, of rollout and of each of the 0 others, got"),
        ({"every": 0}, "every must be at least 1"),
        ({"size": 10}, "size must be 64 to 4096 pixels"),
        ({"colour": "red"}, "colour is not a known key"),
    ],
    command(ScalingConfig): [
        ({"devices": 0}, "devices must be at least 1"),
        ({"device": "cuda:1"}, "device must be auto, cpu or cuda"),
        ({"batches": 0}, "batches must be at least 1"),
        ({"backends": ["slow"]}, r"backends\[0\] must be one of torch, triton"),
        ({"network": {"kind": "gns", "levels": 1}}, "network.kind must be hgn"),
    ],
    command(StabilityNetworkConfig, weights="w"): [
        ({"cases": ["wide"]}, r"cases\[0\] must be one of throw"),
        ({"frames": 1}, "frames must be at least 2"),
        ({"precision": "fp8"}, "precision must be one of auto, fp32, tf32, fp16"),
        ({"backend": "quick"}, "backend must be one of auto, torch, triton, cpu"),
    ],
    command(StabilitySolverConfig): [({"cases": ["stesp"]}, r"cases\[0\] must be one of steps")],
}


@pytest.mark.parametrize(
    ("settings", "options", "message"), [(settings, *rule) for settings, rules in RULES.items() for rule in rules]
)
def test_what_breaks_a_rule_is_named(settings, options, message):
    """Errors name single values, and values that contradict each other, in settings and in options of commands."""
    with pytest.raises(ConfigError, match=message):
        settings(**options)
