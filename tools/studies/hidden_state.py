"""python -m tools.studies.hidden_state [--json FILE]: how much of the next frame a network cannot see.

A network sees where particles were in the last frames. The solver also has their velocities at this very moment,
velocity gradients, deformation and hardening. Here it simulates random scenes, and takes every `every`-th
frame once more with a part of this state replaced by what could be guessed:

- velocity: from the last three positions, to second order;
- gradients: zero;
- deformation: none (volumes, elastic deformation, hardening), as at the start;
- everything: all three, which is the solver started anew from what is visible;
- neighbour: gradients and deformation of the nearest particle of the same material. A network that knew all about a
  particle's surroundings, but could not tell which of two neighbours has which state, would be wrong by half of what
  this changes; half of it is what the row says.

Errors are one-step mean squared errors as everywhere: summed over axes, domain units per frame squared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from datagen.mpm.collider import build_collider
from datagen.mpm.device import initialise
from datagen.mpm.layout import FIELD, LIVE, TAG
from datagen.mpm.team_launch import TeamLaunch
from hgn.command import run_command
from hgn.config import MpmConfig, SceneConfig
from hgn.scene.material import MATERIALS, SAND
from hgn.scene.random_scene import REPORT_SEED, generate_scene
from hgn.scene.scene import Scene
from hgn.schema import ConfigError, from_mapping, require, require_one_of, require_positive, to_mapping
from hgn.system.files import write_json
from hgn.system.progress import bar
from hgn.system.provenance import provenance, without_folders

FRAME_RATE_HZ = 60.0
HISTORY = 3  # positions that the velocity is guessed from


@dataclass(frozen=True)
class HiddenStateConfig:
    """The options of `python -m tools.studies.hidden_state`."""

    scenes: int = 2  # random scenes
    frames: int = 300
    every: int = 10  # frames are looked at
    scene: SceneConfig = field(default_factory=SceneConfig)  # the scenes as they are in training
    mpm: MpmConfig = field(default_factory=MpmConfig)
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        require_positive(self, "scenes", "every")
        require(self.frames > HISTORY, "frames", f"above {HISTORY}", self.frames)
        require_one_of(self.mpm, "device", ("auto", "cpu", "gpu"))


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON where asked to."""
    config = from_mapping(HiddenStateConfig, mapping)
    device = initialise(config.mpm.device)
    meta = provenance("cuda" if device.kind == "gpu" else "cpu") | {"config": without_folders(to_mapping(config))}
    errors: list[dict[str, np.ndarray]] = []
    rows: list[dict[str, Any]] = []
    with bar("frames", total=config.scenes * (config.frames - 1), unit="frame") as progress:
        for index in range(config.scenes):
            scene = generate_scene(config.scene, REPORT_SEED + index)
            stepped = SteppedScene(scene, config.mpm)
            errors += changes(stepped, config.frames, config.every, progress.update)
            stepped.release()
            rows = summary(errors)
            if config.json is not None:  # after each: what a later scene does takes nothing away
                write_json(config.json, {"meta": meta, "rows": rows})
    print(table(rows))
    return 0


class SteppedScene(TeamLaunch):
    """One scene, frame by frame, whose state can be read, changed and taken back.

    State arrays are float32 [fields, N] (see layout.FIELD), particles in the solver's own order.
    """

    def __init__(self, scene: Scene, config: MpmConfig) -> None:
        initialise(config.device)
        nodes = tuple(round(length / scene.cell_size) for length in scene.domain_size)
        collider = build_collider(scene, config.collider_band_cells)
        super().__init__(1, [scene], [collider], config, nodes, FRAME_RATE_HZ)
        self.scene = scene

    def frame(self) -> np.ndarray:
        """Goes on by a frame: positions float32 [N, 3], in the scene's order.

        Raises: ConfigError where the scene fails.
        """
        output = self._launch(1, np.ones(1)).to_numpy().reshape(-1, 3)
        if not np.isfinite(output).all():
            raise ConfigError("mpm must keep the scene together, got positions that are not finite")
        return output

    def saved(self) -> list[np.ndarray]:
        """All that the next frame reads."""
        return [array.to_numpy() for array in self._arrays()]

    def restore(self, saved: list[np.ndarray]) -> None:
        for array, values in zip(self._arrays(), saved, strict=True):
            array.from_numpy(values)

    def change(self, rule: Callable[[np.ndarray, np.ndarray], None]) -> None:
        """Calls `rule` with the state, which it may write to, and each particle's index in the scene [N]."""
        slot = int(self.live.to_numpy()[LIVE.copy])
        state = self.state.to_numpy()
        tag = self.tag.to_numpy().reshape(2, TAG.length, self.particles)
        rule(state.reshape(2, -1, self.particles)[slot], tag[slot, TAG.origin])
        self.state.from_numpy(state)

    def _arrays(self) -> tuple[Any, ...]:
        return self.state, self.tag, self.order, self.live, self.counter, self.scene_value


def changes(
    stepped: SteppedScene, frames: int, every: int, progress: Callable[[], Any] = lambda: None
) -> list[dict[str, np.ndarray]]:
    """For each frame looked at: squared changes of each particle's next position [N], by what was replaced."""
    material_N = np.asarray(stepped.scene.material_N)
    history = [np.asarray(stepped.scene.position_N3, np.float32)]
    found = []
    for index in range(1, frames):
        if index % every or len(history) < HISTORY:
            truth_N3 = stepped.frame()
        else:
            before = stepped.saved()
            truth_N3 = stepped.frame()
            after = stepped.saved()
            squares = {"motion": _square(truth_N3 - 2 * history[-1] + history[-2]), "material": material_N}
            for name, rule in replacements(material_N, history).items():
                stepped.restore(before)
                stepped.change(rule)
                squares[name] = _square(stepped.frame() - truth_N3)
            stepped.restore(after)
            found.append(squares)
        history = [*history[1 - HISTORY :], truth_N3]
        progress()
    return found


def replacements(
    material_N: np.ndarray, history: list[np.ndarray]
) -> dict[str, Callable[[np.ndarray, np.ndarray], None]]:
    """What writes a guess into a state, by name; `history` are positions [N, 3], the last one is now."""
    now, last, first = (history[-i].astype(np.float64) for i in (1, 2, 3))
    velocity_N3 = ((now - last) + 0.5 * (now - 2 * last + first)) * FRAME_RATE_HZ

    def velocity(state: np.ndarray, origin: np.ndarray) -> None:
        state[FIELD.velocity : FIELD.velocity + 3] = velocity_N3[origin].T

    def gradients(state: np.ndarray, origin: np.ndarray) -> None:
        state[FIELD.affine : FIELD.affine + 9] = 0

    def deformation(state: np.ndarray, origin: np.ndarray) -> None:
        state[FIELD.volume] = np.where(material_N[origin] == SAND, 0, 1)  # as team_kernel.start_team does
        state[FIELD.deformation :] = 0
        if len(state) > FIELD.fluid:
            state[[FIELD.deformation + 4 * axis for axis in range(3)]] = 1

    def everything(state: np.ndarray, origin: np.ndarray) -> None:
        for rule in (velocity, gradients, deformation):
            rule(state, origin)

    def neighbour(state: np.ndarray, origin: np.ndarray) -> None:
        other = np.arange(len(origin))
        for kind in np.unique(material_N):
            own = np.flatnonzero(material_N[origin] == kind)
            if len(own) > 1:
                place = state[FIELD.position : FIELD.position + 3, own].T
                other[own] = own[KDTree(place).query(place, k=2)[1][:, 1]]
        state[FIELD.affine :] = state[FIELD.affine :, other]

    return {
        "velocity": velocity,
        "gradients": gradients,
        "deformation": deformation,
        "everything": everything,
        "neighbour": neighbour,
    }


def summary(errors: list[dict[str, np.ndarray]]) -> list[dict[str, Any]]:
    """A row for each replacement: mean over particles and frames, in all and by material; of `neighbour` half."""
    material = np.concatenate([error["material"] for error in errors])
    rows = []
    for name in (key for key in errors[0] if key != "material"):
        square = np.concatenate([error[name] for error in errors]) * (0.5 if name == "neighbour" else 1)
        by_material = {MATERIALS[i]: float(square[material == i].mean()) for i in np.unique(material)}
        rows.append({"replaced": name, "one_step_mse": float(square.mean()), "by_material": by_material})
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """The figures for people, as Markdown; `motion` is what constant velocity gets wrong."""
    kinds = list(rows[0]["by_material"])
    lines = [f"| replaced | one-step MSE | {' | '.join(kinds)} |", "| :-- | --: |" + " --: |" * len(kinds)]
    for row in rows:
        values = [row["one_step_mse"], *row["by_material"].values()]
        lines.append(f"| {row['replaced']} | " + " | ".join(f"{value:.2e}" for value in values) + " |")
    return "\n".join(lines)


def _square(difference_N3: np.ndarray) -> np.ndarray:
    return (difference_N3.astype(np.float64) ** 2).sum(axis=1)


if __name__ == "__main__":
    run_command(main, "hidden_state")
