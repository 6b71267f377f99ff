"""Checks and times the contenders of tools.bench."""

import functools
import time
from collections.abc import Callable
from typing import Any

import torch

from hgn.runtime.backend import triton_unsupported_reason
from hgn.schema import from_mapping
from hgn.system.device import choose_device
from hgn.system.files import write_json
from hgn.system.progress import bar
from tools import report
from tools.bench.config import CASES, FRAME_CASES, TRAIN_CASES, BenchConfig
from tools.bench.contenders import Contender, Frame, MpmFrame, Train
from tools.bench.states import TILE_PARTICLES, Workload
from tools.bench.triton_contenders import TritonFrame, TritonTrain
from tools.report import EXIT_RED, PASS
from tools.timing import GpuMemory, Timed, alternate, free, matmul_precision, statistics

GPU_PARTICLES, GPU_SCENES = (TILE_PARTICLES, 40_000, 400_000), (1, 8, 32)
CPU_PARTICLES, CPU_SCENES = (TILE_PARTICLES,), (1,)
FRAME_CHECKED = 50_000  # particles of all scenes whose frame fits in float64
OUT_OF_MEMORY = "out of memory"
ROUNDS = 50  # samples of a contender
Row = dict[str, Any]


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON if `json` is given; the exit code is 1 if a check fails."""
    config = from_mapping(BenchConfig, mapping)
    device = choose_device(config.device)
    rows: list[Row] = []
    groups = [
        (precision, wanted, work)
        for precision in config.precisions or (("tf32", "fp16") if device.type == "cuda" else ("fp32",))
        for work in workloads(config, device)
        # larger scenes than the paper's are only simulated
        for cases in ((FRAME_CASES, TRAIN_CASES) if work.particles <= TILE_PARTICLES else (FRAME_CASES,))
        if (wanted := _wanted(config, device, precision, cases))
    ]
    meta = report.meta_of(config, device)
    with bar("timing", total=len(groups), unit="group") as progress:
        for group in groups:
            rows += group_rows(config, device, *group)
            progress.update()
            if config.json is not None:
                write_json(config.json, {"meta": meta, "rows": rows})
    print(table(rows))
    return 0 if all(row["check"] in (PASS, OUT_OF_MEMORY) for row in rows) else EXIT_RED


def workloads(config: BenchConfig, device: torch.device) -> list[Workload]:
    """Returns one scene of each number of particles, then several scenes of the smallest number."""
    gpu = device.type == "cuda"
    particles = config.particles or (GPU_PARTICLES if gpu else CPU_PARTICLES)
    scenes = config.scenes or (GPU_SCENES if gpu else CPU_SCENES)
    single = [Workload(count, 1) for count in particles] if 1 in scenes else []
    return single + [Workload(min(particles), count) for count in scenes if count != 1]


def group_rows(
    config: BenchConfig, device: torch.device, precision: str, cases: list[str], work: Workload
) -> list[Row]:
    """Returns the rows of contenders that take turns."""
    with matmul_precision(precision):
        prepared = [_prepare(config, device, precision, case, work) for case in cases]
        ready = [(row, contender) for row, contender in prepared if contender is not None]
        end = time.monotonic() + config.seconds
        times = alternate([contender for _, contender in ready], ROUNDS, lambda: time.monotonic() > end)
    for (row, contender), milliseconds in zip(ready, times, strict=True):
        if contender.failure is not None:
            row["check"] = contender.failure
            continue
        row |= statistics(milliseconds)
        if isinstance(contender, MpmFrame):
            row["substeps"] = contender.substeps
    return [row for row, _ in prepared]


def table(rows: list[Row]) -> str:
    """Returns a table of the rows."""
    named = ("case", "particles", "scenes", "precision")
    lines = []
    for row in rows:
        times = report.number(row["ms"], ".3f"), report.spread(row.get("ms_range"), ".3f")
        work = [row[name] for name in named]
        lines.append([*work, *times, report.number(row["memory_gb"], ".3f"), row["check"]])
    return report.table((*named, "ms", "range", "GB", "check"), lines)


def _prepare(
    config: BenchConfig, device: torch.device, precision: str, case: str, work: Workload
) -> tuple[Row, Timed | None]:
    """Checks a contender; returns its row, and the contender, or None if it fails."""
    row: Row = {"case": case, "particles": work.particles, "scenes": work.scenes}
    row |= {"precision": precision if case != "mpm_frame" else "fp32", "ms": None, "memory_gb": None}
    network = config.gns if "gns" in case else config.network
    try:
        if case == "mpm_frame":
            mpm = MpmFrame(work, config.network.cell_size, device)
            return row | {"particles": mpm.particles, "check": PASS}, mpm
        make, backend = _maker(config, device, precision, case)
        row |= {} if backend is None else {"backend": backend}
        fits = work.particles * work.scenes <= (FRAME_CHECKED if case in FRAME_CASES else TILE_PARTICLES)
        checked = work if fits else Workload(min(work.particles, TILE_PARTICLES), 1)
        row["check"] = make(network, checked, device, precision).check(precision)
        row["checked_particles"] = checked.particles * checked.scenes
        if row["check"] != PASS:
            return row, None
        memory = GpuMemory(device)
        contender = make(network, work, device, precision)
        contender.run()
        row["memory_gb"] = memory.peak_gb()
        return row, contender
    except torch.OutOfMemoryError:
        return row | {"check": OUT_OF_MEMORY}, None
    finally:
        free(device)


def _maker(
    config: BenchConfig, device: torch.device, precision: str, case: str
) -> tuple[Callable[..., Contender], str | None]:
    """Returns the class of a contender, and the name of its backend if it is an HGN."""
    frame = case in FRAME_CASES
    if case in ("frame", "train") and triton_unsupported_reason(device, config.network, precision) is None:
        return TritonFrame if frame else TritonTrain, "triton"
    backend = None if "gns" in case else "cpu" if case == "frame" and device.type == "cpu" else "torch"
    return functools.partial(Frame, backend=backend) if frame else Train, backend


def _wanted(config: BenchConfig, device: torch.device, precision: str, cases: tuple[str, ...]) -> list[str]:
    """Returns the chosen ones of `cases`, by default those that are useful here. Only backend triton computes fp16."""
    triton = triton_unsupported_reason(device, config.network, precision) is None
    if precision == "fp16":
        return [case for case in ("frame", "train") if triton and case in cases and case in (config.cases or CASES)]
    left_out = set() if triton or device.type == "cpu" else {"torch_frame"}  # here it equals frame
    left_out |= set() if triton else {"torch_train"}
    return [case for case in cases if (case in config.cases if config.cases else case not in left_out)]
