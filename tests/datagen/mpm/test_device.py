"""datagen.mpm.device: Taichi starts, works and ends in any environment."""

import inspect
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import taichi as ti

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


def test_kernels_are_defined_without_a_look_through_all_modules(monkeypatch):
    """The frame that imports a kernel's module has no source, and inspect knows of it at once."""
    asked = []

    class Watched(ModuleType):
        __file__ = property(lambda self: asked.append(True))

    for name in ("_bootstrap", "_bootstrap_external"):
        monkeypatch.setitem(sys.modules, "watched", Watched("watched"))
        names = {"sys": sys}
        exec(compile("frame = sys._getframe()", f"<frozen importlib.{name}>", "exec"), names)
        assert inspect.getframeinfo(names["frame"]).code_context is None and not asked


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


def ends(changes, folder):
    file = folder / "program.py"
    file.write_text(PROGRAM)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])} | changes
    kept = {name: value for name, value in environment.items() if value is not None}
    ended = subprocess.run([sys.executable, str(file)], env=kept, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout == "Device(kind='cpu', threads=1, processors=1)\n"


def test_without_a_home(tmp_path):
    """Where HOME is not set, as in a system's service, Taichi would abort the process."""
    ends({"HOME": None}, tmp_path)


@pytest.mark.parametrize("taken", [False, True])
def test_a_home_that_cannot_be_written_to(tmp_path, taken):
    """As of a container's user: compiled kernels are kept among temporary files, where nobody else writes, and
    the process ends well; Taichi would crash then. A link that somebody else has put there is left alone."""
    (tmp_path / "file").touch()
    temporary, elsewhere = tmp_path / "temporary", tmp_path / "elsewhere"
    temporary.mkdir()
    elsewhere.mkdir()
    own = temporary / f"taichi-{os.getuid()}"
    if taken:
        own.symlink_to(elsewhere)
    ends({"HOME": str(tmp_path / "file" / "home"), "TMPDIR": str(temporary)}, tmp_path)
    (used,) = [path for path in temporary.glob("taichi-*") if not path.is_symlink()]
    assert used.stat().st_mode & 0o777 == 0o700 and list(used.iterdir()) and not list(elsewhere.iterdir())
    assert (used == own) == (not taken)
