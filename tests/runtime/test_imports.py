"""What the runtime and commands load."""

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
# for writing PLY, graphs, and compiled or exported networks
OTHER_JOBS = ("trimesh", "networkx", "scipy.optimize", "torch._dynamo", "torch.onnx")
PROGRAM = """
import gc, importlib.util, json, sys, warnings
import hgn
assert not {"torch", "numpy"} & sys.modules.keys()
from hgn.rollout import RolloutConfig, rollout

def note(*_):
    if "torch" in sys.modules and sys.modules["torch"].__spec__._initializing:
        searches.append(len(sys.modules))

searches = []
gc.callbacks.append(note)
weights, scene = sys.argv[1:]
rollout(RolloutConfig(weights=weights, scene=scene, frames=3, out="path.vtkhdf"))
assert not searches and gc.isenabled(), f"{len(searches)} searches for garbage in PyTorch's modules"

from hgn import Simulator, load_scene

(path,) = Simulator.load(weights).rollout([load_scene(scene)], 3)
modules = sorted(sys.modules)
if importlib.util.find_spec("viser"):
    warnings.simplefilter("ignore")
    import hgn.viewer.page
print(json.dumps({"shape": path.shape, "modules": modules, "of_page": sorted(sys.modules)}))
"""


def test_public_names():
    """The package's public names are those of its modules, also for type checkers. Another name is refused."""
    text = Path(hgn.__file__).read_text()
    for name in hgn.__all__:
        value = getattr(hgn, name)
        assert value.__name__ == name and f"from {value.__module__} import {name} as {name}\n" in text
    with pytest.raises(AttributeError, match="no attribute 'simulator'"):
        hgn.simulator  # noqa: B018


def test_simulating_loads_no_training_stack(tmp_path):
    """Loading weights and simulating a scene file with a mesh, by the API and by hgn.rollout, imports no Lightning,
    Hydra, Taichi, WebDataset or TensorBoard, no package of an extra, and no module of training, data, the generator or
    other commands. A page of hgn.play imports no package that only other jobs need either."""
    network = network_of(torch.float32)
    weights = tmp_path / "weights.safetensors"
    save_weights(weights, network, WeightsInfo(network.config, 60.0, 1 / 64))
    scene = tmp_path / "scene.yaml"
    (tmp_path / "floor.obj").write_text("v 0 0 0\nv 0 0 1\nv 1 0 1\nv 1 0 0\nf 1 2 3 4\n")
    scene.write_text(
        "obstacles:\n  - {mesh: floor.obj, scale: 0.2, position: [0.4, 0.3, 0.4]}\n"
        "groups:\n  - {shape: cube, size: 0.05, position: [0.5, 0.5, 0.5], material: water}\n"
    )
    report = json.loads(printed_by(PROGRAM, str(weights), str(scene), folder=tmp_path))
    assert report["shape"][0] == 3 and report["shape"][1] > 100
    loaded = set(report["modules"])
    assert "hgn.runtime.simulator" in loaded
    assert [name for name in (*TRAINING_STACK, *OTHER_JOBS) if name in loaded] == []
    assert [name for name in OTHER_JOBS if name in report["of_page"]] == []


def test_lightning_without_metrics(tmp_path):
    """A training imports Lightning without torchmetrics, SciPy and Matplotlib, in whose place nothing stays."""
    program = "import sys; from hgn.training.monitor import Monitor; print(sorted(sys.modules))"
    loaded = printed_by(program, folder=tmp_path)
    assert "'lightning.pytorch'" in loaded
    assert [name for name in ("torchmetrics", "scipy.signal", "matplotlib") if f"'{name}'" in loaded] == []


def test_workers(tmp_path):
    """A solver of datagen imports no package that only other jobs need."""
    pytest.importorskip("taichi")
    program = "import sys, warnings; warnings.simplefilter('ignore'); import datagen.mpm.solver; print({*sys.modules})"
    loaded = printed_by(program, folder=tmp_path)
    assert [name for name in ("scipy", "urllib3", "torch") if f"'{name}'" in loaded] == []


def printed_by(program, *arguments, folder):
    """What a program prints that ends well, without warnings."""
    process = subprocess.run(
        [sys.executable, "-W", "error", "-c", program, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert process.returncode == 0, process.stderr
    return process.stdout
