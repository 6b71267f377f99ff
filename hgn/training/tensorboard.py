"""Pictures, animations and hyper-parameters for TensorBoard; nothing is written where there is no such logger."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from PIL import Image

from hgn.render.error_curve import error_curve
from hgn.render.pictures import animate, compare_picture, write_picture
from hgn.scene.rollout_file import Rollout
from hgn.training.stop import StopRequest

PICTURES = 4  # frames beside each other
ANIMATION_PICTURES = 24
ANIMATION_SIZE = 200  # pixels of a panel
FINAL_PREFIXES = ("one_step/", "baseline_ratio/", "rollout/")


def show_rollout(trainer: Trainer, folder: Path, rollout: Rollout, error_T: dict[str, np.ndarray]) -> None:
    """A rollout beside its ground truth, as a picture and as a GIF, and `error_T`, position MSE over time by material.

    They are kept in `folder` as rollout_UPDATE.png, rollout_UPDATE.gif and error_UPDATE.png.
    """
    step = trainer.global_step
    frames = np.linspace(0, rollout.frame_count - 1, PICTURES).astype(int).tolist()
    picture = compare_picture(rollout, frames)
    curve = error_curve(error_T, rollout.frame_rate_hz)
    animation = folder / f"rollout_{step:09d}.gif"
    write_picture(folder / f"rollout_{step:09d}.png", picture)
    write_picture(folder / f"error_{step:09d}.png", curve)
    # at most 50 pictures a second, which viewers keep
    every = max(-(-rollout.frame_count // ANIMATION_PICTURES), -(-int(rollout.frame_rate_hz) // 50))
    animate(rollout, animation, every=every, size=ANIMATION_SIZE)
    logger = trainer.logger
    if isinstance(logger, TensorBoardLogger):
        for tag, image in (("rollout/picture", picture), ("rollout/error_over_time", curve)):
            logger.experiment.add_image(tag, np.asarray(image.convert("RGB")), step, dataformats="HWC")
        add_animation(logger, "rollout/animation", animation, step)


def add_animation(logger: TensorBoardLogger, tag: str, path: Path, step: int) -> None:
    """Shows a GIF file as an image summary, which TensorBoard plays; `add_video` would need a film library."""
    from tensorboard.compat.proto.summary_pb2 import Summary

    with Image.open(path) as opened:
        width, height = opened.size
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=path.read_bytes())
    logger.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)


class FinalMetrics(Callback):
    """Hyper-parameters beside the last measured errors, when a training ends by itself: TensorBoard's HPARAMS page."""

    def __init__(self, settings: dict[str, Any], last: dict[str, float], stop: StopRequest) -> None:
        """settings: the resolved configuration; last: filled by the monitor as it measures."""
        self.settings, self.last, self.stop = settings, last, stop

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        metrics = {f"final/{name}": value for name, value in self.last.items() if name.startswith(FINAL_PREFIXES)}
        logger = trainer.logger
        if self.stop.signal is None and metrics and isinstance(logger, TensorBoardLogger):
            logger.log_hyperparams(self.settings, metrics, trainer.global_step)
