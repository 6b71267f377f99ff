"""The baselines through the same commands: trained, exported, simulated, evaluated; and refused where they differ."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from network.states import random_grid
from training.runs import train_mapping

from hgn import evaluate, rollout, train
from hgn.config import NetworkConfig
from hgn.data.batch import make_batch
from hgn.data.reader import EpisodeStore
from hgn.export import export
from hgn.runtime.simulator import InitialState
from hgn.runtime.weights import load_weights
from hgn.schema import ConfigError

GNS = {"levels": 1, "message_passing_steps": 2, "width": 8}


@pytest.mark.parametrize("kind", ["gns", "gns_particles"])
def test_every_command_takes_a_baseline(data, tmp_path, kind):
    """A baseline is trained, resumed, exported, simulated and evaluated, in fp16, by the HGN's commands."""
    network = GNS | {"kind": kind, "obstacle_features": kind == "gns"}
    run = tmp_path / "run"
    for updates in (2, 4):
        mapping = train_mapping(data, run, maximum_updates=updates, precision="fp16")
        assert train.main(mapping | {"network": network}) == 0
    with pytest.raises(ConfigError, match=r"network\.kind must be '.*' to resume"):
        train.main(train_mapping(data, run))
    weights = tmp_path / "weights.safetensors"
    export(run / "checkpoints" / "last.ckpt", weights)
    loaded, info = load_weights(weights)
    assert type(loaded).__name__ == "GraphNetworkSimulator" and info.network.kind == kind and info.updates == 4
    place = {"weights": str(weights), "data": data.dataset.folder, "precision": "fp16"}
    out = tmp_path / "rollout.vtkhdf"
    assert rollout.main(place | {"episode": "validation-000000", "frames": 4, "out": str(out)}) == 0
    report = tmp_path / "errors.json"
    assert evaluate.main(place | {"scenes": 1, "rollout_frames": 4, "json": str(report)}) == 0
    assert out.is_file() and json.loads(report.read_text())["rows"][0]["one_step_mse"] > 0


@pytest.mark.parametrize("spacing_cells", [0.25, 0.5])
def test_training_and_rollout_see_the_same_surface(spacing_cells, data):
    """A batch and a simulation's start hold the same surface points, as far apart as asked, in the obstacles'
    cells; without obstacles there are none."""
    plain = EpisodeStore(data.dataset.folder, "train")[0]
    grid = random_grid(3, 40)
    episode = replace(plain, obstacle_grid=grid, position_TN3=np.array(plain.position_TN3))
    network = NetworkConfig(kind="gns_particles", obstacle_features=False, static_spacing_cells=spacing_cells, **GNS)
    batch = make_batch([(plain, 1), (episode, 1)], network)
    surface = batch.state().surface
    assert batch.obstacles is None and surface is not None and surface.scene_P.eq(1).all()
    np.testing.assert_array_equal(surface.position_P3, InitialState.of_episode(episode).surface(spacing_cells))
    distance = torch.cdist(surface.position_P3.double(), surface.position_P3.double()).fill_diagonal_(1.0)
    assert distance.min() > 0.999 * spacing_cells * grid.cell_size
    assert make_batch([(plain, 1)], network).surface is None
    assert make_batch([(episode, 1)], NetworkConfig()).surface is None
