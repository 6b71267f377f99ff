"""What a report says in words: networks beside each other, beside predictors that learn nothing, and the solver."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hgn.config import NETWORK_KINDS
from hgn.training.errors import format_ratio
from tools.error_vs_time.score import label

Row = Mapping[str, Any]


def comparisons(rows: Sequence[Row]) -> list[str]:
    """Lines for people, from the rows of a report."""
    networks = [row for row in rows if row["system"] in NETWORK_KINDS]
    baselines = [row for row in rows if row["system"] == "baseline" and row["one_step_mse"]]
    return [
        *_one_step(networks, baselines),
        *_beside_gns(networks),
        *_beside_solver(networks, [row for row in rows if row["system"] == "mpm" and row.get("ms")]),
        *_penetration(networks),
    ]


def _one_step(networks: Sequence[Row], baselines: Sequence[Row]) -> list[str]:
    """Of each network at each precision, over all particles and by material."""
    if not networks or not baselines:
        return []
    best = min(baselines, key=lambda row: row["one_step_mse"])
    lines = ["", f"one-step MSE beside the best baseline ({best['predictor']}, {best['one_step_mse']:.2e})"]
    for row in networks:
        parts = []
        for material, mse in row["one_step_by_material"].items():
            least = min(other["one_step_by_material"][material] for other in baselines)
            parts.append(f"{material} {mse:.2e}, {_gain(least, mse)}")
        told = f"{row['one_step_mse']:.2e}, {_gain(best['one_step_mse'], row['one_step_mse'])}"
        lines.append(f"  {label(row)}: {told} ({'; '.join(parts)})")
    return lines


def _beside_gns(networks: Sequence[Row]) -> list[str]:
    """Every HGN beside every GNS, each at its fastest precision where they are timed."""
    fastest = _fastest(networks)
    lines = []
    for gns in (row for row in fastest if row["system"] != "hgn"):
        lines += ["", f"beside {label(gns)}"]
        for hgn in (row for row in fastest if row["system"] == "hgn"):
            told = [f"one-step MSE {_gain(gns['one_step_mse'], hgn['one_step_mse'])}"]
            for frame in sorted(set(gns["position_mse"]) & set(hgn["position_mse"]), key=int):
                told.append(f"after {frame} frames {_gain(gns['position_mse'][frame], hgn['position_mse'][frame])}")
            if hgn.get("ms") and gns.get("ms"):
                told.append(_speed(gns["ms"] / hgn["ms"]))
            lines.append(f"  {label(hgn)}: {', '.join(told)}")
    return lines


def _beside_solver(networks: Sequence[Row], solvers: Sequence[Row]) -> list[str]:
    """Each network beside the fastest setting of the solver, and the fastest that is no less accurate."""
    timed = [row for row in _fastest(networks) if row.get("ms")]
    if not timed or not solvers:
        return []
    quickest = min(solvers, key=lambda row: row["ms"])
    lines = ["", "beside the solver: its fastest setting, and its fastest of at most the network's error"]
    for row in timed:
        told = [f"{_speed(quickest['ms'] / row['ms'])} as {label(quickest)}"]
        for frame in sorted(row["position_mse"], key=int):
            mse = row["position_mse"][frame]
            good = [other for other in solvers if other["position_mse"].get(frame, float("inf")) <= mse]
            if good:
                least = min(good, key=lambda other: other["ms"])
                told.append(f"for the error after {frame} frames {_speed(least['ms'] / row['ms'])} as {label(least)}")
            else:
                told.append(f"after {frame} frames no setting's mean is as low")
        lines.append(f"  {label(row)}: {', '.join(told)}")
    return lines


def _penetration(networks: Sequence[Row]) -> list[str]:
    if not networks:
        return []
    lines = ["", "particles within obstacles at the end: of all scenes, in the worst one, and the solver's own"]
    for row in networks:
        worst = row["worst_penetration"]
        there = f"{worst['fraction']:.3%} in {worst['episode']}, where the solver has {worst['reference']:.3%}"
        own = f"{row['reference_penetration']:.3%}, {worst['reference_worst']:.3%} in its worst scene"
        lines.append(f"  {label(row)}: {row['penetration']:.3%}, {there}; the solver {own}")
    return lines


def _fastest(networks: Sequence[Row]) -> list[Row]:
    """One row of each weights file, in the report's order."""
    chosen: dict[str, Row] = {}
    for row in networks:
        known = chosen.get(row["weights"])
        if known is None or (row.get("ms") or float("inf")) < (known.get("ms") or float("inf")):
            chosen[row["weights"]] = row
    return list(chosen.values())


def _gain(other: float, mse: float) -> str:
    return format_ratio(other / mse) if mse > 0 else "no error"


def _speed(times: float) -> str:
    return f"{times:.1f} times as fast" if times >= 1 else f"{1 / times:.1f} times as slow"
