"""python -m tools.bench [--json FILE]: times of a frame, a training step and the solver, beside each other.

Prints no time of what fails its check. The JSON holds {"meta": provenance, "rows": [...]}.
"""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from hgn.command import run_command
from hgn.runtime.backend import set_matmul_precision, training_unsupported_reason, triton_unsupported_reason
from hgn.schema import from_mapping, to_mapping
from hgn.system.device import choose_device
from hgn.system.files import write_json
from hgn.system.progress import bar
from hgn.system.provenance import provenance, without_folders
from tools.bench.config import CASES, PUBLIC_GNS_CASES, BenchConfig
from tools.bench.contenders import PASS, Frame, MpmFrame, Train, checked_workload
from tools.bench.public_gns import PublicFrame, PublicTrain
from tools.bench.states import TILE_PARTICLES, Workload
from tools.bench.timing import Timed, alternate
from tools.bench.triton_contenders import TritonFrame, TritonTrain

GPU_PARTICLES, GPU_SCENES = (TILE_PARTICLES, 40_000, 400_000), (1, 8, 32)
CPU_PARTICLES, CPU_SCENES = (TILE_PARTICLES,), (1,)
OUT_OF_MEMORY = "out of memory"
EXIT_RED = 1
FRAME_CASES = ("frame", "torch_frame", "gns_frame", "public_gns_frame", "mpm_frame")
TRAIN_CASES = ("train", "torch_train", "gns_train", "public_gns_train")
Contender = Frame | Train | TritonFrame | TritonTrain | PublicFrame | PublicTrain


@dataclass
class Entry:
    """A row in the making."""

    row: dict[str, Any]
    timed: Timed | None = None
    contender: Any = field(default=None, repr=False)


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON where asked to; the exit code is 1 where a check is red."""
    config = from_mapping(BenchConfig, mapping)
    device = choose_device(config.device)
    rows: list[dict[str, Any]] = []
    groups = [
        (precision, cases, work)
        for precision in config.precisions or (("tf32", "fp16") if device.type == "cuda" else ("fp32",))
        for work in workloads(config, device)
        for cases in (FRAME_CASES, TRAIN_CASES)
        if _wanted(config, device, precision, cases) and _meant(cases, work)
    ]
    meta = provenance(device) | {"config": without_folders(to_mapping(config))}
    with bar("timing", total=len(groups), unit="group") as progress:
        for precision, cases, work in groups:
            rows += group_rows(config, device, precision, _wanted(config, device, precision, cases), work)
            progress.update()
            if config.json is not None:  # after each: what a later group does takes nothing away
                write_json(config.json, {"meta": meta, "rows": rows})
    print(table(rows))
    return 0 if all(row["check"] in (PASS, OUT_OF_MEMORY) for row in rows) else EXIT_RED


def workloads(config: BenchConfig, device: torch.device) -> list[Workload]:
    """One scene of each number of particles, then several scenes of the smallest number."""
    gpu = device.type == "cuda"
    particles = config.particles or (GPU_PARTICLES if gpu else CPU_PARTICLES)
    scenes = config.scenes or (GPU_SCENES if gpu else CPU_SCENES)
    single = [Workload(count, 1) for count in particles] if 1 in scenes else []
    return single + [Workload(min(particles), count) for count in scenes if count != 1]


def group_rows(
    config: BenchConfig, device: torch.device, precision: str, cases: list[str], work: Workload
) -> list[dict[str, Any]]:
    """The rows of contenders that are timed in turns."""
    before = torch.get_float32_matmul_precision()
    set_matmul_precision(precision)
    try:
        entries = [_prepare(config, device, precision, case, work) for case in cases]
        ready = [entry.timed for entry in entries if entry.timed is not None]
        if ready:
            alternate(ready, config.rounds, config.seconds)
        for entry in entries:
            _finish(entry)
        return [entry.row for entry in entries]
    finally:
        torch.set_float32_matmul_precision(before)


def table(rows: list[dict[str, Any]]) -> str:
    """The figures for people."""
    lines = [
        f"{'case':<16} {'particles':>9} {'scenes':>6} {'precision':>9} {'ms':>10} {'quartiles':>19} {'GB':>7}  check"
    ]
    for row in rows:
        ms = "-" if row["ms"] is None else f"{row['ms']:.3f}"
        spread = "-" if row["ms"] is None else f"{row['ms_quartiles'][0]:.3f} … {row['ms_quartiles'][1]:.3f}"
        memory = "-" if row["memory_gb"] is None else f"{row['memory_gb']:.3f}"
        lines.append(
            f"{row['case']:<16} {row['particles']:>9} {row['scenes']:>6} {row['precision']:>9} {ms:>10} {spread:>19} "
            f"{memory:>7}  {row['check']}"
        )
    return "\n".join(lines)


def _prepare(config: BenchConfig, device: torch.device, precision: str, case: str, work: Workload) -> Entry:
    row: dict[str, Any] = {"case": case, "particles": work.particles, "scenes": work.scenes}
    row |= {"precision": precision if case != "mpm_frame" else "fp32", "ms": None, "memory_gb": None}
    network = config.gns if "gns" in case else config.network
    try:
        if case == "mpm_frame":
            mpm = MpmFrame(work, config, device)
            return Entry(row | {"particles": mpm.particles, "check": PASS}, mpm.timed(), mpm)
        make, backend = _maker(config, device, precision, case)
        row |= {} if backend is None else {"backend": backend}
        checked = checked_workload(work, "frame" if case.endswith("frame") else "train")
        row["check"] = make(network, checked, device).check(precision)
        row["checked_particles"] = checked.particles * checked.scenes
        if row["check"] != PASS:
            return Entry(row)
        start = _clean(device)
        contender = make(network, work, device)
        contender.run()
        if start is not None:
            row["memory_gb"] = (torch.cuda.max_memory_allocated(device) - start) / 1e9
        return Entry(row, contender.timed(), contender)
    except torch.OutOfMemoryError:
        return Entry(row | {"check": OUT_OF_MEMORY})
    finally:
        _clean(device)


def _maker(
    config: BenchConfig, device: torch.device, precision: str, case: str
) -> tuple[Callable[..., Contender], str | None]:
    """What makes the contender from configuration, workload and device, and the backend of ours."""
    frame = case.endswith("frame")
    if config.public_gns is not None and case in PUBLIC_GNS_CASES:
        return functools.partial(PublicFrame if frame else PublicTrain, Path(config.public_gns)), None
    if case in ("frame", "train") and triton_unsupported_reason(device, config.network, precision) is None:
        return functools.partial(TritonFrame if frame else TritonTrain, precision), "triton"
    if case == "gns_train" and training_unsupported_reason(device, config.gns, precision) is None:
        return functools.partial(TritonTrain, precision), "triton"
    if not frame:
        return functools.partial(Train, precision=precision), None if "gns" in case else "torch"
    fastest = "cpu" if case == "frame" and device.type == "cpu" else "torch"
    backend = None if "gns" in case else fastest
    return functools.partial(Frame, precision=precision, backend=backend), backend


def _wanted(config: BenchConfig, device: torch.device, precision: str, cases: tuple[str, ...]) -> list[str]:
    """Those of `cases` that are asked for and mean something; fp16 is backend triton's and our GNS's alone."""
    triton = triton_unsupported_reason(device, config.network, precision) is None
    fastest_differs = {"torch_frame": triton or device.type == "cpu", "torch_train": triton}  # from torch
    wanted = config.cases or tuple(
        case
        for case in CASES
        if fastest_differs.get(case, True) and (config.public_gns is not None or case not in PUBLIC_GNS_CASES)
    )
    if precision == "fp16":
        known = (("frame", "train") if triton else ()) + ("gns_frame", "gns_train")
        wanted = tuple(case for case in known if case in wanted)
    return [case for case in cases if case in wanted]


def _finish(entry: Entry) -> None:
    if isinstance(entry.contender, MpmFrame | TritonFrame) and entry.contender.failure is not None:
        entry.row["check"] = entry.contender.failure
    if entry.timed is not None and entry.row["check"] == PASS:
        low, middle, high = entry.timed.quartiles()
        entry.row |= {"ms": middle, "ms_quartiles": [low, high], "samples": len(entry.timed.milliseconds)}
        if isinstance(entry.contender, MpmFrame):
            entry.row["substeps"] = entry.contender.substeps
    entry.timed = entry.contender = None


def _clean(device: torch.device) -> int | None:
    """Frees what is no longer used; returns the bytes still allocated on a GPU, and starts its peak from there."""
    gc.collect()
    if device.type != "cuda":
        return None
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(device)
    return torch.cuda.memory_allocated(device)


def _meant(cases: tuple[str, ...], work: Workload) -> bool:
    return cases is not TRAIN_CASES or work.particles <= TILE_PARTICLES  # the paper's scenes; others are simulated only


if __name__ == "__main__":
    run_command(main, "bench")
