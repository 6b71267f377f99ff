"""python -m tools.render rollout=FILE out=FOLDER_OR_FILE: pictures of a rollout, or of an episode of a data set.

A folder gets NAME.png (some frames), NAME.gif (an animation) and, with ground truth, NAME_error.png (error over time).
With a file that ends in .png, .gif or .webp (half the size of GIF) only this picture is drawn; with .usdc, .usda, .usd
or .ply the rollout is written for other programs (`surface=true`: also water as a closed surface). Further rollouts of
the same scene (`others=[FILE,...]`) are drawn next to the first one, with the labels `names`.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hgn.command import run_command
from hgn.config import USD_ENDINGS
from hgn.data.reader import find_episode
from hgn.render import PLY_ENDING, pictures
from hgn.render.error_curve import error_curve, position_error
from hgn.render.exchange import save_rollout
from hgn.scene.rollout_file import Rollout, read_rollout
from hgn.schema import ConfigError, OneOrMore, from_mapping, require, require_bounds, require_replaceable
from hgn.system.progress import bar

PICTURES = 4  # default number of frames in the PNG
ANIMATIONS = (".gif", ".webp")


@dataclass(frozen=True)
class RenderConfig:
    """The options of `python -m tools.render`."""

    out: str  # a folder, or one file that ends in .png, .gif, .webp (animated, half as large as GIF), .usdc or .ply
    surface: bool = False  # true: USD and PLY also contain water as a closed surface
    rollout: str | None = None  # file of python -m hgn.rollout or datagen.solve
    others: tuple[str, ...] = ()  # further rollouts of the same scene, drawn next to it for its number of frames
    # labels of rollout (or the episode) and of each of others; null: prediction (ground truth), and the files' names
    names: tuple[str, ...] | None = None
    data: str | None = None  # folder of a data set, instead of rollout
    episode: str | int | None = None  # key of an episode of data, for example validation-000000
    frames: tuple[int, ...] | None = None  # of the PNG, for example [0,50,100]; null: four, evenly spaced
    every: OneOrMore = 3  # stride of the frames in the animation, which plays in real time
    size: int | None = None  # width of a panel, pixels; null: 360, and 720 where an animation has one panel

    def __post_init__(self) -> None:
        require_bounds(self)
        require(self.out != "", "out", "a folder or a file name", self.out)
        given = [value is not None for value in (self.data, self.episode)]
        if self.rollout is None:
            rule, remedy = "a file, or else data and episode given", "as in rollout=rollout.vtkhdf out=pictures"
            require(all(given), "rollout", rule, self.rollout, remedy)
        else:
            require(not any(given), "rollout", "left out where data and episode are given", self.rollout)
        if self.names is not None:
            count = 1 + len(self.others)
            rule = f"{count} different ones, of rollout and of each of the {count - 1} others"
            require(len(set(self.names)) == len(self.names) == count, "names", rule, self.names)
        require(64 <= (self.size or 64) <= 4096, "size", "64 to 4096 pixels", self.size)


@dataclass(frozen=True)
class Versions:
    """A rollout or ground truth, and other rollouts of the same scene by label."""

    rollout: Rollout
    label: str
    others: Mapping[str, np.ndarray]
    truth_TN3: np.ndarray | None  # reference of the errors


def main(mapping: Mapping[str, Any]) -> int:
    """Draws or writes the files and prints their paths; returns the exit code."""
    config = from_mapping(RenderConfig, mapping)
    name, out = str(config.episode or "") or Path(config.rollout or "").stem, Path(config.out)
    in_folder = [out / f"{name}{ending}" for ending in (".png", ".gif", "_error.png")]
    require_replaceable("out", out, *in_folder)
    versions = _load(config)
    rollout = versions.rollout
    if out.suffix == ".png":
        _write_png(config, versions, out)
    elif out.suffix in ANIMATIONS:
        _write_animation(config, versions, out)
    elif out.suffix in (*USD_ENDINGS, PLY_ENDING):
        with bar("writing", total=rollout.frame_count, unit="frame") as progress:
            print(save_rollout(out, rollout, config.surface, progress.update))
    elif out.suffix and not out.is_dir():
        endings = ", ".join((".png", *ANIMATIONS, *USD_ENDINGS, PLY_ENDING))
        raise ConfigError(f"out must be a folder or end in one of {endings}, got {config.out!r}")
    else:
        _write_png(config, versions, in_folder[0])
        _write_animation(config, versions, in_folder[1])
        if versions.truth_TN3 is not None:
            curve = error_curve(_errors(versions), rollout.frame_rate_hz)
            pictures.write_picture(in_folder[2], curve, rollout.source)
            print(in_folder[2])
    return 0


def _load(config: RenderConfig) -> Versions:
    """Reads the rollouts. Raises: ConfigError if their particles or frame rates differ."""
    if config.rollout is None:
        assert config.data is not None and config.episode is not None  # checked by RenderConfig
        rollout = pictures.rollout_of_episode(find_episode(config.data, str(config.episode)))
        first, label = f"episode {config.episode}", "ground truth" if config.others else ""
        truth_TN3 = rollout.position_TN3 if config.others else None
    else:
        rollout = read_rollout(config.rollout)
        first, label = config.rollout, "prediction"
        truth_TN3 = rollout.reference_TN3
        if "solver" in rollout.source:
            label, truth_TN3 = "ground truth", rollout.position_TN3 if config.others else None
    names = config.names or (label, *(Path(other).stem for other in config.others))
    require(len(set(names)) == len(names), "names", "given where others have the same file name", config.names)
    label, *rest = names
    others = {}
    for i, (other_name, file) in enumerate(zip(rest, config.others, strict=True)):
        other = read_rollout(file)
        if not np.array_equal(other.position_TN3[0], rollout.position_TN3[0], equal_nan=True):
            raise ConfigError(f"others[{i}] must begin with the same particles as {first}, got {file}")
        if not np.array_equal(_corners(rollout), _corners(other)) or other.gravity != rollout.gravity:
            raise ConfigError(f"others[{i}] must have the obstacles and the gravity of {first}, got {file}")
        rule = f"{rollout.frame_rate_hz:g} frames a second"
        if other.frame_rate_hz != rollout.frame_rate_hz:
            raise ConfigError(f"others[{i}] must have {rule}, got {other.frame_rate_hz:g}")
        if other.frame_count != rollout.frame_count:
            counts = f"{file} has {other.frame_count} frames, {first} has {rollout.frame_count}"
            print(f"{counts}: pictures have {rollout.frame_count}", file=sys.stderr)
        others[other_name] = other.position_TN3
    return Versions(rollout, label, others, truth_TN3)


def _corners(rollout: Rollout) -> np.ndarray:
    return np.concatenate([np.zeros((0, 3)), *(obstacle.vertex_V3 for obstacle in rollout.obstacles)])


def _write_png(config: RenderConfig, versions: Versions, path: Path) -> None:
    rollout = versions.rollout
    frames = pictures.spread(rollout.frame_count, PICTURES) if config.frames is None else config.frames
    picture = pictures.compare_picture(rollout, frames, config.size or 360, versions.label, versions.others)
    pictures.write_picture(path, picture, rollout.source)
    print(path)


def _write_animation(config: RenderConfig, versions: Versions, path: Path) -> None:
    rollout = versions.rollout
    pictures.animation_rate(rollout, path, config.every)
    with bar("drawing", total=len(range(0, rollout.frame_count, config.every)), unit="picture") as progress:
        how = config.every, config.size, lambda done, _: progress.update()
        pictures.animate(rollout, path, *how, versions.label, versions.others)
    print(path)


def _errors(versions: Versions) -> dict[str, np.ndarray]:
    """Returns the position error over time, by material or by rollout."""
    rollout, truth_TN3 = versions.rollout, versions.truth_TN3
    if not versions.others:
        return position_error(rollout)
    trajectories = {versions.label: rollout.position_TN3, **versions.others}
    return {
        name: position_error(replace(rollout, position_TN3=position_TN3, reference_TN3=truth_TN3))["all"]
        for name, position_TN3 in trajectories.items()
        if position_TN3 is not truth_TN3
    }


if __name__ == "__main__":
    run_command(main, "render")
