"""What the runtime loads."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from network.states import network_of
from processes import PATIENCE_S

import hgn
from hgn.runtime.weights import WeightsInfo, save_weights
from hgn.system.extras import EXTRA_OF

ROOT = Path(__file__).resolve().parents[2]
TRAINING_STACK = (
    *("lightning", "pytorch_lightning", "hydra", "omegaconf", "taichi", "webdataset", "tensorboard", "matplotlib"),
    *("hgn.training", "hgn.data", "datagen", *EXTRA_OF),
)
PROGRAM = """
import json, sys
import hgn
assert not {"torch", "numpy"} & sys.modules.keys()
from hgn import Simulator, load_scene

(path,) = Simulator.load(sys.argv[1]).rollout([load_scene(sys.argv[2])], 3)
print(json.dumps({"shape": path.shape, "modules": sorted(sys.modules)}))
"""


def test_public_names():
    """What the package offers by name is what its modules have, told to type checkers too; another name is refused."""
    text = Path(hgn.__file__).read_text()
    for name in hgn.__all__:
        value = getattr(hgn, name)
        assert value.__name__ == name and f"from {value.__module__} import {name} as {name}\n" in text
    with pytest.raises(AttributeError, match="no attribute 'simulator'"):
        hgn.simulator  # noqa: B018


def test_simulating_loads_no_training_stack(tmp_path):
    """Loading weights and simulating a scene file imports none of Lightning, Hydra, Taichi, WebDataset, TensorBoard,
    no package of any extra, nor the project's own training, data and generator."""
    network = network_of(torch.float32)
    weights = tmp_path / "weights.safetensors"
    save_weights(weights, network, WeightsInfo(network.config, 60.0, 1 / 64))
    scene = tmp_path / "scene.yaml"
    scene.write_text("groups:\n  - {shape: cube, size: 0.05, position: [0.5, 0.5, 0.5], material: water}\n")
    process = subprocess.run(
        [sys.executable, "-W", "error", "-c", PROGRAM, str(weights), str(scene)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert process.returncode == 0, process.stderr
    report = json.loads(process.stdout)
    assert report["shape"][0] == 3 and report["shape"][1] > 100
    loaded = set(report["modules"])
    assert "hgn.runtime.simulator" in loaded
    assert [name for name in TRAINING_STACK if name in loaded] == []
