"""Draws the seed of a fresh test set after the weights are frozen, so that no choice can depend on the set.

`fresh.json` in the data set's folder stores it with their hashes. It is written once, before the first scene is made.
"""

import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hgn.data.manifest import MANIFEST_NAME
from hgn.data.storage import is_remote, local_folder
from hgn.data.verification import file_sha256
from hgn.schema import ConfigError, from_mapping, require, to_mapping
from hgn.system.files import write_json
from hgn.system.yaml_files import read_json

FRESH_NAME = "fresh.json"


@dataclass(frozen=True)
class FreshSeed:
    """Holds a seed, the time of its draw (UTC, ISO 8601), and the sha256 of the frozen weights by file name."""

    seed: int
    drawn: str
    weights: dict[str, str]


def draw_fresh(folder: Path | str, weights: Sequence[str]) -> FreshSeed:
    """Draws the seed of a new data set, or reads the seed that was drawn for these weights.

    Raises: ConfigError for a missing file, for a data set that already exists, and for other weights.
    """
    files = [Path(name) for name in weights]
    for i, file in enumerate(files):
        require(
            file.is_file(),
            f"frozen[{i}]",
            "an existing file of weights",
            str(file),
            "as in hgn/weights/mechanics.safetensors",
        )
    hashes = {file.name: file_sha256(file) for file in files}
    fresh = read_fresh(folder)
    if fresh is None:
        chosen = (Path(folder) / MANIFEST_NAME).exists()
        rule = f"left out, because the seed of the data set in {folder} was not drawn"
        require(not chosen, "frozen", rule, list(weights))
        fresh = FreshSeed(secrets.randbelow(2**31), datetime.now(UTC).isoformat(timespec="seconds"), hashes)
        write_json(Path(folder) / FRESH_NAME, to_mapping(fresh))
    remedy = "changed weights need another folder, and thus another seed"
    require(fresh.weights == hashes, "frozen", f"the weights of {folder}/{FRESH_NAME}", list(weights), remedy)
    return fresh


def read_fresh(folder: Path | str) -> FreshSeed | None:
    """Returns the seed record of a folder; None for a chosen seed, and for a remote folder."""
    path = local_folder(folder) / FRESH_NAME
    if is_remote(folder) or not path.is_file():
        return None
    try:
        return from_mapping(FreshSeed, read_json(path), str(path))
    except ValueError as error:
        raise ConfigError(f"{path} must be a file that python -m datagen frozen=… wrote, got {error}") from error


def set_record(folder: Path | str, seed: int, files: Iterable[Path]) -> dict[str, Any]:
    """Returns a report's record: the seed, the time of its draw (None: chosen), and weights not frozen at that time."""
    fresh, drawn = read_fresh(folder), None
    later = [file.name for file in files if fresh is None or fresh.weights.get(file.name) != file_sha256(file)]
    if fresh is not None:
        require(fresh.seed == seed, f"{folder}/{FRESH_NAME}: seed", "the data set's own", fresh.seed)
        drawn = fresh.drawn
    return {"seed": seed, "drawn": drawn, "not_frozen_before": later}
