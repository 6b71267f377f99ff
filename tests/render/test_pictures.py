"""Pictures and animations of a small synthetic rollout."""

import dataclasses
import itertools

import numpy as np
import pytest
import trimesh
from PIL import Image, ImageSequence
from scene.test_episode import make_episode
from scipy.ndimage import center_of_mass, label

from hgn.render.error_curve import error_curve, position_error
from hgn.render.pictures import (
    LONGEST_MS,
    _stage,
    animate,
    compare_picture,
    particle_spacing,
    rollout_of_episode,
    write_picture,
)
from hgn.render.renderer import OBSTACLE_COLOR, Stage, to_bytes
from hgn.scene.motion import Motion
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.rollout_file import Rollout, read_rollout, write_rollout
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import Obstacle
from hgn.schema import ConfigError


def falling_blobs(frames=30, reference_frames=None):
    """One blob of each material falls and bounces once; the ground truth bounces less."""
    lattice = np.stack(np.meshgrid(*[np.arange(5)] * 3), axis=-1).reshape(-1, 3) / 128
    centers = np.array([[0.25, 0.6, 0.6], [0.5, 0.7, 0.3], [0.7, 0.65, 0.7]])
    start = np.concatenate([center + lattice for center in centers])
    seconds = np.arange(frames if reference_frames is None else max(frames, reference_frames)) / 60

    def height(restitution):
        fall = 0.5 * 9.8 * seconds**2
        return np.where(fall < 0.5, -fall, -0.5 + restitution * (fall - 0.5))

    def motion(restitution):
        position = np.repeat(start[None], len(seconds), axis=0)
        position[..., 1] += height(restitution)[:, None]
        return position.astype(np.float32)

    box = trimesh.creation.box((0.3, 0.1, 0.2))
    obstacle = Obstacle("box", box.vertices + np.array((0.7, 0.2, 0.3)), box.faces.astype(np.int32), closed=True)
    material_N, source = np.repeat(np.arange(3, dtype=np.uint8), len(lattice)), {"weights": "model.safetensors"}
    truth = {} if reference_frames is None else {"reference_TN3": motion(0.1)[:reference_frames]}
    return Rollout(motion(0.4)[:frames], material_N, (obstacle,), (1.0, 1.0, 1.0), 60.0, source=source, **truth)


def has_hue(picture, material):
    """Whether at least 20 pixels have the hue of the material: blue, ochre, pale blue."""
    red, _, blue = np.moveaxis(np.asarray(picture).astype(np.int64), -1, 0)
    found = (
        (blue - red > 90) & (blue > 120),
        (red - blue > 60) & (red > 110),
        (blue - red > 18) & (blue - red < 75) & (red > 110),
    )[material]
    return int(found.sum()) >= 20


def test_each_material_is_seen_in_its_colour():
    """A frame shows a material's hue when that material is there, and not when it is not."""
    rollout = falling_blobs()
    stage = Stage(rollout.domain_size, (), 0.01, 300)
    for kept in range(-1, 3):
        chosen_N = rollout.material_N == kept
        picture = stage.draw(rollout.position_TN3[0, chosen_N], rollout.material_N[chosen_N])
        assert has_hue(picture, kept) if kept >= 0 else not any(has_hue(picture, material) for material in range(3))


def test_grid_of_frames():
    """The grid has a column a frame and a row for each of prediction and ground truth; panels differ."""
    rollout = falling_blobs(30, 30)
    both = compare_picture(rollout, [0, 10, 29], size=120)
    alone = compare_picture(dataclasses.replace(rollout, reference_TN3=None), [0, 10, 29], size=120)
    one = compare_picture(rollout, [0], size=120)
    assert both.width > 2.7 * one.width and both.height == one.height
    assert both.height > 1.7 * alone.height
    middle = np.asarray(alone).astype(np.int64)
    step = 124
    assert (middle[:, 30:140] != middle[:, 30 + step : 140 + step]).any()


def test_obstacles_that_move_are_drawn_where_they_are(tmp_path):
    """Each frame shows an obstacle with keyframes as one at rest in that frame's place, in pictures and animations."""
    rollout = falling_blobs(7)
    (box,) = rollout.obstacles
    turns = np.stack([np.eye(3), euler_rotation((0, 0, 40))])
    motion = Motion(np.array([0.0, 0.1]), np.array([[0, 0, 0], [-0.3, 0.1, 0.2]]), turns, (0.7, 0.2, 0.3))
    moving = dataclasses.replace(rollout, obstacles=(dataclasses.replace(box, motion=motion),))
    for frame in (0, 6):
        placed = dataclasses.replace(box, vertex_V3=motion.place(box.vertex_V3, frame / 60))
        still = dataclasses.replace(rollout, obstacles=(placed,))
        seen, expected = (np.asarray(compare_picture(one, [frame], size=100)) for one in (moving, still))
        np.testing.assert_array_equal(seen, expected)
    animate(moving, tmp_path / "a.webp", every=6, size=100)
    with Image.open(tmp_path / "a.webp") as film:
        first, last = (np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(film))
    grey = np.abs(first - last).max(axis=-1) > 25
    assert grey[:, :50].sum() > 50  # where the box came to


def flat_rollout():
    """Three particles of water in the plane of a box twice as wide as high, and two obstacle cells on its floor."""
    position_N3 = np.array([[0.1, 0.1, 0.25], [0.7, 0.1, 0.25], [0.1, 0.3, 0.25]], np.float32)
    grid = ObstacleGrid(0.05, np.array([[8, 0, 3], [9, 0, 3]], np.int32), np.array([[0, 1, 0]] * 2, np.float32))
    values = {"position_TN3": np.stack([position_N3] * 2), "material_N": np.zeros(3, np.uint8), "obstacle_grid": grid}
    kind = {"kind": "imported", "dimensions": 2}
    return rollout_of_episode(make_episode(2, 3, domain_size=(0.8, 0.4, 0.5), specification=kind, **values))


def test_flat_rollouts_are_drawn_in_their_plane(tmp_path):
    """The camera faces the plane: positions are in proportion along both axes, obstacle cells are filled, and there are
    no shadows. Animations and files keep the two dimensions."""
    rollout = flat_rollout()
    write_rollout(tmp_path / "flat.vtkhdf", rollout)
    rollout = read_rollout(tmp_path / "flat.vtkhdf")
    picture = np.asarray(compare_picture(rollout, [0], size=400)).astype(int)[:-40]  # without the legend
    red, _, blue = np.moveaxis(picture, -1, 0)
    spot_PN, count = label(blue - red > 60)
    assert count == 3
    y_N, x_N = np.array(center_of_mass(spot_PN > 0, spot_PN, [1, 2, 3])).T
    (highest, *low) = np.argsort(y_N)
    left, right = sorted(low, key=lambda spot: x_N[spot])
    scale = (x_N[right] - x_N[left]) / 0.6
    assert scale == pytest.approx(400 * 0.96 / 0.8, rel=0.01)
    assert y_N[left] == pytest.approx(y_N[right], abs=0.1) and x_N[highest] == pytest.approx(x_N[left], abs=0.1)
    assert (y_N[left] - y_N[highest]) / 0.2 == pytest.approx(scale, rel=0.01)
    grey = (np.abs(np.moveaxis(picture, -1, 0) - to_bytes(OBSTACLE_COLOR)[:, None, None].astype(int)) < 3).all(axis=0)
    row_S, column_S = np.nonzero(grey)
    assert grey.sum() == pytest.approx(2 * (0.05 * scale) ** 2, rel=0.1)
    assert column_S.mean() - x_N[left] == pytest.approx((0.45 - 0.1) * scale, abs=1)
    assert row_S.mean() - y_N[left] == pytest.approx((0.1 - 0.025) * scale, abs=1)
    animate(rollout, tmp_path / "flat.webp", every=1, size=200)
    with Image.open(tmp_path / "flat.webp") as film:
        assert film.size == (200, 104 + 2 * 18)


def test_ended_ground_truth_and_lost_particles_are_said():
    """A panel past the end of the ground truth is labelled, as is one with particles that are not finite; else the same
    rollout gives the same pixels."""

    def picture(rollout, frame=15):
        return np.asarray(compare_picture(rollout, [frame], size=150))

    rollout, whole = falling_blobs(20, 10), falling_blobs(20, 20)
    assert (picture(rollout) != picture(whole)).any()
    np.testing.assert_array_equal(picture(whole), picture(whole))
    rollout.position_TN3[15, :5] = np.nan
    rollout.position_TN3[0] = np.nan
    picture(rollout)
    picture(rollout, 0)


def test_frames_and_rates_that_are_refused(tmp_path):
    """Frames that are not there, every=0, and rates above 50 per second (WebP 60), which viewers slow down."""
    for frames in ([], [0, 30], [-1]):
        with pytest.raises(ConfigError, match="frames"):
            compare_picture(falling_blobs(), frames)
    for ending, options, message in (
        ("gif", {"every": 1}, "every >= 2"),
        ("webp", {"every": 0.9}, "every must be"),
        ("gif", {"every": 0}, "every must be"),
    ):
        with pytest.raises(ConfigError, match=message):
            animate(falling_blobs(), tmp_path / f"a.{ending}", **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("lowest", "wall"), [(0.3, 1.5 / 64), (0.05, 1.5 / 64), (0.02, 0.02), (-0.1, 0.0)])
@pytest.mark.parametrize("with_truth", [False, True])
def test_the_floor_is_where_particles_rest(lowest, wall, with_truth):
    """The box is drawn without the walls, at most 1.5 cells thick, that no particle of the ground truth, or else of the
    first frame, enters. So it is the same for all predictions of a scene."""
    rollout = falling_blobs(30, 30)
    truth_TN3, at_N3 = np.clip(rollout.position_TN3, 0.3, 0.7), np.clip(rollout.position_TN3, 0.3, 0.7)
    (truth_TN3[-1] if with_truth else at_N3[0])[0, 1] = lowest
    at_N3[-1, 0] = 0.001
    scene = dataclasses.replace(rollout, position_TN3=at_N3, cell_size=1 / 64)
    stage = _stage(dataclasses.replace(scene, reference_TN3=truth_TN3 if with_truth else None), 120)
    assert stage.wall == pytest.approx(max(0.0, wall - stage.radius) if wall == lowest else wall)
    assert stage.domain_size[1] == pytest.approx(1 - 2 * stage.wall)


@pytest.mark.parametrize(("every", "pictures", "milliseconds"), [(3, 10, 50), (6, 5, 100)])
def test_animation(tmp_path, every, pictures, milliseconds):
    """The GIF has the frames asked for in real time, loops, and moves."""
    seen: list[tuple[int, int]] = []
    path = tmp_path / "new" / "rollout.gif"
    animate(falling_blobs(30, 30), path, every, size=120, progress=lambda *step: seen.append(step))
    with Image.open(path) as gif:
        assert gif.info["loop"] == 0
        shown = [(frame.info["duration"], np.asarray(frame.convert("RGB"))) for frame in ImageSequence.Iterator(gif)]
    assert [duration for duration, _ in shown] == [milliseconds] * pictures
    assert all((a != b).any() for (_, a), (_, b) in itertools.pairwise(shown))
    assert shown[0][1].shape[1] > 240
    assert tuple(shown[-1][1][1, 1]) == (255, 255, 255)
    assert seen == [(i + 1, pictures) for i in range(pictures)]
    assert [entry.name for entry in path.parent.iterdir()] == ["rollout.gif"]
    assert all(has_hue(Image.fromarray(shown[0][1]), material) for material in range(3))


def test_webp_animation(tmp_path):
    """A WebP holds the same pictures as the GIF in real time, loops, and is the smaller file. A rollout of one frame
    gives a still picture."""
    rollout, progress = falling_blobs(24, 24), []
    animate(rollout, tmp_path / "a.webp", every=2, size=160, progress=lambda *step: progress.append(step))
    animate(rollout, tmp_path / "a.gif", every=2, size=160)
    with Image.open(tmp_path / "a.webp") as webp, Image.open(tmp_path / "a.gif") as gif:
        assert (webp.format, webp.n_frames, webp.size, webp.info["loop"]) == ("WEBP", 12, gif.size, 0)
        for frame in (0, 5, 11):
            webp.seek(frame)
            gif.seek(frame)
            one, other = (np.asarray(picture.convert("RGB")).astype(np.float64) for picture in (webp, gif))
            assert webp.info["duration"] == 33 and np.abs(one - other).mean() < 4
    assert progress == [(i + 1, 12) for i in range(12)]
    assert (tmp_path / "a.webp").stat().st_size < 0.8 * (tmp_path / "a.gif").stat().st_size
    for ending in ("gif", "webp"):
        slow = dataclasses.replace(falling_blobs(6, 6), frame_rate_hz=1e-9)
        animate(slow, tmp_path / f"slow.{ending}", size=80)
        with Image.open(tmp_path / f"slow.{ending}") as picture:
            picture.seek(1)
            picture.load()
            assert picture.info["duration"] == LONGEST_MS  # the longest that GIF has
        animate(falling_blobs(1), tmp_path / f"still.{ending}", size=80)
        with Image.open(tmp_path / f"still.{ending}") as picture:
            assert picture.n_frames == 1


def test_position_error():
    """Squares are summed over axes and averaged over particles, of each material too."""
    rollout = falling_blobs(8, 6)
    moved = rollout.reference_TN3 + np.array([0.1, 0.0, 0.2], np.float32)
    error = position_error(dataclasses.replace(rollout, position_TN3=moved))
    assert list(error) == ["all", "water", "sand", "snow"]
    for values in error.values():
        np.testing.assert_allclose(values, np.full(6, 0.05), rtol=1e-5)
    with pytest.raises(ConfigError, match="without ground truth"):
        position_error(falling_blobs(3))


def test_error_curve():
    """The picture shows the lines. Errors that are all zero or all NaN are drawn without a warning."""
    picture = error_curve(position_error(falling_blobs(30, 30)), 60.0)
    assert picture.size == (720, 400)
    assert len(np.unique(np.asarray(picture).reshape(-1, 3), axis=0)) > 20
    error_curve({"all": np.zeros(5)}, 60.0)
    error_curve({"all": np.full(5, np.nan)}, 60.0)


def test_particle_spacing():
    """A lattice gives its spacing, at any scale; too few particles give the usual one."""
    lattice = np.stack(np.meshgrid(*[np.arange(9)] * 3), axis=-1).reshape(-1, 3) * 0.02
    assert particle_spacing(lattice) == pytest.approx(0.02)
    assert particle_spacing(lattice[:3]) == 1 / 128
    assert particle_spacing(np.full((50, 3), np.nan)) == 1 / 128
    assert particle_spacing(np.zeros((50, 3))) > 0


def test_episode_as_rollout(tmp_path):
    """An episode without a prediction is not labelled as one. With a prediction it is the ground truth."""
    blobs = falling_blobs(4, 6)
    assert blobs.reference_TN3 is not None
    episode = make_episode(
        particles=blobs.particle_count, key="validation-000000", position_TN3=blobs.reference_TN3,
        material_N=blobs.material_N, domain_size=(1.0, 1.0, 1.0), specification={"kind": "user"},
    )  # fmt: skip
    alone = rollout_of_episode(episode)
    assert alone.reference_TN3 is None and alone.source["episode"] == "validation-000000"
    np.testing.assert_array_equal(alone.position_TN3, episode.position_TN3)
    predicted = rollout_of_episode(episode, blobs.position_TN3)
    np.testing.assert_array_equal(predicted.position_TN3, blobs.position_TN3)
    np.testing.assert_array_equal(predicted.reference_TN3, episode.position_TN3)
    write_rollout(tmp_path / "episode.h5", alone)
    assert read_rollout(tmp_path / "episode.h5").source == alone.source
    assert compare_picture(alone, [0, 3], 100).width < compare_picture(predicted, [0, 3], 100).width


def test_png_keeps_its_source(tmp_path):
    """The PNG says how the rollout was made."""
    write_picture(tmp_path / "a.png", Image.new("RGB", (4, 4)), {"weights": "model.safetensors"})
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.text["Description"] == '{"weights": "model.safetensors"}'
