"""Tests emitters: particles fly freely from the face at the configured rate, and none is lost or added."""

import dataclasses

import numpy as np
import pytest
from mpm_scenes import CELL, CONFIG, particles, sheet, simulated

from datagen.mpm.solver import simulate
from hgn.scene.emission import Face, at_start, entry_frames
from hgn.scene.material import MATERIALS, SNOW, WATER
from hgn.schema import ConfigError

RATE_HZ = 60.0
STOP = 0.15


def jet(material, face, **scene):
    """40 particles of all materials, and far from them what enters through a face in 0.15 s; tests share one kernel."""
    rng = np.random.default_rng(0)
    body = rng.uniform(0.2, 0.28, (40, 3))
    place, time = face.draw(0.0, STOP, face.count(STOP, 8.0, CELL), rng)
    velocity = np.repeat([(0.0, 0.0, 0.0), face.velocity], [40, len(place)], axis=0)
    kinds = np.append(np.arange(40) % len(MATERIALS), np.full(len(place), material))
    entry = {"entry_s_N": np.concatenate([np.zeros(40), time]), "particles_per_cell": 8.0}
    return particles(np.concatenate([body, place]), kinds, velocity, **entry, **scene)


UP = Face((0.5, 0.35, 0.5), (0.3, 2.0, 0.0), radius=0.06)
ASIDE = Face((0.7, 0.65, 0.45), (-1.5, 0.0, 0.4), edges=(0.15, 0.1))


def test_what_enters_flies_freely_and_none_is_lost():
    """A face of area A at speed v emits rho A v t, to one particle at any time, and exactly at the end. For each
    material the centre of the emitted particles is that of free flight from the face, to 2e-4 of the path."""
    scenes = [jet(WATER, UP), jet(SNOW, ASIDE)]
    for scene, face, outcome in zip(scenes, (UP, ASIDE), simulated(scenes, frames=12), strict=True):
        late = scene.entry_s_N > 0
        rate = face.area * np.linalg.norm(face.velocity) * 8 / CELL**3
        assert late.sum() == round(rate * STOP)
        present_TN = np.isfinite(outcome.position_TN3).all(axis=2)
        assert present_TN[:, ~late].all() and present_TN[-1].all()
        for frame, present_N in enumerate(present_TN):
            time = frame / RATE_HZ
            assert abs(present_N[late].sum() - rate * min(time, STOP)) <= 1
            if present_N[late].sum():
                flight = np.maximum(time - scene.entry_s_N, 0)[:, None]
                way = flight * scene.velocity_N3 + 0.5 * flight**2 * np.array(scene.gravity)
                off = outcome.position_TN3[frame].astype(np.float64) - scene.position_N3 - way
                mine = late & present_N
                assert np.linalg.norm(off[mine].mean(axis=0)) < 2e-4 * np.linalg.norm(way[mine], axis=1).mean() + 1e-6


def test_emitters_leave_their_batch_alone():
    """In a batch with an emitter's scene, this scene and all others are bitwise equal to those simulated alone."""
    emitting = jet(WATER, UP)
    still = dataclasses.replace(emitting, entry_s_N=None)
    together = simulated([still, emitting, still], frames=6)
    for scene, outcome in zip((still, emitting, still), together, strict=True):
        (alone,) = simulated([scene], frames=6)
        assert np.array_equal(alone.position_TN3, outcome.position_TN3, equal_nan=True)
        assert alone.counters == outcome.counters


def test_an_obstacle_in_the_way_is_refused():
    """A sheet between the face and where particles are first seen would let them through."""
    with pytest.raises(ConfigError, match=r"emitters must be clear of obstacles for the first frame .* pass sheet"):
        simulate([jet(WATER, UP, obstacles=(sheet(0.36),))], CONFIG, 3, RATE_HZ)


def test_entry_frames():
    """A particle is seen first in the frame at its time of entry or after it; those of the start in frame 0."""
    scene = particles(np.full((4, 3), 0.5), entry_s_N=np.array([0.0, 0.001, 1 / 60, 0.02]))
    assert entry_frames(scene, 60.0).tolist() == [0, 1, 1, 2]


def test_selected_particles_keep_what_is_theirs():
    """Also the material's constants and the time of entry; without emitters a scene starts as it is."""
    given = particles(np.full((4, 3), 4.5 * CELL), WATER)
    constants = {"water_viscosity_pa_s": np.arange(4, dtype=np.float32)}
    scene = dataclasses.replace(given, material_parameters=constants, entry_s_N=np.array([0.0, 0.0, 0.1, 0.2]))
    assert at_start(given) is given
    for chosen, kept in ((np.array([False, True, True, False]), [1, 2]), (slice(2), [0, 1]), ([0, 0, 3], [0, 0, 3])):
        own = scene.selected(np.array(chosen) if isinstance(chosen, list) else chosen)
        assert own.particle_count == len(own.velocity_N3) == len(own.material_N) == len(kept)
        assert own.material_parameters["water_viscosity_pa_s"].tolist() == kept
        assert own.entry_s_N.tolist() == scene.entry_s_N[kept].tolist()
    first = at_start(scene)
    assert first.entry_s_N is None and first.material_parameters["water_viscosity_pa_s"].tolist() == [0, 1]
