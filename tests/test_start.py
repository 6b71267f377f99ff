"""The start of commands: what `--help` loads, and how the threads of PyTorch wait."""

import json
import os
import subprocess
import sys
from pathlib import Path

from hgn.config import config_directory

ROOT = Path(__file__).parents[1]
LARGEST = ("hgn.train", "datagen", "datagen.service")
SLOW = (
    *("torch", "triton", "lightning", "trimesh", "h5py", "scipy", "matplotlib", "taichi", "viser", "fsspec"),
    *("ray", "starlette", "uvicorn"),
)
PROGRAM = """
import contextlib, io, json, runpy, sys
loaded, before = {}, set()
for module in sys.argv[1:]:
    sys.argv[:] = [module, "--help"]
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    loaded[module] = sorted(sys.modules.keys() - before)
    before |= sys.modules.keys()
print(json.dumps(loaded))
"""


def modules_of_commands():
    """Yields the modules of all commands, but of the two whose cases are their settings."""
    yield from LARGEST
    names = {path.stem for path in (config_directory() / "command").glob("*.yaml")}
    for name in sorted(names - {"stability_network", "stability_solver"}):
        files = [f"{root}/{name}.py" for root in ("hgn", "datagen", "tools")] + [f"tools/{name}/__main__.py"]
        (file,) = [file for file in files if (ROOT / file).is_file()]
        yield file.removesuffix(".py").removesuffix("/__main__").replace("/", ".")


def test_help_loads_little():
    """No command's --help loads PyTorch, the solver, or packages that take a tenth of a second and more; the largest
    ones do not load NumPy; all of them together load few modules."""
    names = list(modules_of_commands())
    assert len(names) >= 17
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, *names], env=environment, capture_output=True, text=True, check=True
    )
    loaded = json.loads(ended.stdout)
    assert {name: slow for name, modules in loaded.items() if (slow := sorted(set(modules) & set(SLOW)))} == {}
    assert [name for name in LARGEST if "numpy" in loaded[name]] == []
    assert sum(map(len, loaded.values())) < 700


def test_idle_threads_sleep():
    """Whatever a program of the project imports first, OpenMP is told to wait passively before PyTorch loads it; a
    value that the user has set stays."""
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment |= {"PYTHONPATH": str(ROOT), "OMP_DISPLAY_ENV": "TRUE"}

    def ended(program, **variables):
        command = [sys.executable, "-c", program]
        return subprocess.run(command, env=environment | variables, capture_output=True, text=True, check=True)

    assert "OMP_WAIT_POLICY = 'PASSIVE'" in ended("import tools.timing").stderr
    first = "import os, sys, hgn; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    assert [ended(first, **given).stdout.split() for given in ({}, {"OMP_WAIT_POLICY": "ACTIVE"})] == [
        ["PASSIVE", "False"], ["ACTIVE", "False"]
    ]  # fmt: skip


def test_idle_threads_sleep_if_pytorch_is_loaded_first():
    """If a program has loaded PyTorch before, a device's choice starts a second team of OpenMP's threads, one for each
    core, once: with more threads than cores OpenMP lets idle ones sleep. The number of PyTorch's threads stays. A value
    that the user has set stays, without a second team."""
    program = """
import os, torch
if os.fork():
    os.wait()
    os.environ["OMP_WAIT_POLICY"] = "ACTIVE"
import hgn
from hgn.system.device import choose_device
torch.set_num_threads(2)
counts = [len(os.listdir("/proc/self/task"))]
for _ in range(2):
    choose_device("cpu")
    counts.append(len(os.listdir("/proc/self/task")))
print(counts[1] - counts[0], counts[2] - counts[1], torch.get_num_threads(), os.environ["OMP_WAIT_POLICY"])
"""
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment |= {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "2"}

    def printed(program):
        command = [sys.executable, "-c", program]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()

    assert printed(program) == [f"{len(os.sched_getaffinity(0))} 0 2 PASSIVE", "0 0 2 ACTIVE"]
    assert printed(f"import hgn\n{program}") == ["0 0 2 PASSIVE", "0 0 2 ACTIVE"]
