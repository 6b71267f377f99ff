"""python -m datagen.solve scene=my_scene.yaml out=truth.vtkhdf: simulates a scene file with the solver.

The result for your own scene is like the data from which networks learn. `python -m tools.render rollout=truth.vtkhdf
others=[rollout.vtkhdf]` draws it next to a network's rollout of the same scene, with their errors.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hgn.command import require_rollout_name, run_command
from hgn.config import MpmConfig
from hgn.scene.emission import entry_frames
from hgn.scene.rollout_file import Rollout, write_frames
from hgn.scene.scene_file import find_scene, load_scene
from hgn.scene.scene_notes import notes_on_files
from hgn.schema import ConfigError, FrameCount, FrameRate, from_mapping, require_bounds, require_replaceable, to_mapping
from hgn.system.files import require_place
from hgn.system.progress import advance_to, bar


@dataclass(frozen=True)
class SolveConfig:
    """`python -m datagen.solve`: a scene file, simulated by the solver."""

    scene: str  # a scene file, or the name of one in conf/example, for example funnel
    out: str | None = None  # the file to write; null: rollout/NAME_solver.vtkhdf
    frames: FrameCount = 300  # frame 0 is the initial state
    frame_rate_hz: FrameRate = 60.0  # frames per simulated second
    mpm: MpmConfig = field(default_factory=MpmConfig)

    def __post_init__(self) -> None:
        require_bounds(self)
        require_rollout_name("out", self.out)


def main(mapping: dict[str, Any]) -> int:
    """Simulates the scene, and writes its frames as they come. Returns the exit code.

    Raises: ConfigError for bad input, and for a scene that the solver cannot simulate. The file then contains the
    frames so far, if any.
    """
    config = from_mapping(SolveConfig, mapping)
    file, rate_hz = find_scene(config.scene), config.frame_rate_hz
    out = Path(config.out if config.out is not None else f"rollout/{file.stem}_solver.vtkhdf")
    require_place(out)
    require_replaceable("out", out)
    scene = load_scene(file)
    for note in notes_on_files(scene, (config.frames - 1) / rate_hz):
        print(note, file=sys.stderr)
    # Taichi takes seconds to import, so bad input is reported before.
    from datagen.mpm.solver import SceneFailure, simulate

    path_TN3 = np.full((config.frames, scene.particle_count, 3), np.nan, np.float32)
    rollout = Rollout(
        path_TN3, scene.material_N, scene.obstacles, scene.domain_size, rate_hz,
        gravity=scene.gravity, cell_size=scene.cell_size,
        source={"scene": config.scene, "solver": to_mapping(config.mpm)},
        entry_frame_N=entry_frames(scene, rate_hz) if scene.emits else None,
    )  # fmt: skip
    print(f"{scene.particle_count:,} particles, {config.frames:,} frames", file=sys.stderr)

    def run(take: Callable[[np.ndarray], None]) -> None:
        with bar("simulating", total=config.frames, initial=1, unit="frame") as progress:

            def completed(frame: int) -> None:
                take(path_TN3[frame, : rollout.present(frame)])
                advance_to(progress, frame + 1)

            (result,) = simulate([scene], config.mpm, config.frames, rate_hz, completed, trajectories=[path_TN3])
        if isinstance(result, SceneFailure):
            raise ConfigError(f"{file} must be a scene that the solver can simulate, got {result.cause}")

    write_frames(out, rollout, run)
    print(out)
    return 0


if __name__ == "__main__":
    run_command(main, "solve")
