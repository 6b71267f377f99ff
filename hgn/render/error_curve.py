"""Computes and plots the error of a rollout over time.

Shape legend: T frames, N particles.
"""

from collections.abc import Mapping

import numpy as np
from PIL import Image

from hgn.render.renderer import MATERIAL_COLORS
from hgn.scene.material import MATERIALS
from hgn.scene.rollout_file import Rollout
from hgn.schema import ConfigError


def error_curve(error_T: Mapping[str, np.ndarray], frame_rate_hz: float) -> Image.Image:
    """Plots position errors over time on a logarithmic scale, one line for each entry of `error_T`.

    `error_T` contains float64 [T] by name, as `position_error` returns it. The picture has 720 x 400 pixels.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.0), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    shown = False
    for name, error in error_T.items():
        seconds = np.arange(len(error)) / frame_rate_hz
        positive = np.where(error > 0, error, np.nan)  # frame 0 has no error, and a logarithmic scale no zero
        shown |= bool(np.isfinite(positive).any())
        if name in MATERIALS:
            color = tuple(MATERIAL_COLORS[MATERIALS.index(name)] * (0.85 if name == "snow" else 1.0))
            axes.plot(seconds, positive, label=name, color=color, linewidth=1.8)
        else:
            axes.plot(seconds, positive, label=name, color="0.2" if name == "all" else None, linewidth=2.2)
    if shown:
        axes.set_yscale("log")
    axes.set_xlabel("time (s)")
    axes.set_ylabel("position MSE (squared domain units)")
    axes.set_title("summed over axes, mean over particles", fontsize=9, color="0.4")
    axes.grid(True, which="major", color="0.9")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, ncols=max(1, len(error_T)), loc="lower right")
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy(), "RGB")


def position_error(rollout: Rollout) -> dict[str, np.ndarray]:
    """Returns the position MSE of each frame against the ground truth, float64 [T] in squared domain units.

    Keys are `all`, and every material if the scene has more than one. Squares are summed over axes and averaged over
    particles, for the frames that both have.

    Raises ConfigError if the rollout has no ground truth.
    """
    if rollout.reference_TN3 is None:
        raise ConfigError("reference must be given to measure an error, got a rollout without ground truth")
    frames = min(len(rollout.position_TN3), len(rollout.reference_TN3))
    difference = rollout.position_TN3[:frames].astype(np.float64) - rollout.reference_TN3[:frames]
    square_TN = (difference**2).sum(axis=2)
    shown_TN = np.arange(square_TN.shape[1]) < [[rollout.present(frame)] for frame in range(frames)]

    def mean(of_material_N: np.ndarray) -> np.ndarray:
        counted_TN = shown_TN & of_material_N
        return np.asarray(np.ma.array(square_TN, mask=~counted_TN).mean(axis=1).filled(np.nan))

    error = {"all": mean(rollout.material_N == rollout.material_N)}
    materials = np.unique(rollout.material_N)
    if len(materials) > 1:
        error |= {rollout.materials[i]: mean(rollout.material_N == i) for i in materials}
    return error
