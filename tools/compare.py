"""python -m tools.compare 'trees=[before,after]' out=FILE.json: source trees timed in turns by their own benches.

A tree is a folder with this project's sources, or a commit or branch of the repository in the current folder. A round
runs `python -m tools.bench` of each tree, in the other order every other time, so that a machine that slows down slows
all of them. The bench checks before it times; no time is told of what fails. The JSON holds {"meta", "rows"}; the exit
code is 1 where a check is red.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hgn.command import run_command
from hgn.schema import ConfigError, Positive, from_mapping, require, require_bounds
from hgn.system.files import write_json
from tools.report import EXIT_RED, PASS, meta_of, spread
from tools.report import table as aligned

WORK = ("case", "particles", "scenes", "precision")  # what is the same work in two trees


@dataclass(frozen=True)
class CompareConfig:
    """`python -m tools.compare`: which trees are timed, and on what."""

    # folders with this project's sources, or commits and branches of the repository here (quoted:
    # ["HEAD~1",.]); the first is what the others are compared with
    trees: tuple[str, ...]
    out: str  # the JSON file, written after each run
    rounds: Positive[int] = 3  # runs of each tree
    # options of each run, as python -m tools.bench takes them: ["cases=[frame,train]","scenes=[1,8]"]
    bench: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require_bounds(self)
        require(len(self.trees) > 0, "trees", "a list with at least one tree", [], "as in 'trees=[main,.]'")
        require(len(set(self.trees)) == len(self.trees), "trees", "a list of different trees", list(self.trees))
        for i, option in enumerate(self.bench):
            ours = option.startswith(("json=", "--json"))
            require("=" in option and not ours, f"bench[{i}]", "KEY=VALUE other than json", option)


def main(mapping: dict[str, Any]) -> int:
    """Prints the table; returns the exit code."""
    config = from_mapping(CompareConfig, mapping)
    with tempfile.TemporaryDirectory(prefix="hgn_compare_") as scratch:
        folders = [_sources(name, Path(scratch) / str(i), f"trees[{i}]") for i, name in enumerate(config.trees)]
        runs: dict[str, list[dict[str, Any]]] = {name: [] for name in config.trees}
        turn = list(zip(config.trees, folders, strict=True))
        for number in range(config.rounds):
            for name, folder in turn if number % 2 == 0 else turn[::-1]:
                runs[name].append(_run_bench(folder, config.bench, Path(scratch) / "bench.json"))
                rows = compared(runs)
                write_json(config.out, {"meta": meta_of(config) | _measured(runs), "rows": rows})
    print(table(rows, config.trees))
    return 0 if all(row["check"] == PASS for row in rows) else EXIT_RED


def _measured(runs: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """The device and versions that the benches name, and each tree's commit."""
    named = {tree: run["meta"] for tree, reports in runs.items() for run in reports if "meta" in run}
    first: dict[str, Any] = next(iter(named.values()), {})
    commits = {tree: meta.get("commit") for tree, meta in named.items()}
    return {key: first[key] for key in ("device", "versions") if key in first} | {"commits": commits}


def _run_bench(folder: Path, options: Sequence[str], out: Path) -> dict[str, Any]:
    """A tree's report; `failed` in it says why there is none."""
    out.unlink(missing_ok=True)
    paths = os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", "tools.bench", *options, f"json={out}"]
    done = subprocess.run(
        command, cwd=folder, env=os.environ | {"PYTHONPATH": paths}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    if not out.exists():
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
        return {"failed": f"the bench ended with exit code {done.returncode}: {last[0]}", "rows": []}
    return json.loads(out.read_text())


def compared(runs: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """A row for each tree and work: median of the runs' medians, their range, and the ratio to the first tree's."""
    rows: list[dict[str, Any]] = []
    first: dict[tuple[Any, ...], float] = {}
    for tree, reports in runs.items():
        failures = [report["failed"] for report in reports if "failed" in report]
        rows += [{"tree": tree, "case": "bench", "ms": None, "check": failures[0]}] if failures else []
        works: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
        for report in reports:
            for row in report["rows"]:
                works.setdefault(_work(row), []).append(row)
        for work, samples in works.items():
            check = next((row["check"] for row in samples if row["check"] != PASS), PASS)
            row = {"tree": tree, **dict(zip(WORK, work, strict=True)), "check": check, "runs": len(samples), "ms": None}
            if check == PASS:
                times = [sample["ms"] for sample in samples]
                row |= {"ms": float(np.median(times)), "ms_range": [min(times), max(times)]}
                row["memory_gb"] = samples[-1].get("memory_gb")
                row["ratio"] = row["ms"] / first.setdefault(work, row["ms"])
            rows.append(row)
    return rows


def table(rows: Sequence[dict[str, Any]], trees: Sequence[str]) -> str:
    """The figures for people, one line a work, and what is red."""
    timed = {(row["tree"], _work(row)): row for row in rows if row["ms"] is not None}
    lines = []
    for work in dict.fromkeys(_work(row) for row in rows if row["case"] != "bench"):
        cells = []
        for row in (timed.get((tree, work)) for tree in trees):
            cells.append(f"{row['ms']:.3f} ({spread(row['ms_range'], '.3f')}, {row['ratio']:.3f})" if row else "-")
        lines.append(("{}, {} particles, {} scenes, {}".format(*work), *cells))
    red = [f"{row['case']} of {row['tree']}: {row['check']}" for row in rows if row["check"] != PASS]
    return "\n".join([aligned(("ms (range, ratio)", *trees), lines), *red])


def _work(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row.get(key) for key in WORK)


def _sources(name: str, scratch: Path, field: str) -> Path:
    """The tree's folder; a commit is checked out in a clone of the repository. Raises: ConfigError."""
    folder = Path(name).expanduser()
    if not folder.is_dir():
        folder = scratch
        try:
            top = _git("rev-parse", "--show-toplevel")
            commit = _git("rev-parse", "--verify", "--end-of-options", f"{name}^{{commit}}")
            _git("clone", "--quiet", "--shared", "--no-checkout", top, str(folder))
            _git("-C", str(folder), "checkout", "--quiet", commit)
        except (OSError, subprocess.CalledProcessError) as error:
            answer = (getattr(error, "stderr", "") or str(error)).strip()
            rule = "a folder, or a commit or branch of the repository here"
            raise ConfigError(f"{field} must be {rule}, got {name!r}; git says: {answer}") from None
    bench = folder / "tools" / "bench" / "__main__.py"
    require(bench.is_file(), field, "a tree with tools/bench", name, "name the folder above hgn and tools")
    return folder.resolve()


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], capture_output=True, check=True, text=True).stdout.strip()


if __name__ == "__main__":
    run_command(main, "compare")
