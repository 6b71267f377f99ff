"""What all commands share: their configuration is what Hydra's own entry point hands over, and a reader may leave."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hgn.command import EXIT_UNREAD, _compose, run_command


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("datagen", ["+experiment=demo", "dataset.frames=7", "scene.materials=[sand]"]),
        ("train", ["+experiment=small", "training.batch_scenes=2", "run=runs/x"]),
        ("stability_network", ["cases=[long]"]),
    ],
)
def test_composed_once(command: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """An option of Hydra's makes it compose in its own way, with the same result."""
    monkeypatch.setattr("sys.argv", [command, *arguments])
    once = _compose(command)
    monkeypatch.setattr("sys.argv", [command, *arguments, "hydra.job.name=x"])
    assert _compose(command) == once and len(once) == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["hgn.export", "--help"],  # printed by the command
        ["hgn.train", "--help"],  # by Hydra
        ["hgn.export", "checkpoint="],  # an error, to where nobody reads
    ],
)
def test_a_reader_that_leaves(arguments: list[str]) -> None:
    """As in `… | head`: the command ends with an exit code of its own, and without a traceback."""
    read, write = os.pipe()
    os.close(read)
    error = write if arguments[1] != "--help" else subprocess.PIPE
    ended = subprocess.run([sys.executable, "-m", *arguments], stdout=write, stderr=error, text=True)
    os.close(write)
    assert ended.returncode == EXIT_UNREAD and not ended.stderr


def test_other_broken_pipes_are_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a process or a server that the command talks to: nothing is hidden."""

    def talks(mapping: dict[str, Any]) -> None:
        raise BrokenPipeError("the server")

    with Path(os.devnull).open("w") as out:
        monkeypatch.setattr("sys.argv", ["bench"])
        monkeypatch.setattr("sys.stdout", out)
        monkeypatch.setattr("sys.stderr", out)
        with pytest.raises(BrokenPipeError, match="the server"):
            run_command(talks, "bench")
