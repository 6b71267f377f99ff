"""Tests extras: if a package is missing, the error names the extra that installs it."""

import importlib
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from processes import PATIENCE_S

from datagen.pool.worker import error_message
from hgn.schema import ConfigError
from hgn.system.extras import EXTRA_OF, missing_extra

ROOT = Path(__file__).resolve().parents[2]
# what is listed in an extra
BROUGHT_BY = {"google_crc32c": "google-crc32c", "lightning_utilities": "lightning"}
BROUGHT_BY |= {"aiohttp": "fsspec", "pxr": "usd-core"}


def test_each_package_is_in_the_extra_that_is_named():
    """pyproject.toml and the errors agree."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for package, extra in EXTRA_OF.items():
        listed = {re.split(r"[^\w-]", requirement)[0] for requirement in extras[extra]}
        assert BROUGHT_BY.get(package, package) in listed, package


def test_a_package_of_no_extra_is_no_such_error():
    """A module that is missing for another reason is a fault, not a missing extra."""
    assert missing_extra(ModuleNotFoundError(name="hgn.nothing")) is None
    assert error_message(ModuleNotFoundError(name="hgn.nothing"))[0] == "error"


def test_a_worker_names_the_extra_that_it_lacks(monkeypatch):
    """Generating without the solver's package ends in one line too; where there is none, it says for which Pythons."""
    error = ModuleNotFoundError(name="taichi.lang")
    told = "this needs taichi, which is not installed; pip install 'hgn[datagen]'"
    assert error_message(error) == ("config_error", told)
    monkeypatch.setattr("sys.version_info", (3, 13))
    assert "published only for Python 3.11 and 3.12" in error_message(error)[1]


FOREIGN = {"bounds": [[0, 1]] * 3, "sequence_length": 10, "default_connectivity_radius": 0.035, "dim": 3, "dt": 0.01}


@pytest.mark.parametrize(
    ("package", "module", "settings"),
    [
        ("viser", "hgn.play", {}),
        ("pxr", "hgn.rollout", {"out": "water.usdc"}),
        ("pysplashsurf", "hgn.rollout", {"out": "water.ply", "surface": True}),
        ("onnxscript", "hgn.export", {"weights": "obstacles_small", "onnx": "step.onnx"}),
        ("google_crc32c", "hgn.import_trajectories", {"from": "../foreign", "out": "mine"}),
        ("huggingface_hub", "hgn.rollout", {"weights": "hf://name/weights"}),
        ("s3fs", "hgn.evaluate", {"weights": "obstacles_small", "data": "s3://bucket/set"}),
    ],
)
def test_what_is_optional_names_its_extra(tmp_path, monkeypatch, package, module, settings):
    """Before anything is written, in the words of `missing_extra`."""
    foreign, here = tmp_path / "foreign", tmp_path / "here"
    foreign.mkdir()
    here.mkdir()
    (foreign / "train.tfrecord").write_bytes(bytes(16))
    (foreign / "metadata.json").write_text(json.dumps(FOREIGN))
    monkeypatch.chdir(here)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises((ModuleNotFoundError, ConfigError)) as caught:
        importlib.import_module(module).main(settings)
    told = str(caught.value)
    if isinstance(caught.value, ModuleNotFoundError):
        told = str(missing_extra(caught.value))
    assert f"pip install 'hgn[{EXTRA_OF[package]}]'" in told
    assert list(here.iterdir()) == []


PROGRAM = """
import importlib, sys
from hgn.command import run_command
sys.modules.update(dict.fromkeys({packages!r}))
for module, config, *arguments in {commands!r}:
    sys.argv = [module, *arguments]
    try:
        run_command(importlib.import_module(module).main, config)
    except SystemExit as end:
        print(end.code, file=sys.stderr)
"""


def test_missing_extra_is_named(tmp_path, warm_python):
    """Commands without the package that they cannot do without: one line, exit code 1, and no work before it."""
    packages = ("taichi", "lightning", "starlette")
    commands = (
        ("datagen.solve", "solve", "scene=funnel", "frames=2", "out=solved.vtkhdf"),
        ("hgn.train", "train", "+experiment=demo"),
        ("datagen.service.__main__", "service", "+experiment=demo", "port=0", "progress=off"),
    )
    (tmp_path / "program.py").write_text(PROGRAM.format(packages=packages, commands=commands))
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [warm_python, tmp_path / "program.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)
    line = "error: this needs {}, which is not installed; pip install 'hgn[{}]'"
    lines = [line.format(name, EXTRA_OF[name]) for name in packages]
    assert done.stderr.splitlines() == [part for line in lines for part in (line, "1")], done.stderr
