"""Tests contact against closed forms: free flight away from an obstacle, and sliding with Coulomb friction."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from datagen.mpm.solver import simulate
from hgn.config import MpmConfig
from hgn.scene.material import ELASTIC, MATERIALS, SAND, SNOW, WATER
from tools.stability import solver_contact
from tools.stability.solver_contact import (
    DOMAIN_CELLS,
    FLIGHT_ERROR,
    FRAME_RATE_HZ,
    FRICTION_ERRORS,
    FRICTIONS,
    GRAVITY,
    Setting,
    acting_frictions,
    block,
    body,
    centres,
    flight_errors,
    glued_below,
    sheet,
)

CELL = 1 / 16
CONFIG = MpmConfig(device="cpu")


def test_sheets_release():
    """Below a level sheet and leaving it, at gaps and speeds of all kinds, every material flies freely within 2 %."""
    settings = [Setting(0.0, "aligned", CELL), Setting(0.3, "tilted", CELL)]
    cases = [(setting, material) for setting in settings for material in range(len(MATERIALS))]
    for case, errors in zip(cases, flight_errors(cases, CONFIG, 0.15), strict=True):
        assert max(errors.values()) <= FLIGHT_ERROR, (case, errors)


def test_nothing_is_glued_below_a_sheet(monkeypatch):
    """Of all materials that fall onto a small sheet and around it, nothing stays just below it."""
    monkeypatch.setattr(solver_contact, "FALLING_CELLS", (5.0, 2.0, 5.0))
    cases = [(Setting(0.5 if kind == SAND else 0.3, "aligned", CELL), kind) for kind in (WATER, SAND, SNOW, ELASTIC)]
    assert glued_below(cases, CONFIG) == [0.0] * len(cases)


def test_what_hangs_below_a_sheet_is_seen(monkeypatch):
    """Of three particles half a cell below a sheet the one that stays counts; one that falls, one that goes do not."""
    setting = Setting(0.3, "tilted", CELL)

    def drift(scenes, config, frames, rate):
        way = np.array([[0, 0, 0], [0, -0.1, 0], [0.1, 0, 0]])  # cells a frame, after the first look
        after = np.maximum(np.arange(frames) - 72, 0)[:, None, None]
        place = (np.array([0, -0.5, 0]) + after * way).reshape(-1, 3)
        return [SimpleNamespace(position_TN3=setting.place(place).reshape(frames, 3, 3))]

    monkeypatch.setattr(solver_contact, "simulate", drift)
    assert glued_below([(setting, SNOW)], CONFIG) == [pytest.approx(1 / 3)]


@pytest.mark.parametrize("friction", (FRICTIONS[0], FRICTIONS[-1]))
def test_friction_acts_as_set(friction):
    """On a sheet and the domain's floor sand and snow are braked by the coefficient that is set within 5 and 10 %; on a
    flat face sand too, wherever it lies between the nodes.
    """
    last = friction == FRICTIONS[-1]
    offsets, of_bodies = ((0.0, 0.5), (0.34, 0.36)) if last else ((0.3,), ())
    cases = [(Setting(offset, "aligned", CELL), "sheet", kind) for offset in offsets for kind in (SAND, SNOW)]
    cases += [(Setting(0.0, "aligned", CELL), "floor", kind) for kind in (SAND, SNOW)[: 2 * last]]
    cases += [(Setting(offset, "aligned", CELL), "body", SAND) for offset in of_bodies]
    for case, acting in zip(cases, acting_frictions(cases, friction, CONFIG), strict=True):
        assert acting == pytest.approx(friction, rel=FRICTION_ERRORS[case[2]]), case


def test_inclined_planes():
    """A block of snow on a sheet, a body or the domain's floor that slopes by 25 degrees lies still where the surface's
    own friction is more than the slope, and slides by g (sin t - mu cos t), to 3 %, where it is less.
    """
    slope, rough, smooth = math.radians(25.0), 0.8, 0.2
    gravity = (GRAVITY * math.sin(slope), -GRAVITY * math.cos(slope), 0.0)
    setting, size = Setting(0.3, "aligned", CELL), (6.0, 2.0, 4.0)
    scenes = []
    for friction in (rough, smooth):
        for surface in (sheet, body):
            obstacle = dataclasses.replace(surface(setting), friction=friction)
            scenes.append(block(setting, SNOW, (-11.0, 0.5, -2.0), size, (obstacle,), gravity=gravity))
        floor = block(setting, SNOW, (-11.0, 3.3 - DOMAIN_CELLS / 2, -2.0), size, (), gravity=gravity)
        scenes.append(dataclasses.replace(floor, wall_friction=(0.0, friction, 0.0)))
    first, frames = round(0.4 * FRAME_RATE_HZ), round(0.6 * FRAME_RATE_HZ)
    outcomes = simulate(scenes, CONFIG, frames, FRAME_RATE_HZ)
    for index, outcome in enumerate(outcomes):
        way = centres(setting, outcome)[first:, 0]
        if index < len(scenes) // 2:
            assert abs(way[-1] - way[0]) < 0.05 * CELL, index
        else:
            acceleration = 2 * np.polyfit(np.arange(len(way)) / FRAME_RATE_HZ, way, 2)[0]
            expected = GRAVITY * (math.sin(slope) - smooth * math.cos(slope))
            assert acceleration == pytest.approx(expected, rel=0.03), index
