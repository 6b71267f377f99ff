"""Paired comparison of two contenders: differences of errors scene by scene, with bootstrap intervals.

Median and mean of the differences are resampled over scenes; intervals are percentiles.
Shape legend: S scenes, B resamplings.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from hgn.config import NETWORK_KINDS
from tools import report
from tools.error_vs_time.score import label

RESAMPLINGS, COVERED = 10_000, 0.95
STATISTICS: dict[str, Callable[..., Any]] = {"median": np.median, "mean": np.mean}
NETWORK_SYSTEMS = (*NETWORK_KINDS, "gns_particles")  # the last only in reports before 0.2.0
Row = Mapping[str, Any]


def paired_difference(one_S: Sequence[float | None], other_S: Sequence[float | None]) -> dict[str, Any] | None:
    """Compares errors of the scenes in which both have one; returns None for fewer than two scenes.

    Returns {"scenes", "median": [difference, low, high], "median_says", "mean", "mean_says"}.
    """
    pairs = [(a, b) for a, b in zip(one_S, other_S, strict=False) if a is not None and b is not None]
    if len(pairs) < 2:
        return None
    difference_S = np.array([a - b for a, b in pairs])
    drawn_BS = difference_S[_draws(len(pairs))]
    result: dict[str, Any] = {"scenes": len(pairs)}
    for name, statistic in STATISTICS.items():
        low, high = np.percentile(statistic(drawn_BS, axis=1), (50 * (1 - COVERED), 50 * (1 + COVERED))).tolist()
        result[name] = [float(statistic(difference_S)), low, high]
        result[f"{name}_says"] = "nearer" if high < 0 else "farther" if low > 0 else "no difference shown"
    return result


def paired_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Compares every network with every GNS, every setting of the solver, and later networks of the same kind and
    precision with other weights. A row is {"one", "other", "error", "frame"} and a `paired_difference`.
    """
    scored = [row for row in rows if row.get("by_scene")]
    pairs = []
    for i, one in enumerate(scored):
        if one["system"] not in NETWORK_SYSTEMS:
            continue
        later = [row for row in scored[i + 1 :] if row["system"] == one["system"] == "hgn"]
        alike = [r for r in later if r["weights"] != one["weights"] and r["precision"] == one["precision"]]
        others = [row for row in scored if row["system"] in (*NETWORK_SYSTEMS[1:], "mpm") and row is not one]
        for other in (*alike, *others):
            for error, values in one["by_scene"].items():
                for frame in values.keys() & other["by_scene"].get(error, {}).keys():
                    difference = paired_difference(values[frame], other["by_scene"][error][frame])
                    if difference is not None:
                        named = {"one": label(one), "other": label(other), "error": error, "frame": frame}
                        pairs.append(named | difference)
    return sorted(pairs, key=lambda row: (row["one"], row["other"], row["error"], int(row["frame"])))


def paired_table(rows: Sequence[Row]) -> str:
    """Returns paired rows as a table: differences and their intervals over scenes."""
    head = ("one", "other", "error", "frame", "scenes", *(f"{name} ({COVERED:.0%} interval)" for name in STATISTICS))
    form = "{:+.2g} ({:+.2g} to {:+.2g})"
    lines = [[*(row[c] for c in head[:5]), *(form.format(*row[name]) for name in STATISTICS)] for row in rows]
    return report.table(head, lines)


@functools.cache
def _draws(scenes: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, scenes, (RESAMPLINGS, scenes))
