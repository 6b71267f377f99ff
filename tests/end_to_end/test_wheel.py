"""The wheel: installed without the checkout, every command runs from any folder."""

import json
import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
import yaml
from processes import PATIENCE_S

from hgn.config import DEFAULT_WEIGHTS

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = """
import json, runpy, sys, hgn.config
print(hgn.config.config_directory(), end="")
for module, *arguments in json.loads(sys.argv[1]):
    print(end="\\0")
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        assert not end.code
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from the checkout with what is installed, without a network."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    built = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert built.returncode == 0, built.stdout + built.stderr
    (path,) = folder.glob("hgn-*.whl")
    return path


@pytest.fixture(scope="module")
def python(wheel, tmp_path_factory):
    """The interpreter of a fresh environment with the wheel, which sees the present dependencies but no checkout."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    interpreter = folder / "bin" / "python"
    install = ["install", "--quiet", "--disable-pip-version-check", "--no-deps", "--no-index", str(wheel)]
    pip = [sys.executable, "-m", "pip", "--python", str(interpreter), *install]
    installed = subprocess.run(pip, capture_output=True, text=True, timeout=PATIENCE_S)
    assert installed.returncode == 0, installed.stderr
    (packages,) = folder.glob("lib/python*/site-packages")
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return interpreter


def run(python, folder, *arguments):
    """Standard output of a command that must succeed and leave the folder empty."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [str(python), *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    assert list(folder.iterdir()) == []
    return done.stdout


def test_configs_travel_inside(wheel):
    """All of conf/, the shipped weights and what the user's machine compiles are inside, byte for byte; tests, job
    files and caches are not."""
    with zipfile.ZipFile(wheel) as archive:
        source = "hgn/cpu/rows.c"
        assert archive.read(source) == (ROOT / source).read_bytes()
        names = archive.namelist()
        for path in (ROOT / "conf").rglob("*"):
            if path.is_file():
                assert archive.read(f"hgn/conf/{path.relative_to(ROOT / 'conf')}") == path.read_bytes()
        for path in (ROOT / "hgn" / "weights").iterdir():
            assert archive.read(f"hgn/weights/{path.name}") == path.read_bytes()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"hgn", "datagen"}
    assert not [name for name in names if "__pycache__" in name or "test" in name]


def test_commands_compose_their_config(python, tmp_path):
    """The configs are found inside the installed package, from an empty folder: `--cfg job` with an experiment prints
    the composed configuration, `--help` what a command does and its keys with their comments."""
    small = ("+experiment=small", "--cfg", "job")
    calls = [("hgn.train", *small), ("datagen", *small), ("hgn.rollout", "--help")]
    place, train, datagen, text = run(python, tmp_path, "-c", PROGRAM, json.dumps(calls)).split("\0")
    directory = Path(place)
    assert directory.is_relative_to(python.parents[1]) and directory.parts[-2:] == ("hgn", "conf")
    for key, composed in (("training", yaml.safe_load(train)), ("mpm", yaml.safe_load(datagen))):
        assert composed["name"] == "small" and key in composed
    assert f"weights: {DEFAULT_WEIGHTS} # a f" in text and text.strip("`\n").startswith("python -m hgn.rollout")


def test_shipped_weights_simulate(python, tmp_path):
    """A random scene with the default weights, from an empty folder."""
    (here := tmp_path / "here").mkdir()
    out = tmp_path / "rollout.vtkhdf"
    run(python, here, "-m", "hgn.rollout", "frames=2", "device=cpu", "render=false", f"out={out}")
    assert out.stat().st_size > 10_000
