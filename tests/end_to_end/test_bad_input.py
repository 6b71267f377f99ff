"""Bad input to the commands: one line that says what is wrong, a non-zero exit code, and nothing touched."""

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from network.states import network_of
from processes import PATIENCE_S, exit_code
from training.runs import train_arguments, train_mapping

import datagen.__main__
from hgn import evaluate, export, rollout, train
from hgn.command import EXIT_INPUT, EXIT_MACHINE
from hgn.config import DatagenConfig
from hgn.runtime.simulator import Simulator
from hgn.runtime.weights import WeightsInfo, load_weights, save_weights
from tools import render

ROOT = Path(__file__).resolve().parents[2]
COMMANDS: dict[str, Callable[[dict[str, Any]], int]] = {
    "datagen": datagen.__main__.main,
    "train": train.main,
    "export": export.main,
    "rollout": rollout.main,
    "evaluate": evaluate.main,
    "render": render.main,
}
SCENE = """
obstacles:
  - {shape: cone, size: 0.3, position: [0.5, 0.4, 0.5]}
groups:
  - {shape: cube, size: 0.05, position: [0.5, 0.8, 0.5], material: water}
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@dataclass
class Place:
    """A folder with a data set, a finished run, its weights and a scene file; all paths are relative to it."""

    folder: Path
    config: DatagenConfig

    def path(self, name):
        return self.folder / name

    def shard(self, split):
        return sorted(self.path("data").glob(f"{split}-*.tar"))[0]

    def scene(self, text):
        self.path("scene.yaml").write_text(text)

    def accelerate(self, by):
        """Puts weights in the place of those that throw all particles out of the domain."""
        network = network_of(torch.float32)
        network.normaliser.set("acceleration", torch.full((3,), by), torch.ones(3), 0.0)
        save_weights(self.path("weights.safetensors"), network, WeightsInfo(network.config, 60.0, 1 / 64))

    def train(self, *arguments, run="run"):
        return ["+experiment=obstacles", *train_arguments(self.config, self.path(run)), *arguments]


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """Where the first test keeps what all begin with."""
    return tmp_path_factory.mktemp("original") / "place"


@pytest.fixture
def place(original, make_config, make_dataset, tmp_path, monkeypatch):
    config = make_config()
    made = Place(tmp_path, config)
    if original.exists():
        shutil.copytree(original, tmp_path, dirs_exist_ok=True)
    else:
        make_dataset(config)
        assert train.main(train_mapping(config, tmp_path / "run", maximum_updates=2, monitor_rollout_frames=0)) == 0
        export.export(tmp_path / "run" / "checkpoints" / "last.ckpt", tmp_path / "weights.safetensors")
        shutil.copytree(tmp_path, original)
    made.scene(SCENE)
    monkeypatch.chdir(tmp_path)
    yield made


def content(folder):
    """Every file below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(command, arguments, capsys, monkeypatch):
    """Runs a command as its module would; returns the exit code and the one error line."""
    capsys.readouterr()
    code = exit_code(COMMANDS[command], command, arguments, monkeypatch)
    lines = capsys.readouterr().err.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    # a progress bar may have begun; after the error there is nothing
    assert errors == lines[-1:] and "Traceback" not in "".join(lines), lines
    return code, errors[0]


def check(place, command, arguments, message, capsys, patch):
    """The command is refused with that message and leaves every file as it was; no half-written one is left."""
    before = content(place.folder)
    code, line = refused(command, arguments, capsys, patch)
    assert code == EXIT_INPUT and message in line, line
    after = content(place.folder)
    assert {name: after.get(name) for name in before} == before
    assert not [name for name in after if name.endswith(".partial")]


ROLLOUT = ["weights=weights.safetensors", "scene=scene.yaml", "out=made/rollout.vtkhdf", "frames=3"]
EVALUATE = ["weights=weights.safetensors", "data=data", "rollout_frames=3", "json=made/errors.json"]


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("datagen", ["dataset.frames=-3"], "dataset.frames must be at least 2, got -3"),
        ("datagen", ["scene.group_size=nan"], "scene.group_size must be a finite number > 0, got nan"),
        (
            "datagen",
            ["scene.materials=[water,lava]"],
            "scene.materials[1] must be one of water, sand, snow, elastic, got 'lava'",
        ),
        ("train", ["+training.batchsize=2"], "training.batchsize is not a known key; did you mean batch_scenes?"),
        ("train", ["training.batchsize=2"], "training.batchsize is not a known key; did you mean batch_scenes?"),
        ("train", ["training.maximum_updates=many"], "training.maximum_updates must be a whole number, got 'many'"),
        ("train", ["training.learning_rate=-1"], "training.learning_rate must be a finite number > 0, got -1.0"),
        ("train", ["training.noise_std=nan"], "training.noise_std must be a finite number >= 0, got nan"),
        ("train", ["network.obstacle_features=false"], "network.obstacle_features must be true for scenes with obst"),
        ("train", ["network.materials=[lava]"], "network.materials must be all of scene.materials, got ['lava']"),
        (
            "train",
            ["scene.tilted_gravity_fraction=0.1"],
            "network.inputs must be relative where scene.zero_gravity_fraction or scene.tilted_gravity_fraction",
        ),
        ("train", ["+experiment=moon"], "Could not find 'experiment/moon'"),
        ("export", ["checkpoint=none.ckpt", "out=x"], "checkpoint must be an existing file, got none.ckpt; hgn.train"),
        ("export", ["checkpoint=none.ckpt", "out="], "out must be a file name, got ''"),
        ("export", ["out=x"], "checkpoint must be given, or else weights, got None"),
        ("rollout", [*ROLLOUT, "frames=1"], "frames must be at least 2, got 1"),
        ("rollout", ["--frames", "3"], "--frames is not an option; settings are given as frames=VALUE"),
        ("rollout", ["--weights=obstacles"], "--weights=obstacles is not an option; settings are given as weights=obs"),
        ("rollout", ["scene.yaml"], "settings are given as KEY=VALUE, got 'scene.yaml'; --help shows the keys"),
        ("rollout", ["frame=3"], "frame is not a known key; did you mean frames?"),
        ("rollout", [*ROLLOUT, "scene=none.yaml"], "scene must be an existing YAML file, got none.yaml"),
        ("rollout", [*ROLLOUT, "data=data"], "data must be given together with episode, got 'data'; for example"),
        ("rollout", [*ROLLOUT, "device=abacus"], "device must be auto, cpu or cuda[:index], got 'abacus'"),
        ("rollout", [*ROLLOUT, "device=cuda:77"], "device must exist, got 'cuda:77' with"),
        (
            "rollout",
            [*ROLLOUT, "weights=none.safetensors"],
            "weights must be an existing file, got none.safetensors; write one",
        ),
        (
            "rollout",
            [*ROLLOUT, "weights=run/checkpoints/last.ckpt"],
            "; python -m hgn.export checkpoint=run/checkpoints/last.ckpt out=…",
        ),
        ("evaluate", [*EVALUATE, "scenes=0"], "scenes must be a finite number > 0, got 0"),
        ("evaluate", [*EVALUATE, "json="], "json must be a file name, got ''"),
        ("evaluate", [*EVALUATE, "split=moon"], "split must be one of train, validation, test, got 'moon'"),
        (
            "evaluate",
            [*EVALUATE, "data=nowhere"],
            "manifest.json must be the manifest of a data set, got no such file;",
        ),
        ("render", ["rollout=none.vtkhdf"], "rollout must be an existing file, got none.vtkhdf"),
        ("render", ["rollout=scene.yaml"], "scene.yaml: rollout must be a complete HDF5 file, got"),
    ],
)
def test_values(place, command, arguments, message, capsys, monkeypatch):
    """Unknown keys, wrong types, negative and NaN numbers, unknown materials and missing files are named."""
    check(place, command, arguments, message, capsys, monkeypatch)
    assert not place.path("made").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SCENE.replace("[0.5, 0.8, 0.5]", "[0.5, 0.45, 0.5]"), "particles inside obstacle_0_cone; move or shrink the"),
        (SCENE.replace("size: 0.05", "size: large"), "groups[0].size must be"),
        (SCENE.replace("material: water", "materials: water"), "groups[0].materials is not a known key; did you mean"),
        (SCENE.replace("shape: cone, size: 0.3", "mesh: empty.obj"), "obstacles[0].mesh must"),
        (SCENE.replace("shape: cone, size: 0.3", "mesh: points.obj"), "obstacles[0].mesh must"),
        (SCENE.replace("shape: cone, size: 0.3", "mesh: scene.yaml"), "obstacles[0].mesh must end in one of .stl, "),
        (
            SCENE.replace("shape: cone, size: 0.3", "mesh: solid.obj").replace("[0.5, 0.4, 0.5]", "[0.4, 0.7, 0.4]"),
            "particles inside solid; move or shrink the group or the obstacle",
        ),
    ],
)
def test_scenes(place, text, message, capsys, monkeypatch):
    """A scene file that cannot be simulated is refused with the entry that is wrong in it, meshes included; every other
    rule of scene files is in tests/scene/test_scene_file.py."""
    place.path("empty.obj").write_text("")
    place.path("points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    place.path("solid.obj").write_text(TETRAHEDRON)
    place.scene(text)
    check(place, "rollout", ROLLOUT, message, capsys, monkeypatch)
    assert not place.path("made").exists()


def truncate(path):
    path.write_bytes(path.read_bytes()[:-700])


def alter(path):
    data = bytearray(path.read_bytes())
    data[700] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("command", ["train", "evaluate"])
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (truncate, " bytes, got "),
        (alter, ": it was altered; delete it and run the generator again"),
        (Path.unlink, " is listed in the index but missing; run the generator again"),
    ],
    ids=["truncated", "altered", "missing"],
)
def test_damaged_shards(place, command, damage, message, capsys, monkeypatch):
    """Training and evaluation stop at a damaged shard and name it; a cut tar is never read as fewer episodes."""
    split = "train" if command == "train" else "validation"
    for shard in place.path("data").glob(f"{split}-*.tar"):
        damage(shard)
    arguments = place.train(run="other") if command == "train" else EVALUATE
    check(place, command, arguments, message, capsys, monkeypatch)
    assert not place.path("other/checkpoints").exists() and not place.path("made").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["network.width=16"], "network.width must be 8 to resume"),
        (["network.materials=[snow,sand,water]"], "network.materials must be ['water', 'sand', 'snow'] to resume"),
        (["training.noise_std=0.01"], "training.noise_std must be 0.000848528 to resume"),
        (["dataset.frames=7"], "holds another data set: frames is 6 there, 7 is asked for"),
    ],
)
def test_checkpoint_of_another_configuration(place, arguments, message, capsys, monkeypatch):
    """A run is not gone on with under another network, noise or data set."""
    check(place, "train", place.train(*arguments), message, capsys, monkeypatch)


@pytest.mark.parametrize("command", ["train", "export"])
def test_damaged_checkpoint(place, command, capsys, monkeypatch):
    """A cut checkpoint is named; weights that were exported earlier stay."""
    truncate(place.path("run/checkpoints/last.ckpt"))
    export_again = ["checkpoint=run/checkpoints/last.ckpt", "out=weights.safetensors"]
    arguments = place.train() if command == "train" else export_again
    check(place, command, arguments, "checkpoint must be a whole checkpoint file, got", capsys, monkeypatch)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda ours: ours.clear(), "checkpoint must be one of python -m hgn.train, got foreign.ckpt"),
        (lambda ours: ours["network"].update(wings=2), "got foreign.ckpt: network.wings is not a known key; "),
        (lambda ours: ours["network"].update(width=16), "got foreign.ckpt: size mismatch for "),
    ],
)
def test_checkpoint_of_another_project(place, change, message, capsys, monkeypatch):
    """A file of torch.save that is no checkpoint of ours is refused; so is one whose network is another's."""
    checkpoint = torch.load(place.path("run/checkpoints/last.ckpt"), weights_only=True)
    change(checkpoint["hgn"])
    torch.save(checkpoint if checkpoint["hgn"] else {"state_dict": {}}, place.path("foreign.ckpt"))
    check(place, "export", ["checkpoint=foreign.ckpt", "out=weights.safetensors"], message, capsys, monkeypatch)


@pytest.mark.parametrize(("command", "arguments"), [("rollout", ROLLOUT), ("evaluate", EVALUATE)])
@pytest.mark.parametrize("case", ["frame rate", "material"])
def test_weights(place, command, arguments, case, capsys, monkeypatch):
    """Weights of another frame rate or other materials than what they are used on are refused."""
    path = place.path("weights.safetensors")
    if case == "frame rate":
        network, info = load_weights(path)
        save_weights(path, network, WeightsInfo(info.network, 30.0, 1 / 64))
        message = "data frame_rate_hz must be the weights' 30.0, got 60.0; take a data set or weights of the same"
        if command == "rollout":
            arguments = [*ROLLOUT, "scene=null", "data=data", "episode=validation-000000"]
    else:
        network = network_of(torch.float32, materials=("snow",))
        save_weights(path, network, WeightsInfo(network.config, 60.0, 1 / 64))
        message = "material must be one of the network's (snow), got "
    check(place, command, arguments, message, capsys, monkeypatch)
    assert not place.path("made").exists()


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"gravity": (0.0, -1.6, 0.0)}, "gravity must be the weights' (0.0, -1.6, 0.0), which a network of absolute"),
        ({"obstacle_cell_size": 1 / 32}, "cell_size must be the weights' 0.03125, the size of the cells"),
    ],
)
def test_data_of_other_weights(place, info, message, capsys, monkeypatch):
    """Data that weights cannot be rolled out on are refused before their one-step errors are measured."""
    path = place.path("weights.safetensors")
    network, own = load_weights(path)
    save_weights(path, network, replace(own, **info))
    check(place, "evaluate", [*EVALUATE, "rollout_frames=0"], message, capsys, monkeypatch)
    assert not place.path("made").exists()


def test_diverging_weights(place, capsys, monkeypatch):
    """A rollout that flies apart says at which frame, and leaves an earlier rollout as it was."""
    place.accelerate(5.0)
    place.path("made").mkdir()
    place.path("made/rollout.vtkhdf").write_bytes(b"an earlier one")
    message = "weights must keep the simulation together, got weights.safetensors: the simulation diverged at frame 1:"
    check(place, "rollout", ROLLOUT, message, capsys, monkeypatch)


def test_diverging_scenes_are_told(place, capsys):
    """An evaluation keeps what each scene came to, and says which one diverged first, and why."""
    place.accelerate(0.4)
    options = {"weights": "weights.safetensors", "data": "data", "json": "made/errors.json"}
    assert evaluate.main(options) == 0
    row = json.loads(place.path("made/errors.json").read_text())["rows"][-1]
    assert row["ends"] and all("diverged" in end["cause"] and end["frames"] < 8 for end in row["ends"])
    assert row["position_mse"] == {} and set(row["scenes_reached"].values()) == {0}
    told = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("diverged"))
    count = len(row["ends"])
    assert f"{count} of {count} scenes, first {row['ends'][0]['episode']} at frame" in told


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("rollout", [*ROLLOUT, "out=scene.yaml/rollout.vtkhdf"]),
        ("rollout", [*ROLLOUT, "out=data"]),
        ("rollout", [*ROLLOUT, f"out={'data' * 80}.vtkhdf"]),
        ("evaluate", [*EVALUATE, "json=scene.yaml/errors.json"]),
        ("export", ["checkpoint=run/checkpoints/last.ckpt", "out=data"]),
        ("train", ["run=scene.yaml"]),
    ],
)
def test_output_that_is_in_the_way(place, command, arguments, capsys, monkeypatch):
    """An output path that leads through a file, is a folder where a file is to be, or too long a name, is named."""
    before = content(place.folder)
    if command == "train":
        arguments = place.train(*arguments)
    code, line = refused(command, arguments, capsys, monkeypatch)
    assert code in (EXIT_INPUT, EXIT_MACHINE) and ("scene.yaml" in line or "data" in line)
    assert content(place.folder) == before


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("rollout", [*ROLLOUT, "out=scene.yaml/rollout.vtkhdf"], "Not a directory: "),
        ("rollout", [*ROLLOUT, "out=folder.vtkhdf"], "Is a directory: folder.vtkhdf"),
        ("rollout", [*ROLLOUT, "out=closed/new/rollout.vtkhdf"], "Permission denied: "),
        ("evaluate", [*EVALUATE, "json=scene.yaml/errors.json"], "Not a directory: "),
    ],
)
def test_output_is_looked_at_before_the_work(place, command, arguments, message, capsys, monkeypatch):
    """Minutes of simulation do not end at a place that cannot be written to: it is named at the start."""
    place.path("folder.vtkhdf").mkdir()
    place.path("closed").mkdir()
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "closed" and access(path, mode))
    monkeypatch.setattr(Simulator, "load", lambda *_: pytest.fail("the simulation began"))
    code, line = refused(command, arguments, capsys, monkeypatch)
    assert code == EXIT_MACHINE and message in line
    assert not place.path("closed/new").exists()


def test_errors_file_makes_its_folder(place, monkeypatch):
    """The folder of json=… is made, as those of the other outputs are: an evaluation is not lost at its end."""
    assert exit_code(evaluate.main, "evaluate", EVALUATE, monkeypatch) == 0
    last = json.loads(place.path("made/errors.json").read_text())["rows"][-1]
    keys = {"episode", "frames", "cause", "penetration", "reference_penetration", "outside_domain"}
    assert last["by_material"].keys() <= {"water", "sand", "snow"} and last["ends"][0].keys() == keys


@pytest.mark.parametrize(
    ("module", "arguments", "message"),
    [
        (
            "hgn.train",
            ["+training.colour=red"],
            "error: training.colour is not a known key; known keys: maximum_updates,",
        ),
        (
            "hgn.rollout",
            ROLLOUT,
            "error: scene.yaml: groups[0] (cube of water) must be clear of closed obstacles, got ",
        ),
        ("hgn.evaluate", EVALUATE, "error: data/validation-000000-000001.tar must have "),
    ],
)
def test_as_processes(place, warm_python, module, arguments, message):
    """Started as a person would, each command ends with exit code 2 and that one line on standard error alone."""
    place.scene(SCENE.replace("[0.5, 0.8, 0.5]", "[0.5, 0.45, 0.5]"))
    for shard in place.path("data").glob("validation-*.tar"):
        truncate(shard)
    before = content(place.folder)
    done = subprocess.run(
        [str(warm_python), "-m", module, *arguments],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode == EXIT_INPUT and done.stdout == "", done.stderr
    assert done.stderr.startswith(message) and done.stderr.count("\n") == 1
    assert content(place.folder) == before
