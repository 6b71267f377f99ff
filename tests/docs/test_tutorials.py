"""Every block of the README, of getting started and of the tutorials runs as it stands, with small settings.

Pages that are notebooks run in test_notebooks.py.
"""

import gc
import shutil
import signal
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from ballistic_dataset import make_dataset
from ballistic_solver import FOLDER_VARIABLE
from composition import compose
from docs.pages import ROOT, Runner, blocks_of, shell_lines
from hydra import initialize_config_dir
from omegaconf import OmegaConf
from processes import PATIENCE_S, free_port

from datagen.generate import datagen_config
from hgn.data.reader import EpisodeStore
from hgn.scene.scene_file import load_scene

TUTORIALS = ROOT / "docs" / "tutorials"
# a data set, made once for all pages, of which every training here is told
SCENE = ("obstacle_count=1", "obstacle_shapes=[rock.obj]", "obstacle_size=[0.2,0.2]", "group_count=1")
SCENE += ("group_size=0.04", "materials=[water]", "lone_particles=0")
DATASET = ("training_scenes=2", "validation_scenes=1", "test_scenes=0", "frames=6", "folder=data/mine")
SCENES = [*(f"scene.{value}" for value in SCENE), *(f"dataset.{value}" for value in DATASET)]
TRAINING = ["network.width=8", "network.levels=2", "network.message_passing_steps=1"]
UPDATES = ("maximum_updates=4", "batch_scenes=1", "precision=tf32", "log_every=1", "checkpoint_every=2")
UPDATES += ("monitor_every=2", "monitor_rollout_frames=0", "device=cpu")
TRAINING += [f"training.{value}" for value in UPDATES]
SETTINGS = {
    "datagen.solve": ["frames=2"],
    "hgn.rollout": ["frames=2", "device=cpu", "render=false"],
    "hgn.evaluate": ["rollout_frames=0", "device=cpu"],
    "hgn.train": [*SCENES, *TRAINING],
    "tools.render": ["size=64"],
}
ONE_UPDATE = ["training.maximum_updates=1", "training.monitor_every=2"]
INSTALLS = dict.fromkeys(
    (". .venv/bin/activate", "pip install PATH_OF_THE_CHECKOUT", "pip install PATH_OF_THIS_FOLDER"),
    "tests/end_to_end/test_wheel.py",
)


def lines_of(page):
    """The commands of a page's shell blocks."""
    return [line for block in blocks_of(page) if block.language == "bash" for line in shell_lines(block)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a mesh and a data set of three scenes that the stand-in for the solver made."""
    path = tmp_path_factory.mktemp("tutorials")
    (mesh,) = [block for block in blocks_of(TUTORIALS / "train.md") if block.file == "rock.obj"]
    (path / "rock.obj").write_text(mesh.content)
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"), pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        patch.setenv(FOLDER_VARIABLE, str(path))
        config = compose(ROOT / "conf", "datagen", ["+experiment=obstacles", *SCENES])
        make_dataset(datagen_config(OmegaConf.to_container(config, resolve=True)))
    return path


@pytest.fixture
def here(folder, monkeypatch):
    """The same folder, as the current one."""
    monkeypatch.chdir(folder)
    return folder


def test_readme(here):
    """README: a random scene, the main job, the program; what a tutorial runs word for word is not run twice."""
    scene = dict.fromkeys(lines_of(TUTORIALS / "scene.md"), "tutorials/scene.md")
    runner = Runner(SETTINGS, {"frames=300": "frames=2"}, INSTALLS | scene)
    runner.run(ROOT / "README.md")
    assert len(runner.names["position_TN3"]) == 2
    assert (here / "rollout/random_13.vtkhdf").is_file() and set(scene) <= set(runner.ran)


def test_getting_started(here):
    """Getting started: what is installed, a first simulation, help."""
    Runner(SETTINGS, elsewhere=INSTALLS).run(ROOT / "docs" / "getting_started.md")


def test_scene(here):
    """A scene of one's own: network and solver simulate it, pictures and the distance between them."""
    runner = Runner(SETTINGS)
    runner.run(TUTORIALS / "scene.md")
    distance_TN = runner.names["distance_TN"]
    assert len(distance_TN) == 2 and not distance_TN[0].any() and np.isfinite(distance_TN).all()
    assert list((here / "pictures").glob("*.png"))


def test_live(here):
    """Many live scenes: each ends after two frames and begins anew, with its own number of particles. A plate that is
    moved pushes sand."""
    fewer = {"range(300)": "range(3)", "episode_frames=120": "episode_frames=2", "range(1, 21)": "range(1, 4)"}
    runner = Runner(SETTINGS, fewer)
    runner.run(ROOT / "docs/how_to/live.md")
    names = runner.names
    assert np.shares_memory(names["shared_N3"], names["position_N3"].numpy())
    assert names["glasses"].age_S.tolist() == [1] * 4 and bool(torch.isfinite(names["reward_S"]).all())
    assert len(names["glasses"].live.state.scene_N.bincount().unique()) > 1


@pytest.mark.slow
def test_gradients(here):
    """Gradients through a simulation: the examples, with few frames and one step."""
    fewer = {f"scene, {frames}, ": "scene, 2, " for frames in (10, 21)}
    fewer |= {"range(10)": "range(1)", ", 26, poses": ", 8, poses", "starts, 60)": "starts, 2)"}
    runner = Runner(SETTINGS, fewer | {"range(-60, 61, 4)": "range(-60, 61, 120)"})
    runner.run(ROOT / "docs/how_to/gradients.md")
    assert runner.names["velocity_3"].shape == (3,) and runner.names["angles"] == [20.0]


def test_serve(here, monkeypatch):
    """A data set served over HTTP with a token, and two trainings that read it."""
    port = free_port()
    address = f"http://127.0.0.1:{port}"
    for name, value in {"DATASET": address, "HGN_DATASET_TOKEN": "", "HGN_CACHE": str(here / "cache")}.items():
        monkeypatch.setenv(name, value)
    served = [*SETTINGS["hgn.train"], *ONE_UPDATE, f"dataset.folder={address}", "run=runs/served"]
    service = [*SCENES[:-1], "out=data/mine", "host=127.0.0.1", f"port={port}", "progress=json"]
    settings = SETTINGS | {"datagen.service": service, "hgn.train": served}
    proxy = "tests/jobs/test_nginx.py runs nginx with jobs/nginx.conf"
    lines = (TUTORIALS / "serve.md").read_text().splitlines()
    elsewhere = {line: proxy for line in lines if line.startswith(("export SERVER_NAME", "envsubst", "nginx"))}
    runner = Runner(settings, elsewhere=elsewhere, setenv=monkeypatch.setenv)
    try:
        runner.run(TUTORIALS / "serve.md")
    finally:
        for process in runner.background:
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=PATIENCE_S)
    assert len(list((here / "cache").rglob("*.tar"))) == len(list((here / "data/mine").glob("*.tar")))


def test_network(here):
    """The network: built, looked into, changed by settings and by a subclass with gradients."""
    runner = Runner(SETTINGS)
    runner.run(TUTORIALS / "network.md")
    parameters = f"`{runner.names['network'].parameter_count:,} parameters"
    assert parameters in (TUTORIALS / "network.md").read_text()
    assert (runner.names["changed"].speed.weight.grad != 0).any()


def test_how_to(here, capsys):
    """How-to pages: the check of a data set's shards, which sees a flipped bit, and the scene file's example. The loop
    of data.md reads all training episodes."""
    (loop,) = [block for block in blocks_of(ROOT / "docs/concepts/data.md") if "webdataset" in block.content]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # WebDataset does not close shards
        exec(loop.content.replace("data/obstacles", "data/mine"), {})
        gc.collect()
    assert capsys.readouterr().out.splitlines() == [
        f"{episode.key} {episode.position_TN3.shape} {[*episode.gravity]}"
        for episode in EpisodeStore("data/mine", "train")
    ]
    (check,) = [block for block in blocks_of(ROOT / "docs/how_to/verify_shards.md") if block.language == "python"]
    code = check.content.replace("data/obstacles", "data/mine")
    exec(code, {})
    shutil.copytree("data/mine", "data/damaged")
    shard = sorted(Path("data/damaged").glob("train-*.tar"))[0]
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    with pytest.raises(AssertionError, match=shard.name):
        exec(code.replace("data/mine", "data/damaged"), {})
    (example,) = [block for block in blocks_of(ROOT / "docs/how_to/scene_files.md") if block.language == "yaml"]
    Path("funnel.yaml").write_text(example.content)
    assert len(load_scene("funnel.yaml").obstacles) == 5
