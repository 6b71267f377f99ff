"""Contact by closed forms: what leaves an obstacle flies freely, what slides on it is braked by Coulomb's law."""

import pytest

from hgn.config import MpmConfig
from hgn.scene.material import MATERIALS, SAND, SNOW, WATER
from tools.stability.solver_contact import (
    FLIGHT_ERROR,
    FRICTION_ERRORS,
    FRICTIONS,
    Setting,
    acting_frictions,
    flight_errors,
    glued_below,
)

CELL = 1 / 16
CONFIG = MpmConfig(device="cpu")


def test_sheets_release() -> None:
    """Below a level sheet and leaving it, at gaps and speeds of all kinds, every material flies freely within 2 %."""
    settings = [Setting(0.0, "aligned", CELL), Setting(0.3, "aligned", CELL), Setting(0.5, "tilted", CELL)]
    cases = [(setting, material) for setting in settings for material in range(len(MATERIALS))]
    for case, errors in zip(cases, flight_errors(cases, CONFIG, 0.15), strict=True):
        assert max(errors.values()) <= FLIGHT_ERROR, (case, errors)


def test_nothing_is_glued_below_a_sheet() -> None:
    """Of water, sand and snow that fall onto a small sheet and around it, nothing stays just below it."""
    cases = [(Setting(offset, "aligned", CELL), material) for offset in (0.3, 0.5) for material in (WATER, SAND)]
    cases.append((Setting(0.3, "aligned", CELL), SNOW))
    assert glued_below(cases, CONFIG) == [0.0] * len(cases)


@pytest.mark.parametrize("friction", FRICTIONS)
def test_friction_acts_as_set(friction: float) -> None:
    """On a sheet sand and snow are braked by the coefficient that is set within 5 and 10 %; on a flat face sand too,
    wherever it lies between the nodes.
    """
    cases = [(Setting(offset, "aligned", CELL), False, kind) for offset in (0.0, 0.3, 0.5) for kind in (SAND, SNOW)]
    if friction == FRICTIONS[-1]:
        cases += [
            (Setting(offset, "aligned", CELL), True, SAND) for offset in (0, 0.2, 0.34, 0.36, 0.41, 0.5, 0.7, 0.9)
        ]
    for case, acting in zip(cases, acting_frictions(cases, friction, CONFIG), strict=True):
        assert acting == pytest.approx(friction, rel=FRICTION_ERRORS[case[2]]), case
