"""Kills the making of a data set before many a line of it, each time completes it, and prints what came of it as JSON.

Run as `python crash_program.py FOLDER KILLS`, with this folder on the path and BALLISTIC_FOLDER set.
"""

import json
import os
import signal
import sys
import tarfile
from pathlib import Path

from ballistic_dataset import make_dataset

import datagen.pool.locks
import datagen.pool.shard
import datagen.pool.writer
import hgn.data.index
import hgn.system.files
from hgn.config import DatagenConfig, DatasetConfig
from hgn.data.manifest import Manifest
from hgn.data.storage import file_sha256
from tools.studies.kills import verified_shards

# whatever touches the folder; most lines are in the writing of tar files, so some kills leave those out, and some fall
# into publications alone
LISTING = {hgn.data.index.__file__, hgn.system.files.__file__}
OURS = LISTING | {datagen.pool.locks.__file__, datagen.pool.shard.__file__, datagen.pool.writer.__file__}
TRACED = (OURS, OURS | {tarfile.__file__}, LISTING)


class Lines:
    """Counts the lines of some files that are run, and kills the process before the given one."""

    def __init__(self, files, last):
        self.files, self.count, self.last = files, 0, last

    def __call__(self, frame, event, argument):
        if frame.f_code.co_filename not in self.files:
            return None
        if event == "line":
            self.count += 1
            if self.count == self.last:
                os.kill(os.getpid(), signal.SIGKILL)
        return self


def run(folder, files=None, last=None):
    """Makes what is missing in a process of its own, which ends before line `last` of `files`: wait status, lines."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        lines = Lines(files or set(), last)
        sys.settrace(lines if files else None)
        make_dataset(config(folder))
        sys.settrace(None)
        os.write(writer, str(lines.count).encode())
        os._exit(0)
    os.close(writer)
    _, status = os.waitpid(child, 0)
    with os.fdopen(reader) as file:
        lines = int(file.read() or 0)
    if last is None and status:
        raise SystemExit(f"a generation without a kill failed, wait status {status}")
    return status, lines


def config(folder):
    return DatagenConfig(
        dataset=DatasetConfig(folder=str(folder), training_scenes=3, validation_scenes=1, test_scenes=0, frames=2)
    )


def shards(folder):
    return {path.name: file_sha256(path) for path in folder.rglob("*.tar")}


def main(folder, kills):
    lines = [run(folder / f"peaceful-{i}", files)[1] for i, files in enumerate(TRACED)]
    peaceful = folder / "peaceful-0"
    expected = {path.name for path in peaceful.rglob("*")}
    met: dict[str, int] = {"partial": 0, "staged": 0, "unlisted": 0}
    wrong = []
    for i in range(kills):
        kind = i % len(TRACED)
        last, place = 1 + i * lines[kind] // kills, folder / f"killed-{i}"
        status, _ = run(place, TRACED[kind], last)
        if not os.WIFSIGNALED(status):
            wrong.append(f"not killed before line {last}")
        published = verified_shards(place, ())
        met["partial"] += any(place.rglob("*.partial"))
        met["staged"] += any(place.glob(".staging/*.tar"))
        met["unlisted"] += len(list(place.glob("*.tar"))) > len(published)
        run(place)
        verified_shards(place, published)
        if {path.name for path in place.rglob("*")} != expected:
            wrong.append(f"{sorted(path.name for path in place.rglob('*'))} after line {last}")
        if shards(place) != shards(peaceful) or not Manifest.load(place).complete:
            wrong.append(f"other shards after line {last}")
    print(json.dumps({"lines": lines, "met": met, "wrong": wrong}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
