"""Friction, parameters and moving obstacles from drawn scenes through shards, batches and training to a rollout."""

from dataclasses import replace

import ballistic_solver
import numpy as np
import pytest
import torch
from equality import assert_same
from scene.test_episode import members_of
from training.runs import train_mapping

from hgn import rollout, train
from hgn.card import weights_card
from hgn.config import NetworkConfig, SceneConfig
from hgn.data.batch import make_batch
from hgn.data.reader import EpisodeStore
from hgn.export import export
from hgn.runtime.simulator import Simulator
from hgn.runtime.weights import load_weights
from hgn.scene.episode import decode_episode
from hgn.scene.moving import at_rest
from hgn.scene.obstacle_grid import build_obstacle_grid
from hgn.scene.own_physics import own_ranges
from hgn.scene.random_scene import generate_scene
from hgn.schema import ConfigError
from hgn.training.checkpoint import network_of_checkpoint, read_checkpoint
from hgn.training.module import TrainingModule
from hgn.training.stop import StopRequest

OWN = ("friction", "parameters", "moving")
MORE = {"symmetry": "gravity", "ema_decay": 0.8, "pushforward_fraction": 0.5, "pushforward_every": 4}
MORE |= {"pushforward_scenes": 2, "pushforward_frames": 2, "maximum_updates": 8, "monitor_every": 1000}


def test_from_shards_to_a_rollout(make_config, make_dataset, tmp_path, monkeypatch, capsys):
    """Shards keep friction and parameters. Batches have those of a simulation of the same scene. A training that is
    interrupted ends bit by bit as another. Its exported weights have the inputs and the ranges of the data, and a
    rollout names values beyond them, and refuses materials that the data do not contain."""
    scenes = []
    generate = lambda config, seed: scenes.append(generate_scene(config, seed)) or scenes[-1]  # noqa: E731
    monkeypatch.setattr(ballistic_solver, "generate_scene", generate)
    grid = lambda *_: build_obstacle_grid(at_rest(scenes[-1].obstacles), 1 / 64, 0, scenes[-1].domain_size)  # noqa: E731
    monkeypatch.setattr(ballistic_solver, "build_obstacle_grid", grid)
    kinds = {"slope": 2.0, "column": 1.0}
    scene = SceneConfig(domain_size=(2.0, 1.5, 1.5), kinds=kinds, own_physics=OWN, particles_per_cell=0.2)
    scene = replace(scene, materials=("sand", "snow"))
    config = replace(make_config(training_scenes=12, seed=1), scene=scene)
    store = EpisodeStore(make_dataset(config), "train")
    episodes = [store[i] for i in range(12)]
    rough = [any(episode.wall_friction) for episode in episodes]
    solid = [friction and len(e.obstacle_grid.cell_K3) > 0 for e, friction in zip(episodes, rough, strict=True)]
    assert 1 < sum(rough) < 10 and 1 < sum(episode.parameters is not None for episode in episodes) < 10
    drawn = {scene.seed: scene for scene in scenes}
    inputs = NetworkConfig(inputs="local", own_physics=OWN, obstacle_distance=True)
    assert sum(make_batch([(episode, 3)], inputs).moving is not None for episode in episodes) > 0
    for episode in episodes:
        scene, members = drawn[episode.seed], members_of(episode)
        assert members_of(decode_episode(episode.key, members)) == members
        assert episode.wall_friction == scene.wall_friction
        frictions = {np.float32(obstacle.friction) for obstacle in at_rest(scene.obstacles) if obstacle.friction}
        assert frictions == set(() if episode.obstacle_grid.friction_K is None else episode.obstacle_grid.friction_K)

    # without members of their own, obstacle cells and particles have what the solver was set to
    old = next(episode for episode in episodes if len(episode.obstacle_grid.cell_K3))
    old = replace(old, obstacle_grid=replace(old.obstacle_grid, friction_K=None), material_parameters={})
    assert old.parameters is None and decode_episode("a", members_of(old)).obstacle_grid.friction_K is None
    settings = old.solver["settings"] | {"collider_friction": 0.25, "sand_friction_angle_deg": 20.0}
    other = decode_episode("a", members_of(replace(old, solver=old.solver | {"settings": settings})))
    assert set(other.obstacle_grid.friction_K.tolist()) == {0.25} and set(other.parameters[:, 2].tolist()) == {20.0}

    place: dict = {}
    step = TrainingModule.training_step
    monkeypatch.setattr(TrainingModule, "training_step", lambda m, chunk: place.update(module=m) or step(m, chunk))
    requested = property(lambda _: "module" in place and place["module"].update >= place["stop"])
    monkeypatch.setattr(StopRequest, "requested", requested)

    def trained(name, *stops):
        mapping = train_mapping(config, tmp_path / name, **MORE)
        mapping["network"] |= {"inputs": "local", "own_physics": list(OWN), "obstacle_distance": True}
        for stop in (*stops, 8):
            place.clear()
            place["stop"] = stop
            assert train.main(mapping) == 0
        return read_checkpoint(tmp_path / name / "checkpoints" / "last.ckpt")

    whole, again = trained("whole"), trained("cut", 4)
    for part in ("state_dict", "optimizer_states", "hgn"):
        assert_same(again[part], whole[part], part)

    last, file = tmp_path / "whole" / "checkpoints" / "last.ckpt", tmp_path / "own.safetensors"
    export(last, file)
    network, info = load_weights(file)
    assert info.network.own_physics == OWN and info.own_ranges == own_ranges(OWN)
    simulator, first = Simulator(network, 60.0, "torch"), episodes[solid.index(True)]
    state = make_batch([(first, 0)], network.config).state()
    started = simulator.start([drawn[first.seed]])
    assert torch.equal(state.wall_friction_S3, started.wall_friction_S3)
    assert torch.equal(state.obstacles.rows(friction=True), started.obstacles.rows(friction=True))
    assert torch.equal(network(state), network_of_checkpoint(read_checkpoint(last), last)(state))

    way = "keyframes: [{time: 0}, {time: 0.1, translation: [0.2, 0, 0]}]"
    fast = f"obstacles: [{{shape: square, size: 0.1, position: [0.3, 0.2, 0.5], {way}}}]\n"
    group = "{shape: cube, size: 0.05, position: [0.5, 0.5, 0.5], material: sand, sand_friction_angle_deg: 60"
    (tmp_path / "steep.yaml").write_text(f"groups: [{group}, poisson_ratio: 0.3}}]\nfloor_friction: 1.5\n{fast}")
    out = {"weights": str(file), "frames": 2, "scene": str(tmp_path / "steep.yaml"), "out": str(tmp_path / "a.vtkhdf")}
    assert rollout.main(out) == 0
    said = capsys.readouterr().err
    assert "friction: 1.5, the data of own have 0 to 1; motion is unreliable" in said
    assert "sand_friction_angle_deg: 60, the data of own have 15 to 45" in said
    assert "keyframes, domain units per second: 2, the data of own have 0 to 1; motion is unreliable" in said
    assert "no effect: poisson_ratio of groups" in said and "no effect: friction" not in said

    (tmp_path / "wet.yaml").write_text(f"groups: [{group.replace('sand, sand_friction_angle_deg: 60', 'water')}}}]\n")
    assert network.config.materials == ("water", "sand", "snow")
    with pytest.raises(
        ConfigError, match=r"material must be one of the training data's \(sand, snow\), got water; use"
    ):
        rollout.main(out | {"scene": str(tmp_path / "wet.yaml")})
    assert "| materials | sand, snow |" in weights_card(info, "own", file.name, "mit")
