"""python -m hgn.rollout: simulates a random scene, or the scene of scene=….

The weights are shipped ones, or those of weights=…. The result is a VTKHDF file, with pictures in the same folder:
always without out=…, and with it only if render=true.
"""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hgn.command import ROLLOUT_ENDINGS, require_rollout_name, run_command
from hgn.config import DEFAULT_WEIGHTS, USD_ENDINGS, SceneConfig, SimulatorConfig
from hgn.render import PLY_ENDING
from hgn.scene.distance import fraction_inside, outside_domain
from hgn.scene.emission import entry_frames
from hgn.scene.material import MATERIALS
from hgn.scene.random_scene import generate_scene
from hgn.scene.scene import Scene
from hgn.scene.scene_file import find_scene, load_scene
from hgn.schema import (
    ConfigError,
    FrameCount,
    NonNegative,
    from_mapping,
    printable,
    require,
    require_bounds,
    require_replaceable,
)
from hgn.system.files import require_place
from hgn.system.loading import loading
from hgn.system.progress import bar

if TYPE_CHECKING:
    from hgn.runtime.weights import WeightsInfo
    from hgn.scene.rollout_file import Rollout

PICTURES = 4  # number of pictures in the PNG
EVERY = 3  # smallest number of frames of the rollout for one picture of the GIF
FASTEST = 50  # largest number of pictures per second that viewers of GIFs show
REPORTED = 0.01  # smallest fraction of particles inside obstacles, or beyond the domain, that is reported


@dataclass(frozen=True)
class RolloutConfig(SimulatorConfig):
    """`python -m hgn.rollout`: simulates a random scene, a scene file, or an episode of a data set with its truth."""

    weights: str = DEFAULT_WEIGHTS  # a file of python -m hgn.export, or the name of shipped weights
    # the file to write: .vtkhdf, .usdc, .usda, .usd (one stage) or .ply (one a frame); null: rollout/NAME.vtkhdf
    out: str | None = None
    surface: bool = False  # also write water as a closed surface, in USD and PLY
    render: bool | None = None  # also draw a PNG and a GIF next to the file; null: yes without out, no with out
    # a scene file, or the name of one in conf/example, for example funnel; null: a random scene, or an episode
    scene: str | None = None
    # seed of a random scene, drawn as the training scenes; null: 13, where all materials fall on obstacles
    seed: NonNegative[int] | None = None
    data: str | None = None  # folder or URL of the data set of episode
    episode: str | int | None = None  # an episode of data to simulate, for example validation-000000
    frames: FrameCount = 300  # number of frames; frame 0 is the initial state

    def __post_init__(self) -> None:
        require_bounds(self)
        require(
            (self.data is None) == (self.episode is None),
            "data",
            "given together with episode",
            self.data,
            "for example data=data/obstacles episode=validation-000000",
        )
        require(self.scene is None or self.data is None, "scene", "left out if data is given", self.scene)
        rule, remedy = "left out if scene or data is given", "a scene file has its own"
        require(self.seed is None or self.scene is self.data is None, "seed", rule, self.seed, remedy)
        require_rollout_name("out", self.out, *USD_ENDINGS, PLY_ENDING)

    @property
    def random_seed(self) -> int:
        return 13 if self.seed is None else self.seed


def main(mapping: dict[str, Any]) -> int:
    """Simulates, and writes the rollout file and its pictures. Returns the exit code."""
    from hgn.render.pictures import animate, compare_picture, spread, write_picture

    config = from_mapping(RolloutConfig, mapping)
    drawn = config.render if config.render is not None else config.out is None
    out = _out(config)
    still, moving = pictures = out.with_suffix(".png"), out.with_suffix(".gif")
    require_replaceable("out", out, *(pictures if drawn else ()))
    path, result = rollout(config)
    last = result.frame_count - 1
    present_N3 = result.position_TN3[last, : result.present(last)]
    inside = fraction_inside(present_N3, result.obstacles, last / result.frame_rate_hz)
    beyond = outside_domain(present_N3, result.domain_size)
    for place, fraction in (("inside obstacles", inside), ("beyond the domain", beyond)):
        if fraction > REPORTED:
            print(f"{place}: {fraction:.1%} of the particles in the last frame", file=sys.stderr)
    print(path)
    if drawn:
        write_picture(still, compare_picture(result, spread(result.frame_count, PICTURES)), result.source)
        print(still)
        every = max(EVERY, math.ceil(result.frame_rate_hz / FASTEST))
        with bar("drawing", total=len(range(0, result.frame_count, every)), unit="picture") as progress:
            animate(result, moving, every=every, progress=lambda *_: progress.update())
        print(moving)
    elif config.render is None and out.suffix in ROLLOUT_ENDINGS:
        print(f"render=true also draws it, or python -m tools.render rollout={path} out=pictures", file=sys.stderr)
    return 0


def rollout(config: RolloutConfig) -> tuple[Path, Rollout]:
    """Simulates a scene or an episode, writes the file, and returns its path and content.

    The file of an episode also has the episode's true positions. After Ctrl-C or a divergence the file contains the
    frames so far, and a line reports this. Raises ConfigError for bad input or a simulation that diverges.
    """
    with loading():
        from hgn.render.exchange import require_exchange, save_frames
        from hgn.runtime.notes import note_on_speed, notes_on_scene
        from hgn.runtime.simulator import InitialState, Simulator
        from hgn.runtime.weights import find_weights, require_frame_rate
        from hgn.scene.episode_obstacles import obstacles_of_episode
        from hgn.scene.rollout_file import Rollout

    out = _out(config)
    require_exchange(out, config.surface)
    require_place(out)
    simulator = Simulator.load(config.weights, config.device, config.backend, config.precision)
    weights = find_weights(config.weights)
    digest = hashlib.sha256(weights.read_bytes()).hexdigest()
    source: dict[str, str | int] = {"weights": weights.name, "weights_sha256": digest}
    frames = config.frames
    reference_TN3 = scene = None
    notes: Iterable[str] = ()
    if config.data is None:
        scene = _scene(config, simulator.info)
        initial = InitialState.of_scene(scene)
        obstacles = scene.obstacles
        notes = notes_on_scene(scene, simulator.info, weights.stem, (frames - 1) / simulator.frame_rate_hz)
        source["scene"] = config.scene or f"random, seed {config.random_seed}"
    else:
        from hgn.data.reader import find_episode

        assert config.episode is not None  # RolloutConfig checks this
        episode = find_episode(config.data, str(config.episode))
        require_frame_rate(simulator.info, episode.frame_rate_hz)
        frames = min(frames, len(episode.position_TN3))
        initial = InitialState.of_episode(episode)
        obstacles = obstacles_of_episode(episode)
        reference_TN3 = episode.position_TN3[:frames]
        source |= {"data": Path(printable(config.data)).name, "episode": str(config.episode)}
    simulated = simulator.frames(initial, frames)  # before all notes, because it refuses unsupported scenes
    for note in (*notes, *note_on_speed(initial.velocity_N3, simulator.info, weights.stem)):
        print(note, file=sys.stderr)
    print(simulator.backend.note, file=sys.stderr)
    material_N = initial.material_N if scene is None else scene.material_N
    path_TN3 = np.full((frames, len(material_N), 3), np.nan, np.float32)
    result = Rollout(
        position_TN3=path_TN3,
        material_N=material_N,
        obstacles=obstacles,
        domain_size=initial.domain_size,
        frame_rate_hz=simulator.frame_rate_hz,
        gravity=initial.gravity,
        cell_size=initial.obstacle_grid.cell_size,
        source=source,
        reference_TN3=reference_TN3,
        entry_frame_N=entry_frames(scene, simulator.frame_rate_hz) if scene is not None and scene.emits else None,
        materials=initial.materials,
        dimensions=initial.dimensions,
    )
    print(f"{result.particle_count:,} particles, {frames:,} frames", file=sys.stderr)
    return save_frames(out, result, partial(_simulate, simulated, frames, weights), config.surface), result


def _simulate(frames: Iterator[np.ndarray], count: int, weights: Path, take: Callable[[np.ndarray], None]) -> None:
    """Gives the frames to `take`, and shows a progress bar. Raises ConfigError with `weights` after a divergence."""
    from hgn.runtime.divergence import DivergedError

    with bar("simulating", total=count, unit="frame") as progress:
        try:
            for position_N3 in frames:
                take(position_N3)
                progress.update()
        except DivergedError as error:
            raise ConfigError(f"weights must simulate without divergence, got {weights}: {error}") from error


def _out(config: RolloutConfig) -> Path:
    """Returns the file to write: `out`, or one with the name of the episode, the scene or the seed."""
    if config.out is not None:
        return Path(config.out)
    scene = find_scene(config.scene).stem if config.scene is not None else f"random_{config.random_seed}"
    return Path(f"rollout/{scene if config.episode is None else config.episode}.vtkhdf")


def _scene(config: RolloutConfig, info: WeightsInfo) -> Scene:
    """Returns a scene: a scene file, an example, or a random scene like those of the training."""
    if config.scene is not None:
        return load_scene(find_scene(config.scene))
    own = [name for name in info.data_materials if name not in MATERIALS]
    rule = "given with weights of imported data, which differ from random scenes"
    imported = info.network.dimensions != 3 or bool(own)
    require(not imported, "data", rule, None, "for example data=data/mine episode=validation-000000")
    drawn = SceneConfig(gravity=info.gravity, cell_size=info.obstacle_cell_size, materials=info.data_materials)
    if not info.network.obstacle_features:
        drawn = replace(drawn, obstacle_count=0, group_shapes=("cube",))  # as in conf/scene/no_obstacles.yaml
    try:
        return generate_scene(drawn, config.random_seed)
    except ConfigError as error:
        name = f"random scene with the weights' obstacle_cell_size of {info.obstacle_cell_size:g}"
        raise ConfigError(f"{name}: {error}; or give scene=…") from error


if __name__ == "__main__":
    run_command(main, "rollout")
