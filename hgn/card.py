"""python -m hgn.card weights=net.safetensors out=FOLDER, or data=FOLDER: writes a card for the Hugging Face Hub.

The card is README.md, with the Hub's metadata and a table of the content of the weights or the data set.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import yaml

from hgn.command import run_command
from hgn.data.manifest import SPLITS, Manifest, errors_in_config
from hgn.data.storage import is_remote
from hgn.scene.kinds import RANGES
from hgn.scene.own_physics import own_ranges
from hgn.schema import from_mapping, printable, require
from hgn.system.files import read_replaced, write_atomically

if TYPE_CHECKING:
    from hgn.runtime.weights import WeightsInfo

CARD = "README.md"
_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"))  # the Hub's size categories, by episodes


@dataclass(frozen=True)
class CardConfig:
    """`python -m hgn.card`: the README.md that the Hugging Face Hub shows for weights or a data set."""

    weights: str | None = None  # a file of python -m hgn.export, which is copied into out
    data: str | None = None  # folder of a data set, whose card is written instead of a card of weights
    out: str | None = None  # the folder for the card and a copy of the weights; only with weights
    license: str = "mit"  # name of the licence on the Hub

    def __post_init__(self) -> None:
        one = (self.weights is None) != (self.data is None)
        require(one, "weights", "given, or data, but not both", [self.weights, self.data])
        rule = "a folder, given with weights, and left out with data, whose folder it is"
        require((self.weights is None) == (self.out is None), "out", rule, self.out)
        plain = re.fullmatch(r"[a-z0-9.-]+", self.license) is not None
        require(plain, "license", "the Hub's name of a licence, for example mit or cc-by-4.0", self.license)


def main(mapping: dict[str, Any]) -> int:
    """Writes the card and a copy of the weights, but never replaces a card. Returns the exit code."""
    from hgn.runtime.weights import find_weights, load_weights

    config = from_mapping(CardConfig, mapping)
    if config.weights is not None:
        assert config.out is not None  # checked by CardConfig
        path, folder = find_weights(config.weights), Path(config.out)
        _, info = load_weights(path)
        text = weights_card(info, path.stem, path.name, config.license)
        copy, content = folder / path.name, path.read_bytes()
        same = not copy.exists() or read_replaced(copy) == content
        require(same, "out", f"a folder without another {path.name}", str(folder))
    else:
        assert config.data is not None
        require(not is_remote(config.data), "data", "a local folder", config.data)
        folder = Path(config.data)
        manifest = Manifest.load(folder)
        with errors_in_config(folder):
            text = data_card(manifest, folder.name, config.license)
    target = folder / CARD
    require(not target.exists(), "out" if config.weights else "data", f"a folder without {CARD}", str(folder))
    folder.mkdir(parents=True, exist_ok=True)
    if config.weights is not None:
        write_atomically(copy, content)
    write_atomically(target, text.encode())
    print(target)
    return 0


def weights_card(info: WeightsInfo, name: str, file: str, licence: str) -> str:
    """Returns the card of a weights file: the Hub's metadata, the structure, and a command that uses the file."""
    network = info.network
    metadata = {"license": licence, "library_name": "hgn", "tags": ["physics", "particles", "simulation", network.kind]}
    rows = {
        "network": f"{network.kind}, {network.dimensions}D, width {network.width}, {network.levels} levels",
        "materials": ", ".join(info.data_materials),
        "cells": f"{network.cell_size:g}",
        "obstacles": "seen" if network.obstacle_features else "not seen",
        "frames a second": f"{info.frame_rate_hz:g}",
        "gravity": "any" if network.relative else _vector(info.gravity),
        "updates": str(info.updates),
        **_range_rows(info.own_ranges),
    }
    use = f"python -m hgn.rollout weights=hf://USER/NAME/{quote(file)}"
    return _page(metadata, name, "Weights of a particle simulator, for HGN.", rows, use)


def data_card(manifest: Manifest, name: str, licence: str) -> str:
    """Returns the card of a data set: the Hub's metadata with its splits, the manifest's content, and a command."""
    episodes = {split: manifest.published(split) for split in SPLITS if manifest.published(split)}
    require(bool(episodes), "data", "a data set with episodes", name)
    count = sum(episodes.values())
    files = [{"split": split, "path": f"{split}-*.tar"} for split in episodes]
    metadata = {
        "license": licence,
        "pretty_name": name,
        "tags": ["physics", "particles", "simulation", "webdataset"],
        "size_categories": [next((size for limit, size in _SIZES if count < limit), "100K<n<1M")],
        "configs": [{"config_name": "default", "data_files": files}],
    }
    own = manifest.config.get("imported")
    scene = own or manifest.config["scene"]
    materials = scene["materials"]
    require(isinstance(materials, (list, tuple)), "config materials", "a list of names", materials)
    rows = {split: f"{number} episode{'s' * (number > 1)}" for split, number in episodes.items()}
    rows |= {
        "frames a second": f"{manifest.config['frame_rate_hz']:g}",
        "materials": ", ".join(dict.fromkeys([*materials, *({"elastic"} & {*(scene.get("own_physics") or ())})])),
        "gravity": "of each scene" if scene.get("kinds") else _vector(scene["gravity"]),
        "made by": f"an import of {own['format']} files" if own else "HGN's solver",
        **_reference_row(manifest.config.get("reference")),
        "configuration": manifest.config_hash[:12],
    }
    rows |= _kind_rows(scene.get("kinds") or {})
    rows |= _range_rows(own_ranges(scene.get("own_physics") or ()))
    kind = "imported" if own else "EXPERIMENT"
    use = f"python -m hgn.train +experiment={kind} dataset.folder=hf://datasets/USER/NAME"
    return _page(metadata, name, "Trajectories of particles: WebDataset shards, a manifest and an index.", rows, use)


def _reference_row(reference: dict[str, Any] | None) -> dict[str, str]:
    if reference is None:
        return {}
    children = f"{reference['particles_per_visible']} on this grid, {reference['visible']}"
    return {"simulated on": f"{reference['cells']} cells per unit; each particle stands for {children}"}


def _kind_rows(kinds: Mapping[str, float]) -> dict[str, str]:
    """Returns a row for each kind of scene: its fraction of the scenes, and the range of each number that it draws."""
    total = sum(kinds.values())
    return {
        f"kind {kind}": f"{share / total:.1%}; "
        + ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in RANGES[kind].items())
        for kind, share in kinds.items()
        if share > 0
    }


def _range_rows(ranges: Mapping[str, tuple[float, float]]) -> dict[str, str]:
    return {f"{name} of scenes": f"{low:g} to {high:g}" for name, (low, high) in ranges.items()}


def _plain(text: str) -> str:
    """Returns a text with all special characters escaped for Markdown."""
    return re.sub(r"[^\w .,;:%/'()+-]", lambda match: f"&#{ord(match[0])};", printable(text))


def _vector(value: Sequence[float]) -> str:
    return ", ".join(f"{component:.6g}" for component in value)


def _page(metadata: dict[str, Any], name: str, what: str, rows: dict[str, str], use: str) -> str:
    head = yaml.safe_dump(metadata, sort_keys=False)
    table = "".join(f"| {_plain(key)} | {_plain(value)} |\n" for key, value in rows.items())
    return f"---\n{head}---\n\n# {_plain(name)}\n\n{what}\n\n| | |\n|---|---|\n{table}\n```sh\n{use}\n```\n"


if __name__ == "__main__":
    run_command(main, "card")
