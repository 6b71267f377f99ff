"""datagen.mpm.device: Taichi starts, works and ends in any environment."""

import inspect
import os
import subprocess
import sys
import traceback
from pathlib import Path

import pytest
import taichi as ti
from taichi.lang import kernel_impl

from datagen.mpm.device import initialise


@ti.kernel
def faulty():
    ti.no_such_function()


def test_a_fault_in_a_kernel_names_its_line():
    """File, line and function, once; Taichi's drawing of the line is left out, for it draws as many as expressions."""
    initialise("cpu", 2)
    with pytest.raises(ti.TaichiCompilationError) as fault:
        faulty()
    line = faulty._primal.func.__code__.co_firstlineno + 2
    told = str(fault.value)
    assert f'File "{__file__}", line {line}, in faulty:\n' in told and "no_such_function()" not in told


def test_arrays_and_kernels_cause_no_useless_work(monkeypatch):
    """No array walks the stack of the calls that allocated it; a function is read from its file once."""
    kernel_impl.getsourcelines(faulty)
    monkeypatch.setattr(traceback, "extract_stack", None)
    monkeypatch.setattr(inspect, "getsourcelines", None)
    ti.ndarray(ti.f32, 1), ti.Vector.ndarray(3, ti.f32, 1), ti.Matrix.ndarray(3, 3, ti.f32, 1)
    kernel_impl.getsourcelines(faulty)


PROGRAM = """
from datagen.mpm.device import initialise, ti
print(initialise("cpu", 1))
numbers = ti.field(ti.f32, 10)

@ti.kernel
def count():
    for i in numbers:
        numbers[i] = i

count()
assert numbers[7] == 7
"""


@pytest.mark.parametrize("home", ["none", "a file", "taken"])
def test_without_a_home(tmp_path, home):
    """Without HOME, as in a system's service, Taichi would abort the process. If HOME is not writable, as for a
    container's user, it would crash. Compiled kernels are then in a private folder of temporary files. A link of
    another user in its place is not used."""
    (tmp_path / "file").touch()
    (tmp_path / "program.py").write_text(PROGRAM)
    temporary, elsewhere = tmp_path / "temporary", tmp_path / "elsewhere"
    temporary.mkdir()
    elsewhere.mkdir()
    own = temporary / f"taichi-{os.getuid()}"
    if home == "taken":
        own.symlink_to(elsewhere)
    changes = {"PYTHONPATH": str(Path(__file__).parents[3]), "HOME": str(tmp_path / "file" / "home")}
    environment = os.environ | changes | {"TMPDIR": str(temporary)}
    if home == "none":
        del environment["HOME"]
    command = [sys.executable, str(tmp_path / "program.py")]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout == "Device(kind='cpu', threads=1, processors=1)\n"
    if home != "none":
        (used,) = [path for path in temporary.glob("taichi-*") if not path.is_symlink()]
        assert used.stat().st_mode & 0o777 == 0o700 and list(used.iterdir()) and not list(elsewhere.iterdir())
        assert (used == own) == (home != "taken")
