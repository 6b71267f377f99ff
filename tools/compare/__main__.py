"""python -m tools.compare 'trees=[before,after]' out=FILE.json: kernels of several source trees beside each other.

A tree is a folder with this project's sources, or a commit or branch of the repository in the current folder. Each has
a process of its own on one GPU; they take turns, and each is compared with the plain network in float64 before and
after. No time is told of what fails. The JSON holds {"meta", "rows", "checks", "profiles"}; the exit code is 1 where a
check is red.
"""

from __future__ import annotations

import signal
import tempfile
from pathlib import Path
from typing import Any

import torch

from hgn.command import run_command
from hgn.config import NetworkConfig
from hgn.runtime.backend import why_not_fast
from hgn.schema import from_mapping, require, to_mapping
from hgn.system.device import choose_device
from hgn.system.provenance import provenance, without_folders
from tools.compare.children import Children
from tools.compare.config import CompareConfig
from tools.compare.report import Report
from tools.compare.trees import Tree, find_trees
from tools.compare.turns import Comparison

EXIT_RED = 1


def main(mapping: dict[str, Any]) -> int:
    """Prints the profiles and, last, the table; the exit code is 1 where a check is red."""
    config = from_mapping(CompareConfig, mapping)
    device = choose_device(config.device)
    reason = why_not_fast(torch.device("cuda"), config.network, config.precision)
    require(reason is None, "network", "one that the fast path computes", to_mapping(config.network), reason or "")
    if device.type == "cpu":
        config.require_tiny()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: the children end, what was found is kept
    with tempfile.TemporaryDirectory(prefix="hgn_compare_") as folder:
        room = Path(folder).resolve()
        trees = find_trees(config.trees, room)
        report = Report(Path(config.out).resolve(), _meta(config, device, trees), config.cases, [t.name for t in trees])
        with Children(_settings(config, device, room), room, interpreter=device.type == "cpu") as children:
            Comparison(config, children, trees, report).run()
    print(report.profile_tables() + report.table())
    return 0 if report.green() else EXIT_RED


def _meta(config: CompareConfig, device: torch.device, trees: list[Tree]) -> dict[str, Any]:
    meta = provenance(device)
    meta["versions"]["cuda"] = torch.version.cuda
    commits = [{"tree": tree.name, "commit": tree.commit} for tree in trees]
    return meta | {"config": without_folders(to_mapping(config)), "trees": commits}


def _settings(config: CompareConfig, device: torch.device, room: Path) -> dict[str, Any]:
    """Of the trees' processes. Of the network what is not as ever: trees may know other fields."""
    usual, network = to_mapping(NetworkConfig()), to_mapping(config.network)
    major, minor = torch.cuda.get_device_capability(device) if device.type == "cuda" else (0, 0)
    return {
        "network": {name: value for name, value in network.items() if value != usual[name]},
        "precision": config.precision,
        "particles": config.particles,
        "cases": list(config.cases),
        "device": str(device),
        "capability": 10 * major + minor,
        "references": str(room),
    }


if __name__ == "__main__":
    run_command(main, "compare")
