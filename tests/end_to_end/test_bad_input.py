"""Tests bad input to the commands: one line with the fault, a non-zero exit code, and no changed file."""

import json
import math
import os
import subprocess
from pathlib import Path

import pytest
from end_to_end.places import (
    EPISODE,
    EVALUATE,
    EXPORT,
    FRESH,
    OF_THE_RUN,
    ROLLOUT,
    ROOT,
    alter,
    check,
    content,
    refused,
    truncate,
)
from processes import PATIENCE_S, exit_code

from hgn import evaluate
from hgn.command import EXIT_INPUT, EXIT_MACHINE
from hgn.data.storage import TOKEN_VARIABLE
from hgn.runtime.simulator import Simulator
from hgn.scene.rollout_file import read_rollout

# command, arguments, message
OUT = "out=x.safetensors"
VALUES = [
    ("datagen", ["scenes=abc"], "dataset.training_scenes must be a whole number, got 'abc' (str)"),
    ("datagen", ["colour=1"], "colour is not a known key; known keys: "),
    ("datagen", ["+colour=1"], "colour is not a known key; known keys: scene, mpm, dataset, scenes, out,"),
    ("datagen", ["+dataset.colour=1"], "dataset.colour is not a known key; known keys: folder,"),
    ("datagen", ["scene=moon"], "got 'moon'; did you mean motion? --config-dir=DIR adds the files of DIR/scene"),
    ("datagen", ["scene=3"], "Config group override must be a string or a list. Got int"),
    ("datagen", ["progress=loud"], "progress must be one of bar, json, off, got 'loud'"),
    ("datagen", ["out=http://host/set", "pool=ray"], "pool is not a known key; it was removed; write dataset.pool"),
    (
        "service",
        ["out=http://host/set", "connections=5"],
        "connections is not a known key; it was removed and is alway",
    ),
    ("datagen", ["out=${nowhere}"], "Interpolation key 'nowhere' not found"),
    ("datagen", [*FRESH, "frozen=all"], "frozen must be a list of weights files"),
    ("datagen", [*FRESH, "dataset.seed=4"], "dataset.seed must be left out with frozen"),
    ("datagen", [*FRESH, "out=http://host/set"], "out must be a folder to write to"),
    ("service", ["port=70000"], "port must be 0 to 65535, got 70000"),
    ("service", ["host=0.0.0.0", "port=0"], "host must be a loopback address without a token, got '0.0.0.0'; set HGN_"),
    ("service", ["host=no.such.host.invalid"], "host and port must be available, got no.such.host.invalid:8000"),
    ("service", ["host=no..host"], "host and port must be available, got no..host:8000 ("),
    ("service", ["out=http://localhost:1"], "out must be a folder to write to, got 'http://localhost:1'"),
    ("service", ["out=data", "port=0", "dataset.seed=7"], "contains another data set: frames is 6 there"),
    ("solve", ["scene="], "scene must be a YAML file or the name of an example, got ''; examples: "),
    ("solve", ["scene=none.yaml"], "scene must be an existing YAML file, got none.yaml"),
    ("solve", ["scene=scene.yaml", "mpm.snow_hardning=5"], "mpm.snow_hardning is not a known key; did you mean snow_h"),
    ("upload", ["data=data", "to=data"], "to must be a URL, got"),
    ("upload", ["data=memory://there", "to=memory://here"], "data must be a local folder, got 'memory:"),
    ("upload", ["data=run", "to=memory://here"], "without manifest.json"),
    ("upload", ["data=data"], "to is missing"),
    ("train", ["training.batchsize=2"], "training.batchsize is not a known key; did you mean batch_scenes?"),
    ("train", ["network.obstacle_features=false"], "network.obstacle_features must be true for scenes with obst"),
    ("train", ["network.materials=[lava]"], "network.materials must be all of scene.materials, got ['lava']"),
    ("train", ["scene.tilted_gravity_fraction=0.1"], "network.inputs must be relative if scene.kinds are given, or"),
    (
        "train",
        ["+experiment=imported"],
        "import_trajectories, got 'data/imported'; run it with from=FOLDER out=data/min",
    ),
    ("train", ["training=[1]"], "settings must follow Hydra's syntax, got training=[1] (TypeError: "),
    *(
        (command, [f"~{key}"], f"error: {key.partition('=')[0]} must be kept, got '~{key}'; leave it out, or")
        for command, key in (
            *(("train", key) for key in ("dataset", "dataset.folder", "mpm", "network=hgn", "none")),
            *(("train", key) for key in ("training.seed", "training", "training.loggers.0", "hydra.job.name")),
            *((command, key) for command in ("datagen", "service") for key in ("dataset", "out", "network")),
            *(("rollout", "weights"), ("export", "checkpoint"), ("evaluate", "data"), ("render", "rollout")),
            *(("solve", "scene"), ("solve", "mpm"), ("upload", "to")),
        )
    ),
    ("train", ["+experiment=[]"], "experiment must be a file of conf/experiment, or several, got []; leave it out"),
    *(
        ("train", [f"{key}={value}"], f"{key} must be a file of conf/{key}, or several, got {value}; leave it out for")
        for key, value in (("scene", "[]"), ("scene", "null"), ("dataset", "null"))
    ),
    *(
        ("train", [f"{plus}experiment=obstacle"], "experiment must be a file of conf/experiment, got 'obstacle'; did y")
        for plus in ("", "+", "++")
    ),
    *(
        ("train", [f"{key}={name}"], f"{key} must be a file of conf/{key}, got '{name}'; did you mean {meant}?")
        for key, name, meant in (
            *(("scene", "obstacle", "obstacles"), ("dataset", "papr", "paper"), ("network", "hgnn", "hgn")),
            *(("mpm", "defaul", "default"), ("training", "recipes", "recipe")),
        )
    ),
    ("train", ["network.inputs=relativ"], "network.inputs must be one of absolute, relative, local, got 'relativ'; d"),
    ("train", ["training.init_weights=mechanic"], "own_physics), got 'mechanic'; did you mean mechanics?"),
    ("train", ["dataset.folder=hf:/datasets/a/b"], "dataset.folder must be a folder or a URL, got 'hf:/datasets/a/b'"),
    ("evaluate", [*EVALUATE, "data=hf//datasets/a/b"], "did you mean hf://datasets/a/b?"),
    ("evaluate", [*EVALUATE, "data=hf://dataset/a/b"], "must be of a repository of data sets, hf://datasets/USER/NAME"),
    ("evaluate", [*EVALUATE, "data=htpp://host/a"], "(Protocol not known: htpp); did you mean http?"),
    *(
        ("rollout", [*ROLLOUT, f"weights={name}"], "weights must be an address of the form hf://")
        for name in ("hf:/a/b", "hf:a/b", "hf//a/b", "hff://a/b")
    ),
    ("rollout", [*ROLLOUT, "weights=weight.safetensors"], "got weight.safetensors; did you mean weights.safetensors?"),
    ("export", ["checkpoint=none.ckpt", OUT], "checkpoint must be an existing file, got none.ckpt; hgn.train"),
    ("export", ["checkpoint=.", OUT], "checkpoint must be an existing file, got ., a folder; hgn.train writes"),
    ("export", ["checkpoint=run", OUT], "checkpoint must be an existing file, got run, a folder; use run/checkp"),
    ("export", ["checkpoint=run/checkpoints/bst.ckpt", OUT], "bst.ckpt; did you mean best.ckpt?"),
    ("export", ["checkpoint=none.ckpt", "out="], "out must be a file name, got ''"),
    ("export", ["checkpoint=none.ckpt", "out=a.onnx"], "out must be a .safetensors name, got 'a.onnx'; onnx="),
    ("export", ["out=x"], "checkpoint must be given, or weights instead, got None"),
    ("rollout", ["--frames", "3"], "--frames is not an option; settings are given as frames=VALUE"),
    ("bench", ["--json", "b.json"], "--json is not an option; settings are given as json=VALUE"),
    ("rollout", ["--weights=mechanics"], "--weights=mechanics is not an option; settings are given as weights=mec"),
    ("train", ["--resume"], "--resume is not an option; settings are given as KEY=VALUE; --help shows the keys"),
    ("rollout", ["scene.yaml"], "settings are given as KEY=VALUE, got 'scene.yaml'; --help shows the keys"),
    *(
        (command, [f"{key}={value}"], f"{key} must be a path of at most 4,095 bytes, 255 in each name, got '")
        for command, key in (("rollout", "scene"), ("rollout", "weights"), ("render", "rollout"), ("train", "run"))
        for value in (5000 * "a", 300 * "é", 2500 * "a/", f"[a,{256 * 'b'}]")
    ),
    (
        "train",
        [f"+experiment={5000 * 'a'}"],
        "experiment must be a path of at most 4,095 bytes, 255 in each name, got 'a",
    ),
    *(
        ("rollout", [*given, "seed=5"], "seed must be left out if scene or data is given, got 5; a scene file has i")
        for given in (["scene=scene.yaml"], ["data=data", "episode=validation-000000"])
    ),
    ("rollout", ["frame=3"], "frame is not a known key; did you mean frames?"),
    ("rollout", [*ROLLOUT, "scene=none.yaml"], "scene must be an existing YAML file, got none.yaml"),
    ("rollout", [*ROLLOUT, "scene=scene.yml"], "existing YAML file, got scene.yml; did you mean scene.yaml?"),
    ("rollout", ["out=a.png"], "must be a name that ends in .vtkhdf, .hdf, .hdf5, .h5, .usdc, .usda, .usd or .ply, go"),
    ("rollout", ["data=data", "episode=99"], "episode must begin with one of train, validation, test, got '99'; e.g. "),
    ("rollout", [*ROLLOUT, "weights=run"], "got run, a folder; write one with python -m hgn.export checkpoint=run/ch"),
    ("rollout", ["scene=scene"], "or the name of an example, got 'scene'; did you mean scene.yaml?"),
    ("rollout", ["scene=funnle"], "a YAML file or the name of an example, got 'funnle'; did you mean funnel?"),
    ("rollout", [*ROLLOUT, "device=abacus"], "device must be auto, cpu or cuda[:index], got 'abacus'"),
    ("rollout", [*ROLLOUT, "device=cuda:77"], "device must exist, got 'cuda:77' with"),
    ("rollout", [*ROLLOUT, "weights=none.safetensors"], "weights must be an existing file, got none.safetensors; wri"),
    ("rollout", [*ROLLOUT, f"weights={OF_THE_RUN[11:]}"], f"; python -m hgn.export {OF_THE_RUN} out=…"),
    ("evaluate", [*EVALUATE, "data=nowhere"], "manifest.json must be the manifest of a data set, got no such file;"),
    ("render", ["rollout=none.vtkhdf"], "rollout must be an existing file, got none.vtkhdf"),
    ("render", ["rollout=scene.yaml"], "scene.yaml: rollout must be a complete HDF5 file, got"),
    # a run is not resumed under another network, noise or data set
    ("train", ["network.width=16"], "network.width must be 8 to resume"),
    ("train", ["training.noise_std=0.01"], "training.noise_std must be 0.000848528 to resume"),
    (
        "train",
        ["dataset.frames=7"],
        "contains another data set: frames is 6 there, 7 is requested; choose another folder (d",
    ),
]


@pytest.mark.parametrize(("command", "arguments", "message"), VALUES)
def test_values(untouched, command, arguments, message, capsys, monkeypatch):
    """Unknown keys, wrong types, negative and NaN numbers, unknown materials, missing files and settings of another run
    are named."""
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    if "to resume" in message or (message.startswith("contains another") and command == "train"):
        arguments = untouched.train(*arguments)
    check(untouched, command, arguments, message, capsys, monkeypatch)


def of(method, *arguments, **options):
    """A fault: what a place does to its files."""
    return lambda place: getattr(place, method)(*arguments, **options)


def spoil(tensors):
    for tensor in tensors.values():
        tensor.fill_(math.nan)


MESH = of("edit_scene", "shape: cone, size: 0.3", "mesh: points.obj")
RANDOM = "random scene with the weights' obstacle_cell_size of "
STEPS = [*EVALUATE, "rollout_frames=0"]
CUT_RUN, OF_RUN = of("damage_run", truncate), [OF_THE_RUN, EXPORT[1]]
RATE, SNOW = of("weights", frame_rate_hz=30.0), of("weights", materials=("snow",))
RATES = "data frame_rate_hz must be the weights' 30.0, got 60.0; use a data set or weights of the same"
# command, arguments, fault, message
FILES = [
    ("rollout", ROLLOUT, of("edit_scene", "0.8, 0.5]", "0.45, 0.5]"), " inside obstacle_0_cone (particles: x 0.4"),
    ("rollout", ROLLOUT, MESH, "obstacles[0].mesh must"),
    ("evaluate", EVALUATE, of("damage", "validation", truncate), " bytes, got "),
    ("evaluate", EVALUATE, of("damage", "validation", alter), ": it was altered; use an intact copy, or delete it and"),
    ("evaluate", EVALUATE, of("damage", "validation", Path.unlink), " is listed in the index but missing; run the gen"),
    ("train", "other", of("damage", "train", truncate), " bytes, got "),
    ("train", "run", CUT_RUN, "checkpoint must be a complete checkpoint file, got"),
    ("export", OF_RUN, CUT_RUN, "checkpoint must be a complete checkpoint file, got"),
    (
        "export",
        EXPORT,
        of("checkpoint", dict.clear),
        "checkpoint must be a file of python -m hgn.train, got foreign.ckpt",
    ),
    ("export", EXPORT, of("network", wings=2), "got foreign.ckpt: network.wings is not a known key; "),
    ("export", EXPORT, of("network", width=16), "got foreign.ckpt: checkpoint tensor "),
    ("export", EXPORT, of("checkpoint", spoil, part="state_dict"), "must have finite numbers, each stored"),
    *(
        ("export", EXPORT, of("checkpoint", lambda ours, new=new: ours["data"].update(new)), f"data.{message}")
        for new, message in (
            ({"gravity": [0, 1e300, 0]}, "gravity[1] must be at most 1e15 in size, got 1e+300"),
            ({"own_ranges": {"friction": [2, 1]}}, "own_ranges.friction must be from -1e15 to 1e15, the smaller one f"),
        )
    ),
    *((*call, RATE, RATES) for call in (("rollout", EPISODE), ("evaluate", EVALUATE))),
    *(
        (*call, SNOW, "one of the training data's (snow), got ")
        for call in (("rollout", EPISODE), ("evaluate", EVALUATE))
    ),
    ("evaluate", STEPS, of("weights", gravity=(0.0, -1.6, 0.0)), "gravity must be the weights' (0.0, -1.6, 0.0)"),
    ("evaluate", STEPS, of("weights", obstacle_cell_size=1 / 32), "cell_size must be the weights' 0.03125, the siz"),
    *(
        (
            "rollout",
            ["weights=weights.safetensors"],
            of("weights", obstacle_cell_size=size),
            f"{RANDOM}{size:g}: cell_size must be {rule}",
        )
        for size, rule in ((1e9, "at most 0.1"), (0.2, "at most 0.1"), (1e-9, "at least 0.0"), (1e-3, "at least 0.0"))
    ),
]


@pytest.mark.parametrize(("command", "arguments", "fault", "message"), FILES)
def test_files(place, command, arguments, fault, message, capsys, monkeypatch):
    """Scenes that cannot be simulated, damaged shards and checkpoints, and weights of other data are refused; earlier
    outputs stay."""
    monkeypatch.setenv("HGN_PATIENCE_S", "1")
    place.path("points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    fault(place)
    check(place, command, place.train(run=arguments) if command == "train" else arguments, message, capsys, monkeypatch)


def test_diverging_weights(place, capsys, monkeypatch):
    """A rollout that diverges reports the frame, and leaves an earlier rollout as it was."""
    place.accelerate(5.0)
    place.path("earlier").mkdir()
    place.path("earlier/rollout.vtkhdf").write_bytes(b"an earlier hgn rollout")
    message = "weights must simulate without divergence, got weights.safetensors: the simulation diverged at frame 1:"
    check(place, "rollout", [*ROLLOUT, "out=earlier/rollout.vtkhdf"], message, capsys, monkeypatch)


def test_frames_before_a_divergence_are_written(place, capsys, monkeypatch):
    """A rollout that diverges at frame 3 ends as one at frame 1, but its file has the three frames before."""
    place.accelerate(0.3)
    code, line = refused("rollout", ROLLOUT[:-1], capsys, monkeypatch)
    assert code == EXIT_INPUT and "weights.safetensors: the simulation diverged at frame 3:" in line
    position_TN3 = read_rollout(place.path("made/rollout.vtkhdf")).position_TN3
    distance_T = (position_TN3 - position_TN3[0]).mean(axis=(1, 2))
    assert distance_T.tolist() == pytest.approx([0, 0.3, 0.9], abs=1e-2)


def test_diverging_scenes_are_told(place, capsys):
    """An evaluation keeps the results of every scene, and names the first one that diverged, with the cause."""
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
    ("command", "arguments", "message"),
    [
        ("rollout", [*ROLLOUT, "out=scene.yaml/rollout.vtkhdf"], "out must be another path, got 'scene.yaml/r"),
        ("rollout", [*ROLLOUT, "out=folder.vtkhdf"], "out must be another path, got 'folder.vtkhdf': Is a directory"),
        ("rollout", [*ROLLOUT, "out=closed/new/rollout.vtkhdf"], "Permission denied: "),
        ("rollout", [*ROLLOUT, "out=data"], "out must be a name that ends in"),
        ("rollout", [*ROLLOUT, f"out={'data' * 80}.vtkhdf"], "out must be a path of at most 4,095 bytes, 255 in each"),
        ("evaluate", [*EVALUATE, "json=scene.yaml/errors.json"], "json must be another path, got 'scene.yaml/e"),
        ("export", [OF_THE_RUN, "out=data"], "data"),
        ("train", ["run=scene.yaml"], "run must be another path, got 'scene.yaml'"),
    ],
)
def test_output_is_checked_before_the_work(place, command, arguments, message, capsys, monkeypatch):
    """A place that cannot be written to is named at the start, not after minutes of simulation; nothing is changed."""
    place.path("folder.vtkhdf").mkdir()
    place.path("closed").mkdir()
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "closed" and access(path, mode))
    monkeypatch.setattr(Simulator, "load", lambda *_: pytest.fail("the simulation began"))
    before = content(place.folder)
    code, line = refused(command, place.train(*arguments) if command == "train" else arguments, capsys, monkeypatch)
    assert code in (EXIT_INPUT, EXIT_MACHINE) and message in line, line
    assert content(place.folder) == before and not place.path("closed/new").exists()


def test_errors_file_makes_its_folder(place, monkeypatch):
    """The folder of json=… is made, as those of the other outputs are: an evaluation is not lost at its end."""
    assert exit_code(evaluate.main, "evaluate", EVALUATE, monkeypatch) == 0
    last = json.loads(place.path("made/errors.json").read_text())["rows"][-1]
    keys = {"episode", "frames", "cause", "penetration", "reference_penetration", "outside_domain"}
    assert last["by_material"].keys() <= {"water", "sand", "snow"} and last["ends"][0].keys() == keys


def test_as_a_process(place, warm_python):
    """Started as a person would, a command ends with exit code 2 and that one line on standard error alone."""
    place.damage("validation", truncate)
    before = content(place.folder)
    done = subprocess.run(
        [str(warm_python), "-m", "hgn.evaluate", *EVALUATE],
        env=os.environ | {"PYTHONPATH": str(ROOT), "HGN_PATIENCE_S": "1"},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode == EXIT_INPUT and done.stdout == "", done.stderr
    message = "error: data/validation-000000-000001.tar must have "
    assert done.stderr.startswith(message) and done.stderr.count("\n") == 1
    assert content(place.folder) == before
