"""Draws pictures of rollouts: a grid of frames and an animation, each with the ground truth if there is one.

Shape legend: T frames, N particles.
"""

import functools
import io
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont, PngImagePlugin

from hgn.render.flat import FlatStage
from hgn.render.renderer import BACKGROUND_COLOR, MATERIAL_COLORS, OBSTACLE_COLOR, PARTICLE_COLORS, Stage, to_bytes
from hgn.scene.episode import Episode
from hgn.scene.episode_obstacles import obstacles_of_episode
from hgn.scene.rollout_file import Rollout
from hgn.schema import ConfigError, require
from hgn.system.files import WRITTEN_BY_HGN, write_atomically

RADIUS_IN_SPACINGS = 0.72  # the spheres overlap a little, so that they look like a body
REST_CELLS = 1.5  # largest thickness of walls that are not drawn: the solver bounds its particles there
TEXT_COLOR = (45, 50, 60)
PALETTE_SAMPLES = 40_000
LONGEST_MS = 655_350  # longest duration of a GIF's picture
WEBP_QUALITY = 70  # at 50 small particles smear, and at 90 the file is as large as a GIF
Color = tuple[int, int, int]
NO_OTHERS: Mapping[str, np.ndarray] = MappingProxyType({})


def compare_picture(
    rollout: Rollout,
    frames: Sequence[int],
    size: int = 360,
    label: str = "prediction",
    others: Mapping[str, np.ndarray] = NO_OTHERS,
) -> Image.Image:
    """Draws a grid with one column for each frame: the prediction in the first row, the ground truth in the last.

    size is the width of a panel in pixels. label names the first row. others contains positions float32 [T, N, 3] of
    the same particles from other simulations, by name. Each simulation is a row between the first and the last.

    Raises ConfigError if a frame lies outside the rollout or an entry of `others` has other particles.
    """
    require(len(frames) > 0, "frames", "one frame or more", list(frames))
    for i, frame in enumerate(frames):
        rule = f"in [0, {rollout.frame_count}), the frames of the rollout"
        require(0 <= frame < rollout.frame_count, f"frames[{i}]", rule, frame)
    stage = _stage(rollout, size)
    rows = _versions(rollout, label, others)
    width, height = stage.size
    gap, header, footer = size // 30, _header_height(size), _header_height(size)
    left = header if rows[0][0] else 0
    picture = Image.new(
        "RGB", (left + len(frames) * (width + gap), header + len(rows) * (height + gap) + footer), _background()
    )
    for column, frame in enumerate(frames):
        x = left + column * (width + gap)
        seconds = f"t = {frame / rollout.frame_rate_hz:.2f} s"
        _write(picture, (x + width / 2, header / 2), seconds, _text_size(size))
        _place_obstacles(stage, rollout, frame)
        for row, (_, position_TN3) in enumerate(rows):
            panel = _panel(stage, position_TN3, frame, rollout)
            picture.paste(panel, (x, header + row * (height + gap)))
    for row, (name, _) in enumerate(rows):
        if name:
            strip = Image.new("RGB", (height, left), _background())
            _write(strip, (height / 2, left / 2), name, _text_size(size))
            picture.paste(strip.rotate(90, expand=True), (0, header + row * (height + gap)))
    _legend(picture, picture.height - footer / 2, rollout, _text_size(size))
    return picture


def animate(
    rollout: Rollout,
    path: str | Path,
    every: int = 3,
    size: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    label: str = "prediction",
    others: Mapping[str, np.ndarray] = NO_OTHERS,
) -> None:
    """Writes an animation of every `every`-th frame, with the prediction and the ground truth in adjacent panels.

    path: a .gif or .webp file; WebP is half as large and keeps all colours. The animation plays in real time; GIF
    rounds the duration of a picture to 1/100 s, WebP to 1/1000 s, and the longest is LONGEST_MS. size: width of a panel
    in pixels; None: 720 for one panel, 360 for several. progress: called with the number of pictures drawn and their
    total. label, others: as in `compare_picture`.

    Raises ConfigError as `animation_rate` does, and if an entry of `others` has other particles.
    """
    webp = Path(path).suffix == ".webp"
    rate = animation_rate(rollout, path, every)
    frames = range(0, rollout.frame_count, every)
    versions = _versions(rollout, label, others)
    size = size or (720 if len(versions) == 1 else 360)
    stage = _stage(rollout, size)

    def drawn() -> Iterator[Image.Image]:
        for count, frame in enumerate(frames, start=1):
            yield _animation_picture(stage, rollout, versions, frame, size)
            if progress is not None:
                progress(count, len(frames))

    buffer = io.BytesIO()
    if webp:
        first, *later = drawn()
        duration = min(round(1000 / rate), LONGEST_MS)
        how: dict[str, Any] = {"quality": WEBP_QUALITY, "method": 3, "xmp": WRITTEN_BY_HGN.encode()}
        first.save(buffer, "WEBP", save_all=True, append_images=later, duration=duration, loop=0, **how)
    else:
        samples = [_animation_picture(stage, rollout, versions, frames[i], size) for i in spread(len(frames), 6)]
        pictures = map(_Palette(samples).apply, drawn())
        duration = min(10 * round(100 / rate), LONGEST_MS)
        how = {"disposal": 1, "optimize": False, "comment": WRITTEN_BY_HGN.encode()}
        next(pictures).save(buffer, "GIF", save_all=True, append_images=pictures, duration=duration, loop=0, **how)
    write_picture(path, buffer.getvalue())


def animation_rate(rollout: Rollout, path: str | Path, every: int) -> float:
    """Returns the pictures per second of an animation in real time.

    Raises: ConfigError if viewers play fewer per second (GIF 50, WebP 60), or if every is below 1.
    """
    kind, fastest = ("WebP", 60) if Path(path).suffix == ".webp" else ("GIF", 50)
    require(every >= 1, "every", "at least 1", every)
    rate = rollout.frame_rate_hz / every
    if not 0 < rate <= fastest:
        remedy = f"use every >= {math.ceil(rollout.frame_rate_hz / fastest)}"
        raise ConfigError(f"fps must be in (0, {fastest}], which {kind} viewers support, got {rate:g}; {remedy}")
    return rate


def write_picture(path: str | Path, picture: Image.Image | bytes, source: Mapping[str, object] | None = None) -> None:
    """Writes a PNG, or the given bytes, atomically. The PNG's Description contains `source` as JSON."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(picture, Image.Image):
        buffer = io.BytesIO()
        text = PngImagePlugin.PngInfo()
        text.add_text("Software", WRITTEN_BY_HGN)
        if source is not None:
            text.add_text("Description", json.dumps(source))
        picture.save(buffer, format="PNG", pnginfo=text, optimize=True)
        picture = buffer.getvalue()
    write_atomically(path, picture)


def particle_spacing(position_N3: np.ndarray) -> float:
    """Returns the distance between neighbours in the bulk, in the unit of the positions.

    It is the median distance to the third neighbour, exact in a cubic lattice and 11 % too small for random points.
    """
    position_N3 = position_N3[np.isfinite(position_N3).all(axis=1)]
    from scipy.spatial import KDTree

    if len(position_N3) < 4:
        return 1 / 128  # spacing of eight particles in a cell of 1/64
    sample_N3 = position_N3[:: max(1, len(position_N3) // 2000)]
    return max(float(np.median(KDTree(position_N3).query(sample_N3, k=4)[0][:, 3])), 1e-6)


def rollout_spacing(rollout: Rollout, of_N: np.ndarray | slice = slice(None)) -> float:
    """Returns `particle_spacing` of the first frame, or of the last frame if particles enter during the rollout."""
    frame = 0 if rollout.entry_frame_N is None else -1
    return particle_spacing(rollout.position_TN3[frame, of_N])


def rollout_of_episode(episode: Episode, predicted_TN3: np.ndarray | None = None) -> Rollout:
    """Returns an episode as a rollout, or as the ground truth of the given prediction, float32 [T, N, 3]."""
    return Rollout(
        position_TN3=episode.position_TN3 if predicted_TN3 is None else predicted_TN3,
        material_N=np.asarray(episode.material_N),
        obstacles=obstacles_of_episode(episode),
        domain_size=episode.domain_size,
        frame_rate_hz=episode.frame_rate_hz,
        gravity=episode.gravity,
        cell_size=episode.obstacle_grid.cell_size,
        source={"episode": episode.key, "seed": episode.seed, "specification": episode.specification},
        reference_TN3=None if predicted_TN3 is None else episode.position_TN3,
        materials=episode.materials,
        dimensions=episode.dimensions,
    )


def _stage(rollout: Rollout, size: int) -> Stage:
    radius = rollout_spacing(rollout) * RADIUS_IN_SPACINGS
    radius = min(radius, 0.03 * min(rollout.domain_size[: rollout.dimensions]))
    if rollout.dimensions == 2:
        return FlatStage(rollout.domain_size, rollout.obstacles, radius, size)
    known_TN3 = rollout.position_TN3[:1] if rollout.reference_TN3 is None else rollout.reference_TN3
    known_N3 = known_TN3[:: max(1, len(known_TN3) // 50), : rollout.present(0)].reshape(-1, 3)
    nearest = np.nanmin(np.minimum(known_N3, np.array(rollout.domain_size) - known_N3), initial=np.inf)
    wall = min(max(0.0, float(nearest) - radius), REST_CELLS * rollout.cell_size)
    return Stage(rollout.domain_size, rollout.obstacles, radius, size, wall)


def _place_obstacles(stage: Stage, rollout: Rollout, frame: int) -> None:
    """Moves the obstacles with keyframes to their pose in this frame."""
    if any(obstacle.motion is not None for obstacle in rollout.obstacles):
        stage.place([obstacle.at(frame / rollout.frame_rate_hz) for obstacle in rollout.obstacles])


def _panel(stage: Stage, position_TN3: np.ndarray, frame: int, rollout: Rollout) -> Image.Image:
    present = rollout.present(frame)
    if frame < len(position_TN3):
        position_N3 = position_TN3[frame, :present]
        panel = stage.draw(position_N3, rollout.material_N[:present])
        lost = int((~np.isfinite(position_N3)).any(axis=1).sum())
        note = f"{lost} of {len(position_N3)} particles not finite" if lost else ""
    else:
        panel = stage.draw(np.empty((0, 3)), rollout.material_N[:0])
        note = f"ends after {len(position_TN3)} frames"
    if note:
        _write(panel, (panel.width / 2, panel.height * 0.42), note, _text_size(panel.width), halo=3)
    return panel


def _versions(rollout: Rollout, label: str, others: Mapping[str, np.ndarray]) -> list[tuple[str, np.ndarray]]:
    """Returns name and positions of each panel. The name is empty for an episode without a prediction."""
    for name, position_TN3 in others.items():
        if position_TN3.shape[1:] != rollout.position_TN3.shape[1:]:
            raise ConfigError(
                f"{name} must have the same {rollout.position_TN3.shape[1]} particles, got {position_TN3.shape[1]}"
            )
    predicted = "weights" in rollout.source or rollout.reference_TN3 is not None or len(others) > 0
    truth = [] if rollout.reference_TN3 is None else [("ground truth", rollout.reference_TN3)]
    return [(label if predicted else "", rollout.position_TN3), *others.items(), *truth]


def _animation_picture(
    stage: Stage, rollout: Rollout, versions: Sequence[tuple[str, np.ndarray]], frame: int, size: int
) -> Image.Image:
    width, height = stage.size
    gap, header, text = size // 30, _header_height(size), _text_size(size)
    picture = Image.new("RGB", (len(versions) * (width + gap) - gap, height + 2 * header), _background())
    _place_obstacles(stage, rollout, frame)
    for column, (label, position_TN3) in enumerate(versions):
        x = column * (width + gap)
        picture.paste(_panel(stage, position_TN3, frame, rollout), (x, header))
        _write(picture, (x + width / 2, header / 2), label, 6 * text // 5)
    seconds = f"t = {frame / rollout.frame_rate_hz:.2f} s"
    if len(versions) == 1:  # here the legend takes the whole width
        _write(picture, (width - gap, header / 2), seconds, text, anchor="rm")
    else:
        _write(picture, (gap, picture.height - header / 2), seconds, text, anchor="lm")
    _legend(picture, picture.height - header / 2, rollout, text)
    return picture


class _Palette:
    """Holds the 256 colours of an animation.

    Flat colours and the shades of each material are exact. Median cut chooses the others. Half of its samples are
    pixels that change, so that a few particles on a large floor keep their colours.
    """

    def __init__(self, pictures: Sequence[Image.Image]) -> None:
        stack = np.stack([np.asarray(picture) for picture in pictures])
        moving = stack[:, (stack != stack[0]).any(axis=(0, 3))].reshape(-1, 3)
        samples = [
            pixels[np.linspace(0, len(pixels) - 1, PALETTE_SAMPLES).astype(np.int64)]
            for pixels in (stack[0].reshape(-1, 3), moving)
            if len(pixels)
        ]
        ramp = np.linspace(0.3, 1.0, 12)[:, None, None] * MATERIAL_COLORS
        flat = to_bytes(np.concatenate((BACKGROUND_COLOR[None], OBSTACLE_COLOR[None], ramp.reshape(-1, 3))))
        free_colors = 255 - len(flat)
        chosen = Image.fromarray(np.concatenate(samples)[None], "RGB").quantize(free_colors).getpalette() or []
        exact = np.concatenate((flat, [TEXT_COLOR])).astype(np.uint8)
        self.colors = np.concatenate((exact, np.reshape(chosen, (-1, 3))[:free_colors].astype(np.uint8)))
        # This table contains the nearest colour for the upper six bits of each channel. Pillow's own search is coarser.
        center = np.stack(np.meshgrid(*[np.arange(64) * 4 + 1.5] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        from scipy.spatial import KDTree

        self.nearest = KDTree(self.colors.astype(np.float64)).query(center)[1].astype(np.uint8)
        self.nearest[_upper_bits(exact)] = np.arange(len(exact))

    def apply(self, picture: Image.Image) -> Image.Image:
        """Returns the picture in these colours, in mode P."""
        result = Image.fromarray(self.nearest[_upper_bits(np.asarray(picture))], "P")
        result.putpalette(self.colors.tobytes())
        return result


def _upper_bits(color: np.ndarray) -> np.ndarray:
    """Returns the upper six bits of the three channels as one number."""
    bits = color.astype(np.int32) >> 2
    return (bits[..., 0] << 12) | (bits[..., 1] << 6) | bits[..., 2]


def spread(count: int, wanted: int) -> list[int]:
    """Returns at most `wanted` evenly spaced indices below `count`, with the first and the last."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, wanted))})


def _legend(picture: Image.Image, y: float, rollout: Rollout, text_size: int) -> None:
    """Draws a swatch for each material and for obstacles, centred at height y."""
    present = np.unique(rollout.material_N)
    entries: list[tuple[str, np.ndarray]] = [(rollout.materials[i], PARTICLE_COLORS[i]) for i in present]
    if rollout.obstacles:
        entries.append(("obstacle", OBSTACLE_COLOR))
    font = _font(text_size)
    dot, space = 0.8 * text_size, 1.6 * text_size
    widths = [dot + 0.5 * text_size + font.getlength(name) for name, _ in entries]
    x = (picture.width - sum(widths) - space * (len(entries) - 1)) / 2
    for (name, color), width in zip(entries, widths, strict=True):
        swatch = Image.new("L", (4 * math.ceil(dot),) * 2, 0)
        box = (0, 0, swatch.width - 1, swatch.height - 1)
        if name == "obstacle":
            ImageDraw.Draw(swatch).rectangle(box, fill=255)
        else:
            ImageDraw.Draw(swatch).ellipse(box, fill=255)
        swatch = swatch.reduce(4)
        place = (round(x), round(y - swatch.height / 2))
        picture.paste(
            tuple(to_bytes(color).tolist()), (*place, place[0] + swatch.width, place[1] + swatch.height), swatch
        )
        _write(picture, (x + dot + 0.5 * text_size, y), name, text_size, anchor="lm")
        x += width + space


def _write(
    picture: Image.Image, place: tuple[float, float], text: str, size: int, anchor: str = "mm", halo: int = 0
) -> None:
    """Draws text. halo is the width in pixels of an outline in the background colour, for text over obstacles."""
    ImageDraw.Draw(picture).text(
        place,
        text,
        font=_font(size),
        fill=TEXT_COLOR,
        anchor=anchor,
        stroke_width=halo,
        stroke_fill=_background() if halo else None,
    )


@functools.cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    """Returns the font that Pillow includes."""
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont)
    return font


def _text_size(panel_size: int) -> int:
    return max(9, panel_size // 23)


def _header_height(panel_size: int) -> int:
    return 2 * _text_size(panel_size)


def _background() -> Color:
    red, green, blue = to_bytes(BACKGROUND_COLOR).tolist()
    return red, green, blue
