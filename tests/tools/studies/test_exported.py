"""Exported steps against the backend torch: what the study calls a pass."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tools.studies.exported import TOLERANCE, checked, distances


@pytest.mark.parametrize(
    ("errors", "verdict"),
    [((0.0, TOLERANCE), "pass"), ((0.0, 1.1 * TOLERANCE), "fail"), ((math.nan, 0.0), "fail"), ((math.inf,), "fail")],
)
def test_verdict(errors: tuple[float, ...], verdict: str) -> None:
    """All errors are within the tolerance; what is not finite is not."""
    assert checked(*errors) == verdict


def test_distances_are_root_mean_squares_by_frame() -> None:
    """Of two particles one is 3 and 4 off in frame 1: the root of 25 / 2; frames that there are not are left out."""
    found_TN3 = np.zeros((2, 2, 3))
    found_TN3[1, 0] = (3, 4, 0)
    assert distances(found_TN3, np.zeros((2, 2, 3))) == {"rms": {"1": pytest.approx(math.sqrt(12.5))}}
