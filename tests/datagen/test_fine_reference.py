"""Scenes simulated on a finer grid than their episodes show (dataset.reference_cells)."""

import dataclasses
import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import written_files
from mpm_scenes import BOX, CELL, CONFIG, block, box_corners, joined, particles, sheet, simulated
from written_files import Recorder, hashes

from datagen.fine import fine_scene, solver_on_grid, visible_positions
from datagen.pool.local_workers import LocalWorkerFactory
from datagen.pool.plan import SceneTask, scene_seed
from datagen.pool.pool import Pool
from datagen.pool.worker import make_scene, simulate_batch
from datagen.pool.worker_plan import WorkerPlan, gpu_scenes_per_launch
from datagen.pool.writer import DatasetWriter
from hgn.card import data_card
from hgn.config import DatagenConfig, DatasetConfig, MpmConfig, SceneConfig
from hgn.data.identity import dataset_identity
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.scene.scene import Obstacle
from hgn.schema import ConfigError

pytestmark = pytest.mark.usefixtures("solver_kernels")

WALL = (CONFIG.wall_cells - 1) * CELL  # where walls end


def drop():
    """Water falling beside a snow cube."""
    water = block(0, (0.25, 0.4, 0.3), (0.45, 0.6, 0.5), (0.5, 0, 0), particles_per_cell=8.0)
    return joined(water, block(2, (0.6, 0.3, 0.4), (0.75, 0.45, 0.55), seed=1))


def test_ratio_one_is_the_scene_itself():
    """On its own grid nothing changes: scene, settings and positions are the same objects."""
    scene = drop()
    assert fine_scene(scene, CELL, WALL) is scene
    assert solver_on_grid(CONFIG, CELL, CELL) == CONFIG
    position = scene.position_N3[None]
    assert visible_positions(position, scene.particle_count) is position


@pytest.mark.parametrize(("ratio", "children"), [(1.5, 3), (2, 8), (3, 27)])
def test_children_of_a_particle(ratio, children):
    """Mass, momentum, centre of mass and density of a scene do not depend on the grid."""
    scene = drop()
    fine = fine_scene(scene, CELL / ratio, WALL)
    assert fine.particle_count == children * scene.particle_count
    assert fine.particles_per_cell == pytest.approx(8 * children / ratio**3)
    child = fine.position_N3.reshape(-1, children, 3)
    assert np.array_equal(child[:, 0], scene.position_N3)
    assert np.abs(child.mean(axis=1, dtype=np.float64) - scene.position_N3).max() < 1e-7
    assert 0.1 * CELL < np.abs(child - child[:, :1]).max() < 0.5 * CELL
    assert np.array_equal(fine.velocity_N3.reshape(-1, children, 3)[:, -1], scene.velocity_N3)
    assert np.array_equal(fine.material_N.reshape(-1, children)[:, -1], scene.material_N)


def test_children_stay_clear_of_obstacles_and_walls():
    """A child begins on its particle's side of a sheet and of the walls, with the same mean."""
    height = 0.4
    place = np.random.default_rng(0).uniform((WALL, 0.38, WALL), (WALL + 0.05, 0.42, WALL + 0.05), (400, 3))
    place = place[np.abs(place[:, 1] - height) > 1e-4]
    scene = particles(place, obstacles=(sheet(height),), particles_per_cell=8.0)
    child = fine_scene(scene, CELL / 2, WALL).position_N3.reshape(-1, 8, 3)
    assert (np.sign(child[:, :, 1] - height) == np.sign(scene.position_N3[:, None, 1] - height)).all()
    assert child[:, :, [0, 2]].min() >= WALL - 1e-7
    assert np.abs(child.mean(axis=1, dtype=np.float64) - scene.position_N3).max() < 1e-7


def test_walls_are_at_the_same_place():
    """The last node of a wall keeps its place on every finer grid that is allowed."""
    for ratio in (1, 1.5, 2, 2.5, 3):
        assert (solver_on_grid(MpmConfig(), 1 / (64 * ratio), 1 / 64).wall_cells - 1) / ratio == 2
    assert [solver_on_grid(MpmConfig(), 1 / grid, 1 / 64).wall_cells for grid in (32, 48)] == [2, 2]


def test_visible_particles_are_first_children():
    """Positions of all frames are those of the first child of each particle, bitwise."""
    child = np.random.default_rng(0).random((4, 5, 3, 3)).astype(np.float32)
    visible = visible_positions(child.reshape(4, 15, 3), 5)
    assert np.array_equal(visible, child[:, :, 0]) and visible.flags.c_contiguous
    assert visible_positions(np.zeros((4, 0, 3), np.float32), 0).shape == (4, 0, 3)


def refined(scene, ratio, frames=8):
    """The fine trajectory and the visible one."""
    fine = fine_scene(scene, CELL / ratio, WALL)
    config = solver_on_grid(CONFIG, CELL / ratio, CELL)
    (outcome,) = simulated([fine], config, frames)
    return outcome.position_TN3, visible_positions(outcome.position_TN3, scene.particle_count)


def test_the_solver_returns_first_children():
    """With `children` the solver's result has the bytes of the visible particles, in memory of its own. Its counters
    still count all particles, which emitted ones are only once they have entered.
    """
    scene = fine_scene(drop(), CELL / 2, WALL)
    low, high = scene.position_N3.min(axis=0), scene.position_N3.max(axis=0)
    box = Obstacle("box", box_corners(low, (low + high) / 2), BOX, True)
    entry_s_N = np.repeat([0.0, 2.5 / 60], [800, scene.particle_count - 800])
    for given in (dataclasses.replace(scene, obstacles=(box,)), dataclasses.replace(scene, entry_s_N=entry_s_N)):
        config = solver_on_grid(CONFIG, CELL / 2, CELL)
        (whole,), (visible,) = simulated([given], config, 5), simulated([given], config, 5, children=8)
        own = visible_positions(whole.position_TN3, scene.particle_count // 8)
        assert visible.position_TN3.tobytes() == own.tobytes() and visible.position_TN3.base is None
        assert visible.counters == whole.counters
        assert np.isnan(own[2]).any() == (given.entry_s_N is not None) and not np.isnan(own[3]).any()
        assert (whole.counters["particles_inside_obstacles_at_start"] % 8 != 0) == bool(given.obstacles)


def test_visible_particles_represent_the_material():
    """In free flight visible snow moves by v t + g t² / 2; after an impact they have the spread and speed of all,
    up to sampling."""
    scene, time_T11 = drop(), np.arange(5)[:, None, None] / 60
    fine, visible = (position.astype(np.float64) for position in refined(scene, 2, 20))
    path_TN3 = scene.position_N3 + time_T11 * scene.velocity_N3 + 0.5 * time_T11**2 * np.array(scene.gravity)
    assert np.abs(visible[:5] - path_TN3)[:, scene.material_N == 2].max() < 2e-6
    for each in (lambda x: x[-1].std(axis=0), lambda x: np.sqrt(np.square(x[-1] - x[-2]).mean(axis=0))):
        assert each(visible) == pytest.approx(each(fine), rel=3 / np.sqrt(visible.shape[1]))


def test_a_dam_break_converges():
    """Two finer grids differ less from each other than the coarse grid from the finer of them."""
    scene = block(0, (WALL,) * 3, (WALL + 0.25, WALL + 0.3, WALL + 0.2), particles_per_cell=8.0)
    coarse, fine, finer = (refined(scene, ratio, 20)[1][-1] for ratio in (1, 1.5, 2))
    assert np.square(fine - finer).sum(axis=1).mean() < np.square(coarse - finer).sum(axis=1).mean()


def data_set(**dataset):
    return DatagenConfig(dataset=DatasetConfig(**dataset))


def test_identity_names_the_grid():
    """The data set's identity has the grid and the rule; on the visible grid it is as without the setting."""
    assert dataset_identity(data_set(reference_cells=64)) == dataset_identity(data_set())
    named = dataset_identity(data_set(reference_cells=128))["reference"]
    assert named == {"cells": 128, "particles_per_visible": 8, "visible": "first child"}
    assert data_set(reference_cells=96).reference["particles_per_visible"] == 3
    json.dumps(named)


@pytest.mark.parametrize(
    ("cells", "other", "cause"),
    [
        (100, {}, "multiple of 32"),
        (32, {}, "at least 64"),
        (96, {"scene": SceneConfig(domain_size=(1 + 1 / 64, 1, 1))}, "whole number of its cells"),
        (128, {"mpm": MpmConfig(fixed_time_step_s=1e-4)}, "fixed_time_step_s must be null"),
    ],
)
def test_grids_that_are_refused(cells, other, cause):
    """A grid that is no multiple, coarser, cuts a cell, or has a fixed time step is refused in one line."""
    with pytest.raises(ConfigError, match=cause) as error:
        DatagenConfig(dataset=DatasetConfig(reference_cells=cells), **other)
    assert "\n" not in str(error.value)


def generated(config, backend):
    with DatasetWriter(config) as writer:
        Pool(writer, Recorder(), LocalWorkerFactory(config, backend, WorkerPlan(1, 1, 1, 1, 1))).run()
    return Path(config.dataset.folder)


def test_the_visible_grid_named_changes_no_byte(make_config, small_dataset, backend, threads):
    """A data set with the visible grid as its reference has the same files as one without."""
    config = make_config(reference_cells=64)
    assert hashes(generated(config, backend)) == hashes(small_dataset)
    assert Manifest.load(config.dataset.folder).config_hash == Manifest.load(small_dataset).config_hash


def test_a_data_set_of_a_finer_grid(make_config, small_dataset, backend, threads):
    """Episodes contain the visible particles, and name the grid like manifest and card. Another grid is refused."""
    config = make_config(reference_cells=128)
    folder = generated(config, backend)
    visible = {episode.key: episode for episode in EpisodeStore(small_dataset, "train")}
    for fine in EpisodeStore(folder, "train"):
        coarse = visible.pop(fine.key)
        assert np.array_equal(fine.position_TN3[0], coarse.position_TN3[0])
        assert np.abs(fine.position_TN3 - coarse.position_TN3).max() < 1e-6  # free flight is the same on any grid
        assert fine.solver["reference"] == config.reference and "reference" not in coarse.solver
    assert not visible
    manifest = Manifest.load(folder)
    assert manifest.config["reference"] == config.reference
    assert "128 cells per unit" in data_card(manifest, "name", "mit")
    with pytest.raises(ConfigError, match="reference is"):
        generated(make_config(), backend)


def test_makers_draw_children(make_config, backend, monkeypatch):
    """A solver receives the scene that it simulates: while it drew children, its GPU would be idle. On the visible grid
    this is the scene of the episode, which is sent once."""
    task = SceneTask("train", 0, 0, scene_seed(0, "train", 0, 0))
    config = make_config(reference_cells=128)
    fine, coarse = (make_scene(task, c, backend)[1] for c in (config, make_config()))
    monkeypatch.setattr("datagen.fine.fine_scene", None)
    fine, coarse = pickle.loads(pickle.dumps((fine, coarse)))
    assert coarse.simulated is coarse.scene
    (result,) = simulate_batch([fine], config, backend, 1)
    assert np.array_equal(result.position_TN3[0], fine.scene.open().position_N3)
    assert fine.simulated.open().particle_count == 8 * fine.scene.open().particle_count


def test_a_killed_solver_leaves_no_trace(make_config, backend, control, tmp_path, threads):
    """With a solver that is killed a run leaves the same files as an undisturbed run."""
    config = make_config(reference_cells=128, training_scenes=3)
    (control / f"kill-{scene_seed(0, 'train', 1, 0)}").write_text("1")
    disturbed = hashes(generated(config, backend))
    assert written_files.simulated(control).count(scene_seed(0, "train", 1, 0)) == 2
    whole = make_config(folder=str(tmp_path / "whole"), reference_cells=128, training_scenes=3)
    assert disturbed == hashes(generated(whole, backend))


def test_launches_fit_in_memory():
    """A finer grid makes launches smaller, by its nodes: memory keeps the frames of visible particles. Where those of
    one scene need too much memory, it is refused.
    """
    sizes = [gpu_scenes_per_launch(data_set(reference_cells=cells), 1e13) for cells in (64, 128, 192)]
    assert sizes == [416, 104, 30]
    with pytest.raises(ConfigError, match="fit in half") as error:
        gpu_scenes_per_launch(data_set(reference_cells=128), 1e7)
    assert "\n" not in str(error.value)


def test_more_particles_than_memory(monkeypatch):
    """A batch that does not fit in the device's memory is refused before anything is allocated, in one line."""
    from datagen.mpm import solver

    monkeypatch.setattr(solver, "memory_bytes", lambda device: 200_000)
    with pytest.raises(ConfigError, match=r"fit in the cpu's memory of 0\.0002 GB, got") as error:
        simulated([drop()])
    assert "\n" not in str(error.value) and "reference_cells" in str(error.value)
