"""Small trainings for the tests."""

import json

from hgn.schema import to_mapping

NETWORK = {"width": 8, "levels": 2, "message_passing_steps": 1}
TRAINING = {
    "maximum_updates": 12,
    "batch_scenes": 2,
    "learning_rate": 1e-3,
    "final_learning_rate": 1e-4,
    "device": "cpu",
    "log_every": 4,
    "checkpoint_every": 5,
    "monitor_every": 6,
    "monitor_rollout_frames": 0,
    "generate": False,
}


def train_mapping(config, run, **training):
    """Returns the mapping that Hydra would give to the command."""
    return to_mapping(config) | {
        "network": dict(NETWORK),
        "training": TRAINING | training,
        "run": str(run),
        "name": "test",
    }


def train_arguments(config, run, **training):
    """The same as overrides on the command line."""
    names = ("folder", "frames", "training_scenes", "validation_scenes", "test_scenes")
    dataset = {name: getattr(config.dataset, name) for name in names}
    sections = {"network": NETWORK, "training": TRAINING | training, "dataset": dataset}
    values = [f"{section}.{key}={value}" for section, keys in sections.items() for key, value in keys.items()]
    return [*values, f"run={run}"]


def metrics(run):
    """All logged records of a run."""
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
