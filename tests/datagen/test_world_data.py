"""A data set of scenes as users make them: made on a CPU by the solver, with domains of several sizes in one batch."""

from dataclasses import replace

import numpy as np
import pytest

from datagen.pool.plan import SceneTask
from datagen.pool.worker import Backend, make_episode, make_scene, simulate_batch
from hgn.card import data_card
from hgn.config import DatagenConfig, DatasetConfig, MpmConfig, SceneConfig
from hgn.data.manifest import Manifest
from hgn.scene.episode_obstacles import known_obstacles

pytestmark = pytest.mark.usefixtures("solver_kernels")

KINDS = {"edge": 1.0, "pool": 3.0, "jet": 0.0}


def test_one_batch_has_scenes_of_several_domains():
    """Each result is stored for its own task, whatever the order of the launches. The episode contains its domain and
    meshes."""
    config = DatagenConfig(
        SceneConfig(domain_size=(2.0, 1.5, 1.5), kinds=KINDS, particles_per_cell=1.0),
        MpmConfig(device="cpu"),
        DatasetConfig(frames=2),
    )
    tasks = [SceneTask("train", index, 0, seed) for index, seed in enumerate((5, 1, 9))]
    made = [make_scene(task, config, Backend())[1] for task in tasks]
    results = simulate_batch(made, config, Backend(), 2)
    episodes = [make_episode(one, result, config, "0") for one, result in zip(made, results, strict=True)]
    assert len({episode.domain_size for episode in episodes}) > 1
    for one, episode in zip(made, episodes, strict=True):
        scene = one.scene.open()
        assert np.abs(episode.position_TN3[0] - scene.position_N3).max() < 1e-6
        assert episode.domain_size == scene.domain_size and episode.gravity == scene.gravity
        meshes = known_obstacles(episode.specification)
        assert [mesh.vertex_V3.tolist() for mesh in meshes] == [mesh.vertex_V3.tolist() for mesh in scene.obstacles]


def test_the_card_lists_shares_and_ranges(make_config, make_dataset):
    """In per cent of their sum; kinds without a share are left out."""
    scene = SceneConfig(domain_size=(2.0, 1.5, 1.5), kinds=KINDS)
    folder = make_dataset(replace(make_config(training_scenes=1), scene=scene))
    card = data_card(Manifest.load(folder), "name", "mit")
    assert "| kind pool | 75.0%; depth 0.03 to 0.16, tilt 0 to 0.42, size" in card
    assert "| kind edge | 25.0%; plate 0.2 to 0.45" in card and "jet" not in card
