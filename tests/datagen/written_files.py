"""What the tests of the writer share: the bytes of shards, every file of a data set, and all claims."""

import hashlib
import json

from hgn.data.manifest import Manifest
from hgn.schema import to_mapping


def hashes(folder):
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.glob("*.tar"))}


def snapshot(folder):
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != ".lock"
    }


def first_release(folder):
    """Writes the manifest as the first release had it, and returns its content."""
    manifest = Manifest.load(folder)
    mapping = {name: value for name, value in vars(manifest).items() if name != "shards"}
    mapping |= {"shards": to_mapping(list(manifest.shards)), "quarantined": to_mapping(manifest.quarantined)}
    (folder / "manifest.json").write_text(json.dumps(mapping))
    return mapping


def claim_all(writer):
    while writer.claim_next():
        pass
    return writer.remaining()
