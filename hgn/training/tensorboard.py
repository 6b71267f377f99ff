"""Pictures and animations for loggers, and hyper-parameters for TensorBoard."""

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from hgn.render.error_curve import error_curve
from hgn.render.pictures import animate, compare_picture, write_picture
from hgn.scene.rollout_file import Rollout
from hgn.training.lightning_compat import (
    Callback,
    LightningModule,
    MLFlowLogger,
    TensorBoardLogger,
    Trainer,
    WandbLogger,
)
from hgn.training.module import TrainingModule
from hgn.training.stop import StopRequest

PICTURES = 4  # number of frames in a picture
ANIMATION_PICTURES = 24  # largest number of pictures in an animation
ANIMATION_SIZE = 200  # edge of a panel in pixels
FINAL_PREFIXES = ("one_step/", "baseline_ratio/", "rollout/")


def write_pictures(folder: Path, update: int, rollout: Rollout, error_T: dict[str, np.ndarray]) -> dict[str, Path]:
    """Writes a rollout and its ground truth as a picture and a GIF, and the position MSE `error_T` by material.

    Returns their files by TensorBoard's tags.
    """
    names = {"picture": "rollout_{:09d}.png", "error_over_time": "error_{:09d}.png", "animation": "rollout_{:09d}.gif"}
    paths = {f"rollout/{name}": folder / file.format(update) for name, file in names.items()}
    frames = np.linspace(0, rollout.frame_count - 1, PICTURES).astype(int).tolist()
    write_picture(paths["rollout/picture"], compare_picture(rollout, frames))
    write_picture(paths["rollout/error_over_time"], error_curve(error_T, rollout.frame_rate_hz))
    # viewers play at most 50 pictures per second
    every = max(-(-rollout.frame_count // ANIMATION_PICTURES), -(-int(rollout.frame_rate_hz) // 50))
    animate(rollout, paths["rollout/animation"], every=every, size=ANIMATION_SIZE)
    return paths


def show_pictures(loggers: list[Any], update: int, paths: dict[str, Path]) -> None:
    """Adds pictures and animations to the ThreadedLoggers of a training."""
    for threaded in loggers:
        threaded.call(lambda logger: _show(logger, update, paths))


def _show(logger: Any, update: int, paths: dict[str, Path]) -> None:
    for tag, path in paths.items():
        if isinstance(logger, WandbLogger):
            animated = path.suffix == ".gif"
            (logger.log_video if animated else logger.log_image)(tag, [str(path)], update)
        elif isinstance(logger, MLFlowLogger):
            logger.experiment.log_artifact(logger.run_id, path, "pictures")
        elif isinstance(logger, TensorBoardLogger) and path.suffix == ".gif":
            add_animation(logger, tag, path, update)
        elif isinstance(logger, TensorBoardLogger):
            with Image.open(path) as image:
                logger.experiment.add_image(tag, np.asarray(image.convert("RGB")), update, dataformats="HWC")


def add_animation(logger: TensorBoardLogger, tag: str, path: Path, step: int) -> None:
    """Adds a GIF file as an image summary, which TensorBoard plays. `add_video` would need a video library."""
    from tensorboard.compat.proto.summary_pb2 import Summary

    with Image.open(path) as opened:
        width, height = opened.size
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=path.read_bytes())
    logger.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)


class FinalMetrics(Callback):
    """Writes hyper-parameters and the last errors for TensorBoard's HPARAMS page, unless a signal ended the run."""

    def __init__(self, settings: dict[str, Any], last: dict[str, float], stop: StopRequest) -> None:
        """`settings` is the resolved configuration. The monitor fills `last`."""
        self.settings, self.last, self.stop = settings, last, stop

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        metrics = {f"final/{name}": value for name, value in self.last.items() if name.startswith(FINAL_PREFIXES)}
        assert isinstance(pl_module, TrainingModule)
        update = pl_module.update
        for threaded in trainer.loggers if self.stop.signal is None and metrics else []:
            if threaded.name == "tensorboard":
                threaded.log_hyperparams(self.settings, metrics, update)
