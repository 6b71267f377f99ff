"""python -m tools.render rollout=FILE out=FOLDER_OR_FILE: pictures of a rollout, or of an episode of a data set.

Into a folder go NAME.png (frames beside each other), NAME.gif (the animation) and, with ground truth,
NAME_error.png (error over time); into a file that ends in .png or .gif goes that picture alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hgn.command import run_command
from hgn.config import RenderConfig
from hgn.data.select import find_episode
from hgn.picture import (
    animate,
    compare_picture,
    error_curve,
    position_error,
    rollout_of_episode,
    spread,
    write_picture,
)
from hgn.progress import bar
from hgn.scene.rollout_file import Rollout, read_rollout
from hgn.schema import ConfigError, from_mapping

PICTURES = 4  # in the PNG, where frames does not say


def main(mapping: Mapping[str, Any]) -> int:
    """Draws what the mapping of a RenderConfig asks for and prints the path of each file; returns the exit code.

    Raises: ConfigError.
    """
    config = from_mapping(RenderConfig, mapping)
    name, rollout = _load(config)
    out = Path(config.out)
    if out.suffix == ".png":
        _write_png(config, rollout, out)
    elif out.suffix == ".gif":
        _write_gif(config, rollout, out)
    elif out.suffix and not out.is_dir():
        raise ConfigError(f"out must be a folder or end in .png or .gif, got {config.out!r}")
    else:
        _write_png(config, rollout, out / f"{name}.png")
        if config.gif:
            _write_gif(config, rollout, out / f"{name}.gif")
        if rollout.reference_TN3 is not None:
            path = out / f"{name}_error.png"
            write_picture(path, error_curve(position_error(rollout), rollout.frame_rate_hz), rollout.source)
            print(path)
    return 0


def _load(config: RenderConfig) -> tuple[str, Rollout]:
    if config.rollout is not None:
        return Path(config.rollout).stem, read_rollout(config.rollout)
    assert config.data is not None and config.episode is not None  # RenderConfig saw to it
    return config.episode, rollout_of_episode(find_episode(config.data, config.episode))


def _write_png(config: RenderConfig, rollout: Rollout, path: Path) -> None:
    frames = config.frames
    if frames is None:
        frames = tuple(spread(rollout.frame_count, PICTURES))
    write_picture(path, compare_picture(rollout, frames, config.size), rollout.source)
    print(path)


def _write_gif(config: RenderConfig, rollout: Rollout, path: Path) -> None:
    pictures = len(range(0, rollout.frame_count, config.every))
    with bar("drawing", total=pictures, unit="picture") as progress:
        animate(rollout, path, config.fps, config.every, config.size, lambda done, _: progress.update())
    print(path)


if __name__ == "__main__":
    run_command(main, "render")
