"""What all commands share: their configuration is what Hydra's own entry point hands over, and a reader may leave."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hgn.command import EXIT_UNREAD, _compose, run_command
from hgn.schema import ConfigError


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("../my data/dé mo", "../my data/dé mo"),
        ("weights (1).safetensors", "weights (1).safetensors"),
        ("a&b#1!;x=y", "a&b#1!;x=y"),
        ("it's", "it's"),
        ("data(1)", "data(1)"),  # to Hydra a function
        ("ends in \\", "ends in \\"),
        ("ü\\", "ü\\"),
        ("ü\\'", "ü\\'"),
        ("~/runs/ü", f"{Path.home()}/runs/ü"),
        ("plain", "plain"),
        ("'ü'", "ü"),
    ],
)
def test_names_that_hydra_refuses(given, meant, monkeypatch):
    """Files and folders are called what people call them; what stands beside them is taken as ever."""
    monkeypatch.setattr("sys.argv", ["error_vs_time", f"data={given}", "out=x", "weights=null", "mpm_steps=[0.1]"])
    (composed,) = _compose("error_vs_time")
    assert composed["data"] == meant and composed["weights"] is None and composed["mpm_steps"] == [0.1]


def test_names_in_lists(monkeypatch):
    """Each name of a list is taken by itself; what is no name is refused."""
    monkeypatch.setattr("sys.argv", ["average", "weights=[a, dé mo (1),3]", "out=ü", "+new=[x&y]"])
    (composed,) = _compose("average")
    assert (composed["weights"], composed["out"], composed["new"]) == (["a", "dé mo (1)", 3], "ü", ["x&y"])
    monkeypatch.setattr("sys.argv", ["average", "weights=[a,{ü]", "out=x"])
    with pytest.raises(ConfigError, match="weights="):
        _compose("average")


@pytest.mark.parametrize(
    "arguments",
    [
        ["hgn.export", "--help"],  # printed by the command
        ["hgn.train", "--help"],  # by Hydra
        ["hgn.export", "checkpoint="],  # an error, to where nobody reads
    ],
)
def test_a_reader_that_leaves(warm_python, arguments):
    """As in `… | head`: the command ends with an exit code of its own, and without a traceback."""
    read, write = os.pipe()
    os.close(read)
    error = write if arguments[1] != "--help" else subprocess.PIPE
    ended = subprocess.run([str(warm_python), "-m", *arguments], stdout=write, stderr=error, text=True)
    os.close(write)
    assert ended.returncode == EXIT_UNREAD and not ended.stderr


def test_nothing_is_open():
    """A command that is started without standard output and error does its work."""
    program = "import sys; from hgn.command import run_command; from hgn.system.progress import bar"
    program += "; sys.argv[1:] = []; run_command(lambda mapping: bar('x', total=1, unit='y').close(), 'bench')"
    command = ["bash", "-c", 'exec "$0" -c "$1" >&- 2>&-', sys.executable, program]
    assert subprocess.run(command, check=False).returncode == 0


def test_other_broken_pipes_are_faults(monkeypatch):
    """Of a process or a server that the command talks to: nothing is hidden."""

    def talks(mapping):
        raise BrokenPipeError("the server")

    with Path(os.devnull).open("w") as out:
        monkeypatch.setattr("sys.argv", ["bench"])
        monkeypatch.setattr("sys.stdout", out)
        monkeypatch.setattr("sys.stderr", out)
        with pytest.raises(BrokenPipeError, match="the server"):
            run_command(talks, "bench")
