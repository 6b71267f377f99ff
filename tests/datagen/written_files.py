"""What the tests of the writer share: the bytes of shards, every file of a data set, and all claims."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from datagen.pool.writer import DatasetWriter
from hgn.data.manifest import Manifest
from hgn.schema import to_mapping


def hashes(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.glob("*.tar"))}


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != ".lock"
    }


def first_release(folder: Path) -> dict[str, Any]:
    """Writes the manifest as the first release had it, and returns its content."""
    manifest = Manifest.load(folder)
    mapping = {name: value for name, value in vars(manifest).items() if name != "shards"}
    mapping |= {"shards": to_mapping(list(manifest.shards)), "quarantined": to_mapping(manifest.quarantined)}
    (folder / "manifest.json").write_text(json.dumps(mapping))
    return mapping


def claim_all(writer: DatasetWriter) -> list[tuple[str, int]]:
    while writer.claim_next():
        pass
    return writer.remaining()
