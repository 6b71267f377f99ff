"""Memory that is freed stays with the process."""

import platform
import subprocess

import pytest
from processes import PATIENCE_S

from hgn.cpu import allocator

PROGRAM = """
import resource, torch
from hgn.cpu.allocator import keep_freed_memory
def page_faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    blocks = [torch.ones(1 << 20) for _ in range(8)]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
assert keep_freed_memory()
print([page_faults() for _ in range(4)][-1])
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_freed_memory_is_taken_again(warm_python, tmp_path):
    """Eight blocks of 4 MB (1,024 pages each) that were freed together give the next eight their pages."""
    (tmp_path / "program.py").write_text(PROGRAM)
    command = [str(warm_python), str(tmp_path / "program.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE_S)
    assert int(done.stdout) < 100


def test_another_c_library_is_left_alone(monkeypatch):
    """Where mallopt may be missing, nothing is called."""
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    monkeypatch.setattr(allocator.ctypes, "CDLL", None)
    assert allocator.keep_freed_memory.__wrapped__() is False
