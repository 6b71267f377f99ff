"""Folders for commands that are refused."""

import shutil

import pytest
from end_to_end.places import SCENE, Place

from hgn import export


@pytest.fixture(scope="session")
def original(small_dataset, finished_once, tmp_path_factory):
    """What all tests begin with."""
    folder = tmp_path_factory.mktemp("original")
    shutil.copytree(small_dataset, folder / "data")
    shutil.copytree(finished_once[1], folder / "run")
    export.export(folder / "run" / "checkpoints" / "last.ckpt", folder / "weights.safetensors")
    (folder / "scene.yaml").write_text(SCENE)
    return folder


@pytest.fixture
def untouched(original, make_config, monkeypatch):
    """The original itself, for commands that leave it as it is."""
    monkeypatch.chdir(original)
    return Place(original, make_config(folder=str(original / "data")))


@pytest.fixture
def place(original, make_config, tmp_path, monkeypatch):
    shutil.copytree(original, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return Place(tmp_path, make_config())
