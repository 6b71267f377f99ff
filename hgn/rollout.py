"""python -m hgn.rollout weights=… scene=… frames=300 out=…: simulates a scene with trained weights."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from typing import Any

from hgn.command import run_command
from hgn.config import RolloutConfig
from hgn.data.select import find_episode
from hgn.device import choose_device
from hgn.progress import bar
from hgn.runtime.path import path_on, set_matmul_precision
from hgn.runtime.simulator import DivergenceError, InitialState, Simulator
from hgn.runtime.weights import WeightsInfo, load_weights, require_frame_rate
from hgn.scene.rollout_file import Rollout, obstacles_of_episode, write_rollout
from hgn.scene.scene_file import load_scene
from hgn.schema import ConfigError, from_mapping, require


def main(mapping: dict[str, Any]) -> int:
    """Simulates and writes the rollout file; returns the exit code."""
    config = from_mapping(RolloutConfig, mapping)
    path = rollout(config)
    print(path)
    return 0


def rollout(config: RolloutConfig) -> Path:
    """Simulates a scene file, or an episode beside its truth, and writes HDF5; returns its path.

    Raises: ConfigError for bad input, weights that let the simulation diverge among them; nothing is written then.
    """
    device = choose_device(config.device)
    weights = Path(config.weights)
    network, info = load_weights(weights, device)
    source = {"weights": weights.name, "weights_sha256": hashlib.sha256(weights.read_bytes()).hexdigest()}
    frames = config.frames
    reference_TN3 = None
    if config.scene is not None:
        scene = load_scene(Path(config.scene))
        initial = InitialState.of_scene(scene)
        obstacles, cell_size = scene.obstacles, scene.cell_size
        source["scene"] = config.scene
    else:
        assert config.data is not None and config.episode is not None
        episode = find_episode(config.data, config.episode)
        require_frame_rate(info, episode.frame_rate_hz)
        frames = min(frames, len(episode.position_TN3))
        initial = InitialState.of_episode(episode)
        obstacles, cell_size = obstacles_of_episode(episode), episode.obstacle_grid.cell_size
        reference_TN3 = episode.position_TN3[:frames]
        source |= {"data": Path(config.data).name, "episode": config.episode}
    _require_cell_size(info, cell_size)
    chosen, text = path_on(device, network.config, config.path, config.precision)
    print(text, file=sys.stderr)
    set_matmul_precision(config.precision)
    simulator = Simulator(network, info.frame_rate_hz, chosen, config.precision)
    with bar("simulating", total=frames - 1, unit="frame") as progress:
        try:
            (position_TN3,) = simulator.rollout([initial], frames, lambda _: progress.update())
        except DivergenceError as error:
            raise ConfigError(f"weights must keep the simulation together, got {weights}: {error}") from error
    path = Path(config.out)
    write_rollout(
        path,
        Rollout(
            position_TN3=position_TN3,
            material_N=initial.material_N,
            obstacles=obstacles,
            domain_size=initial.domain_size,
            frame_rate_hz=info.frame_rate_hz,
            gravity=initial.gravity,
            cell_size=cell_size,
            source=source,
            reference_TN3=reference_TN3,
        ),
    )
    return path


def _require_cell_size(info: WeightsInfo, cell_size: float) -> None:
    require(
        cell_size == info.obstacle_cell_size or not info.network.sees_obstacles,
        "cell_size",
        f"the weights' {info.obstacle_cell_size}, the size of the cells that it knows obstacles by",
        cell_size,
    )


if __name__ == "__main__":
    run_command(main, "rollout")
