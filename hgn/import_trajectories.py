"""python -m hgn.import_trajectories from=FOLDER out=data/mine: makes a data set from another program's trajectories.

Reads DeepMind's TFRecords, geoelements' npz, LagrangeBench's and NeuralMPM's HDF5, and plain npz or HDF5.
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hgn.command import run_command
from hgn.data.foreign.settings import ImportConfig
from hgn.schema import from_mapping, printable, require
from hgn.system.progress import bar


def main(mapping: dict[str, Any]) -> int:
    """Imports a set, and prints its content and a command for training on it. Returns the exit code."""
    from hgn.data.foreign.dataset import import_set

    mapping = dict(mapping)
    source = mapping.pop("from", None)
    require(isinstance(source, str) and source != "", "from", "the folder with the trajectories", source)
    mapping["materials"] = mapping.get("materials") or {}
    if isinstance(mapping["materials"], Mapping):
        mapping["materials"] = {str(key): value for key, value in mapping["materials"].items()}
    config = from_mapping(ImportConfig, mapping)
    with bar("importing", total=None, unit="episode") as progress:
        manifest, neighbours, note = import_set(Path(str(source)), config, lambda _: progress.update())
    if note is not None:
        print(printable(note), file=sys.stderr)
    own = manifest.config["imported"]
    counts = ", ".join(f"{count} {split}" for split, count in manifest.requested.items())
    gravity = ", ".join(f"{value:.4g}" for value in own["gravity"])
    print(f"{own['format']}, {own['dimensions']}D, {', '.join(own['materials'])}; {counts} episodes in {config.out}")
    radius = f"radius {own['radius']:g} with {neighbours:.2g} neighbours on average"
    print(f"gravity ({gravity}), obstacles: {'yes' if own['obstacles'] else 'none'}, {radius}")
    print(f"to train: python -m hgn.train +experiment=imported dataset.folder={config.out}")
    return 0


if __name__ == "__main__":
    run_command(main, "import_trajectories")
