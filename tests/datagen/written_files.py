"""What the tests of generation share: the bytes of shards, every file of a data set, all claims, what was simulated,
and a progress that remembers."""

import hashlib
from pathlib import Path

from datagen.pool.locks import LOCK_NAME
from datagen.pool.progress import Progress
from hgn.data.index import INDEX_NAME
from hgn.data.manifest import MANIFEST_NAME, Manifest


def hashes(folder):
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.glob("*.tar"))}


def snapshot(folder):
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != ".lock"
    }


def differences(one, other):
    """The names of files that one complete data set has and the other has not, or not the same; indexes may differ."""
    contents = [
        {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()} for folder in (one, other)
    ]
    own = {MANIFEST_NAME, INDEX_NAME, LOCK_NAME}
    for manifest in (Manifest.load(one), Manifest.load(other)):
        assert manifest.complete and not manifest.quarantined
        own |= {Path(name).name for name, _ in manifest.shards.files()}
    names = contents[0].keys() | contents[1].keys()
    return sorted(name for name in names - own if contents[0].get(name) != contents[1].get(name))


def simulated(control):
    """The seeds that the stand-in for the solver was given, in order."""
    return [int(line) for line in (control / "simulated.log").read_text().split()]


def simulated_once(control):
    """How many scenes were simulated; none was twice."""
    seeds = simulated(control)
    assert len(seeds) == len(set(seeds))
    return len(seeds)


class Recorder(Progress):
    def __init__(self):
        self.messages: list[str] = []
        self.shards: list[str] = []
        self.episodes: list[str] = []
        self.launches: list[int] = []

    def frame(self, worker, frame, scenes):
        if scenes:
            self.launches.append(scenes)

    def episode(self, key):
        self.episodes.append(key)

    def shard(self, name, episodes, revision):
        self.shards.append(name)

    def message(self, text):
        self.messages.append(text)


def claim_all(writer):
    while writer.claim_next():
        pass
    return writer.remaining()
