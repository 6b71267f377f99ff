"""Compares the measures of a case with its limits."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from tools.report import finite
from tools.stability.case import Case, Limit, Outcome
from tools.stability.measures import MEASURES
from tools.stability.observables import series
from tools.stability.row import Row


def row_of(outcome: Outcome, more: dict[str, Any]) -> Row:
    """Measures an outcome and compares the figures with the case's limits."""
    case, solver = outcome.case, outcome.solver
    causes = [trial.cause for trial in outcome.trials if trial.cause is not None]
    all_finite = all(bool(np.isfinite(trial.position_TN3).all()) for trial in outcome.trials)
    names = dict.fromkeys([limit.measure.partition(".")[0] for limit in case.limits] + list(case.also))
    if case.reported is not None and causes:  # closed forms need complete trajectories
        names = {}
    figures = {name: MEASURES[name](outcome) for name in names}
    references = {name: MEASURES[name](solver) for name in names} if solver is not None else {}
    failure = causes[0] if causes else None
    if failure is None and not all_finite:
        failure = "positions are not finite, and the runtime did not report it"
    for limit in case.limits if failure is None else ():
        failure = failure or violation(limit, figures, references, solver is not None)
    count = sum(len(scene.position_N3) for scene in outcome.scenes)
    row: dict[str, Any] = {"particles": count, "scenes": len(outcome.scenes)}
    row |= {"domain_size": list(outcome.scenes[0].domain_size), "failed_scenes": len(causes)}
    # whether the runtime reported positions that are not finite
    row["guard"] = "missed" if not all_finite else "raised" if causes else "not needed"
    row |= figures | {f"solver_{name}": value for name, value in references.items()} | more
    predicted, measured = case.frames, min(trial.frame_count for trial in outcome.trials)
    if case.reported is None:
        return Row(case.name, predicted, measured, failure is None, failure or "nothing seen", row)
    value = "diverged" if causes else finite(figures[case.reported])
    value = "not finite" if value is None else value
    return Row(case.name, _bound(case), value, failure is None, failure or "within all limits", row)


def refused(case: Case, cause: str) -> list[Row]:
    """Returns the rows of a case with scenes that the weights refuse."""
    if case.gallery is None:
        return [Row(case.name, _bound(case), "refused", False, cause)]
    bounds = case.gallery.measure.bounds
    return [Row(f"{case.name}: {bound.label}", "simulated", "refused", False, cause) for bound in bounds]


def gallery_rows(outcome: Outcome, more: dict[str, Any]) -> list[Row]:
    """Measures the trajectory of a gallery scene, and compares each figure with its bounds."""
    case, gallery, trials = outcome.case, outcome.case.gallery, outcome.trials
    assert gallery is not None
    cause = next((trial.cause for trial in trials if trial.cause is not None), None)
    film = gallery.film(case.scenes[0], [trial.position_TN3 for trial in trials], outcome.frame_rate_hz)
    measured: dict[str, list[float]] = {}
    rows = []
    for bound, solver in zip(gallery.measure.bounds, case.references, strict=True):
        low, high = bound.interval(solver)
        details: dict[str, Any] = {"scene": case.name, "kind": gallery.measure.kind, "observable": bound.of}
        details |= {"low": low, "high": high, "solver": solver} | more
        name, predicted = f"{case.name}: {bound.label}", interval_text(low, high, digits=5)
        if cause is not None:
            rows.append(Row(name, predicted, "diverged", False, cause, details))
            continue
        if bound.key not in measured:
            measured[bound.key] = series(film, bound)
        figure = bound.reduced(measured[bound.key])
        passes = low <= figure <= high
        note = f"{'within' if passes else 'outside of'} its bounds; solver {solver:.5g}"
        rows.append(Row(name, predicted, figure if math.isfinite(figure) else "none", passes, note, details))
    return rows


def _bound(case: Case) -> float:
    return next((limit.high for limit in case.limits if limit.measure == case.reported), case.frames)


def violation(limit: Limit, figures: dict[str, Any], references: dict[str, Any], solved: bool) -> str | None:
    """Returns the figure that is farthest beyond a limit, as a sentence; None if all are within."""
    name, _, field = limit.measure.partition(".")
    own, solver = figures[name], references.get(name)
    if own is None or (solved and solver is None):
        return f"{name}: the {'network' if own is None else 'solver'} did not come to the end"
    worst, sentence = 0.0, None
    reference = dict(_values(solver, field)) if solved else {}
    for where, value in _values(own, field):
        base = reference.get(where, 0.0)
        low = limit.low + (limit.below * base if limit.below else 0.0)
        high = limit.high + (limit.above * base if limit.above else 0.0)
        excess = max(low - value, value - high)
        if not excess <= worst:  # NaN fails
            worst = excess
            allowed = f"must be {interval_text(low, high)}"
            sentence = f"{limit.measure.replace('_', ' ')}{where} {value:.3g}, {allowed}"
            sentence += f" (solver {base:.3g})" if limit.below or limit.above else ""
    return sentence


def _values(figure: Any, field: str) -> Iterator[tuple[str, float]]:
    """Yields each record's scene and frame in words, such as " (scene 0, frame 9)", and its value."""
    for record in figure if isinstance(figure, list) else [figure]:
        if not isinstance(record, dict):
            yield "", record
        elif record[field] is not None:
            places = [f"{key} {record[key]}" for key in ("scene", "frame") if key in record]
            yield f" ({', '.join(places)})" if places else "", record[field]


def interval_text(low: float, high: float, digits: int = 3) -> str:
    """Returns two bounds in words."""
    least, most = f"{low:.{digits}g}", f"{high:.{digits}g}"
    if low == -math.inf:
        return f"at most {most}"
    return f"at least {least}" if high == math.inf else f"{least} to {most}"
