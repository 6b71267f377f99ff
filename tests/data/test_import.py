"""Trajectories of other programs: this project's own episodes in each format are the same data after the import."""

import dataclasses
import json
import os
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from data.foreign_writers import Hostile, metadata, pickled_npz, sequence_example, write
from PIL import Image
from training.runs import metrics, train_mapping

from hgn import evaluate, import_trajectories, train
from hgn.config import NetworkConfig
from hgn.data.batch import make_batch
from hgn.data.foreign.boundary import boundary_grid
from hgn.data.foreign.episodes import flat_plane
from hgn.data.foreign.gravity import estimate_gravity
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.export import export
from hgn.network.build import build_network
from hgn.network.grid import build_hierarchy
from hgn.render.pictures import compare_picture
from hgn.rollout import RolloutConfig, rollout
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.weights import load_weights
from hgn.scene.episode import decode_episode, encode_episode
from hgn.scene.history import frames_before, window
from hgn.scene.rollout_file import read_rollout
from hgn.schema import ConfigError
from hgn.training.noise import jittered_origin, perturbed_window

FORMATS = ("deepmind", "geoelements", "geoelements_list", "lagrangebench", "neuralmpm", "plain", "plain_h5")
GRAVITY = (0.0, -9.8, 0.0)
TYPES = np.array([5, 6, 8])  # of water, sand, snow
NAMES = {"5": "water", "6": "sand", "8": "snow"}
SPLITS = {"train": "train", "validation": "valid", "test": "test"}
NOTHING = np.zeros((0, 3), np.float32)


def options(out, source, **changes):
    return {"from": str(source), "out": str(out), "materials": NAMES, "gravity": list(GRAVITY)} | changes


def own_simulations(data, boundary_P3=NOTHING):
    """The episodes of a data set with the frames before their first, which no foreign format can leave out."""
    return {
        name: [
            (np.concatenate([frames_before(e, -5), e.position_TN3]), TYPES[e.material_N], boundary_P3)
            for e in EpisodeStore(data.dataset.folder, split)
        ]
        for split, name in SPLITS.items()
    }


@pytest.mark.parametrize("name", FORMATS)
def test_own_episodes_come_back(name, data, tmp_path):
    """In each format the windows of every frame are the same bit by bit, and so are materials and statistics."""
    wall_P3 = np.stack(np.meshgrid([0.25], np.arange(0.3, 0.7, 0.015), np.arange(0.3, 0.7, 0.015)), -1).reshape(-1, 3)
    extra = {"write_every": 1} if name == "lagrangebench" else {}
    source = write(tmp_path / "foreign", name, own_simulations(data, wall_P3.astype(np.float32)), metadata(**extra))
    assert import_trajectories.main(options(tmp_path / "mine", source)) == 0
    for split in SPLITS:
        own, mine = (EpisodeStore(folder, split) for folder in (data.dataset.folder, tmp_path / "mine"))
        assert len(mine) == len(own) > 0
        for left, right in zip(own, mine, strict=True):
            for frame in range(left.frame_count - 1):
                assert np.array_equal(window(left, frame, 5), window(right, frame, 5))
            assert np.array_equal(left.material_N, right.material_N) and left.gravity == right.gravity
            assert right.boundary_P3 is not None and np.array_equal(right.boundary_P3, wall_P3.astype(np.float32))
            assert np.abs(right.obstacle_grid.normal_K3[:, 0]).min() > 0.999
        for quantity in ("velocity", "acceleration"):
            one, two = (getattr(store.statistics(), quantity) for store in (own, mine))
            assert one.count == two.count and one.mean == pytest.approx(two.mean, rel=1e-12)
            assert torch.equal(torch.tensor(one.std), torch.tensor(two.std))
    (first, *_) = EpisodeStore(tmp_path / "mine", "train")
    again = decode_episode(first.key, encode_episode(first))
    assert again.past_HN3 is not None and np.array_equal(again.past_HN3, first.past_HN3)


@pytest.mark.parametrize("name", ["deepmind", "plain_h5"])
def test_training_losses_are_the_same(name, data, tmp_path):
    """Training on imported episodes gives the losses of training on the episodes themselves."""
    source = write(tmp_path / "foreign", name, own_simulations(data), metadata())
    import_trajectories.main(options(tmp_path / "mine", source))
    losses = []
    for run in ("own", "mine"):
        mapping = train_mapping(data, tmp_path / run, monitor_every=100)
        if run == "mine":
            mapping["dataset"] = mapping["dataset"] | {"folder": str(tmp_path / "mine")}
            mapping |= {"imported": True, "network": mapping["network"] | {"obstacle_features": True}}
        assert train.main(mapping) == 0
        losses.append([record["loss"] for record in metrics(tmp_path / run) if "loss" in record])
    assert losses[0] == losses[1] and len(losses[0]) == 3


def flip(place):
    """Changes a byte of train.tfrecord."""

    def change(folder):
        data = bytearray((folder / "train.tfrecord").read_bytes())
        data[place] ^= 1
        (folder / "train.tfrecord").write_bytes(data)

    return change


def cut(name, size):
    return lambda folder: os.truncate(folder / name, size)


def meta(**changes):
    def change(folder):
        path = folder / "metadata.json"
        kept = json.loads(path.read_text()) | changes
        path.write_text(json.dumps({key: value for key, value in kept.items() if value is not None}))

    return change


def hdf5(name, key, value=None):
    """Puts another array in the place of one, or takes it away."""

    def change(folder):
        with h5py.File(folder / name, "a") as file:
            old = file[key][()]
            del file[key]
            if value is not None:
                file[key] = value(old)

    return change


def rewrite(folder, **changes):
    """Puts other arrays into train.npz: functions of those that are there, or new ones."""
    with np.load(folder / "train.npz") as archive:
        members = dict(archive)
    for key, value in changes.items():
        members[key] = value(members[key]) if callable(value) else value
    np.savez(folder / "train.npz", **members)


def npz(key, value):
    return lambda folder: rewrite(folder, **{key: value})


def with_nan(array):
    array = array.copy()
    array[3, 1, 1] = np.nan
    return array


def moving(array):
    return array + 0.01 * np.arange(len(array), dtype=np.float32)[:, None, None]


def claimed(folder):
    """A file of few bytes that says of itself that it holds 7 TiB."""
    with h5py.File(folder / "train.h5", "a") as file:
        del file["00000/position"]
        file.create_dataset("00000/position", (10**6, 10**6, 2), "f4", chunks=(1, 1000, 2))


def cells(cell, length=1.0):
    """Obstacle cells of the plain layout."""

    def change(folder):
        meta(obstacle_cell_size=1 / 64)(folder)
        normal = np.tile(np.array([[0, length, 0]], np.float32), (len(cell), 1))
        rewrite(folder, **{"00001/obstacle_cell": np.array(cell), "00001/obstacle_normal": normal})

    return change


def at_the_side(folder):
    meta(periodic_boundary_conditions=[True] * 3)(folder)
    hdf5("train.h5", "00000/position", lambda a: a - np.array([0.48, 0, 0], np.float32))(folder)


WALK = np.zeros((9, 2, 3))


def pickled(content):
    return lambda folder: pickled_npz(folder / "train.npz", content(folder))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("deepmind", flip(0), r"train.tfrecord: record 0: length must have CRC .*: it was altered"),
        ("deepmind", flip(200), r"train.tfrecord: record 0: data must have CRC .*: it was altered"),
        ("deepmind", cut("train.tfrecord", 300), r"record 0: data must have \d+ bytes, .*: the file is cut"),
        ("deepmind", cut("train.tfrecord", 5), r"record 0: length must have 12 bytes, got 5: the file is cut"),
        ("deepmind", meta(sequence_length=3), r"record 0: position must have \d+ numbers for sequence_length \+ 1"),
        ("deepmind", meta(sequence_length=None), r"metadata.json: sequence_length must be a whole number, got None"),
        ("deepmind", meta(bounds=None), r"bounds must be given where .*metadata.json does not say it"),
        ("deepmind", meta(bounds=[[0, 0.2]] * 3), r"bounds must hold the particles, got .* of record|bounds must hold"),
        ("deepmind", meta(dt="soon"), r"metadata.json: dt must be a finite number, got 'soon'"),
        ("deepmind", meta(dim=2.5), r"metadata.json: dim must be 2 or 3, got 2.5"),
        ("deepmind", meta(bounds=[[0, 1], [0, 1], [0, float("inf")]]), r"bounds must be finite numbers in pairs"),
        ("deepmind", meta(default_connectivity_radius=1e-12), r"radius must be 6.1e-05 or more, the box being 1 wide"),
        ("deepmind", lambda folder: (folder / "metadata.json").write_text("[" * 9**6), r"metadata.json must be JSON"),
        ("lagrangebench", meta(periodic_boundary_conditions="no"), r"conditions must be finite numbers in a list"),
        ("lagrangebench", meta(write_every=0), r"metadata.json: write_every must be > 0, got 0.0"),
        ("lagrangebench", hdf5("train.h5", "00000/particle_type", lambda a: 0 * a - 1), r"position must be of part"),
        ("lagrangebench", claimed, r"train.h5: 00000: position must be there, and whole, got Unable to allocate"),
        ("plain", meta(obstacle_cell_size=0), r"metadata.json: obstacle_cell_size must be > 0, got 0.0"),
        ("plain", meta(materials=["water"]), r"metadata.json: materials must be names by number, got \['water'\]"),
        ("plain", meta(materials={"1": "Wa ter"}), r"materials must be names of lower-case letters.*got 'Wa ter'"),
        ("plain", meta(boundary_types="none"), r"metadata.json: boundary_types must be finite numbers in a list"),
        ("plain", cells([[2, 2, 2]] * 2), r"00001: obstacle_cell must be each there once, got '1 again'"),
        ("plain", cells([[1 << 40, 2, 2]]), r"00001: obstacle_cell must be cells of the box"),
        ("plain", cells([[2, 2, 2]], 5.0), r"00001: obstacle_normal must be of length 1, got 5"),
        ("deepmind", meta(dt=-1), r"metadata.json: dt must be a finite number > 0, got -1"),
        ("deepmind", meta(context_mean=[0.0]), r"context_mean must be absent, got a set with step_context"),
        ("deepmind", meta(dim=2), r"metadata.json: bounds must be \[low, high\] for each of 2 axes"),
        ("geoelements", cut("train.npz", 400), r"train.npz must be a whole NumPy archive"),
        ("geoelements", pickled(lambda folder: Hostile(folder / "ran")), r"gns_data must be .*no part of an array"),
        ("geoelements", pickled(lambda _: (np.zeros((9, 2, 3)),)), r"gns_data\[0\] must be \(position, particle_type"),
        ("geoelements", pickled(lambda _: (np.zeros((9, 2, 3), int), 5)), r"\[0\]: position must be float32"),
        ("geoelements", pickled(lambda _: ([[1.0], [1.0, 2.0]], 5)), r"gns_data\[0\]: position must be an array, got"),
        ("geoelements", pickled(lambda _: (WALK, [5, np.inf])), r"gns_data\[0\]: particle_type must be whole numbers"),
        ("geoelements", pickled(lambda _: (WALK, 5, np.ones(7))), r"material_property must be numbers of one or 2"),
        ("geoelements", pickled(lambda _: (WALK, 5, [[1.0], [1.0, 2.0]])), r"material_property must be an array, got"),
        ("geoelements", pickled(lambda _: (np.zeros((9, 2, 3)), [5, 6, 5])), r"\[0\]: particle_type must be one"),
        ("geoelements", pickled(lambda _: (np.zeros((9, 2, 2)), 5)), r"position must have shape \[any, any, 3\], got"),
        ("lagrangebench", cut("train.h5", 2000), r"train.h5 must be a whole HDF5 file"),
        ("lagrangebench", hdf5("train.h5", "00001/position"), r"train.h5: 00001: position is missing"),
        ("lagrangebench", hdf5("train.h5", "00000/particle_type"), r"train.h5: 00000: particle_type must be there"),
        ("lagrangebench", hdf5("train.h5", "00000/position", with_nan), r"position must be finite, got nan at \[3"),
        ("lagrangebench", hdf5("train.h5", "00000/particle_type", lambda a: a + 40), r"particle_type must have a"),
        ("lagrangebench", at_the_side, r"conditions must be false on axis x, where particles of .*00000 come within"),
        ("lagrangebench", hdf5("train.h5", "00000/position", lambda a: a[:5]), r"must be 5 \+ 2 frames or more"),
        ("neuralmpm", hdf5("train/sim_0.h5", "boundary"), r"sim_0.h5: boundary must be there, and whole"),
        ("neuralmpm", hdf5("train/sim_0.h5", "boundary", moving), r"sim_0.h5: boundary must be at rest, got 'a motion"),
        ("neuralmpm", hdf5("train/sim_0.h5", "particles", lambda a: a.astype(np.int32)), r"particles must be float32"),
        ("neuralmpm", hdf5("train/sim_0.h5", "types", lambda a: a[1:]), r"particle_type must be one number for each"),
        ("plain", npz("00000/position", with_nan), r"train.npz: 00000: position must be finite, got nan at"),
        ("plain", npz("00000/particle_type", lambda a: a + 0.5), r"00000: particle_type must be whole"),
        ("plain", npz("lonely", lambda a: a), r"lonely"),
        ("plain", npz("00000/position", moving), r"types \[3\] must be at rest, got a motion by .*obstacles at rest"),
    ],
)  # fmt: skip
def test_malformed_files_are_refused(name, change, message, tmp_path):
    """By the name of file and field; nothing is run or written, and no manifest appears."""
    generator = np.random.default_rng(0)
    walk_TN3 = (0.5 + 0.001 * generator.normal(size=(9, 4, 3))).astype(np.float32)
    wall_P3 = generator.uniform(0.1, 0.9, (6, 3)).astype(np.float32)
    simulations = {"train": [(walk_TN3, TYPES[[0, 1, 2, 0]], wall_P3)] * 2}
    extra = {"write_every": 1} if name == "lagrangebench" else {}
    source = write(tmp_path / "foreign", name, simulations, metadata(**extra))
    if message == "lonely":
        np.savez(source / "train.npz", lonely=walk_TN3)
        message = r"train.npz: lonely must be named TRAJECTORY/FIELD"
    else:
        change(source)
    with pytest.raises(ConfigError, match=message):
        import_trajectories.main(options(tmp_path / "mine", source))
    assert not (source / "ran").exists() and not (tmp_path / "mine" / "manifest.json").exists()


def test_a_record_without_a_feature_is_refused(tmp_path):
    """A SequenceExample lacks particle_type; and bytes that are none are no message."""
    from hgn.data.foreign.tfrecord import parse_sequence_example

    context, lists = parse_sequence_example(sequence_example(np.zeros((3, 2, 3)), np.array([5, 5]), 7), "here")
    assert set(context) == {"key", "particle_type"} and len(lists["position"]) == 3 and context["key"] == []
    for data in (b"\x0a\xff", b"\x0f", b"\xff" * 11, b"\x09\x00"):
        with pytest.raises(ConfigError, match=r"here must be a tf.SequenceExample, got"):
            parse_sequence_example(data, "here")


@pytest.mark.parametrize("gravity", [(0.0, -9.8), (0.0, -9.8, 0.0), (1.5, 0.0, -3.0)])
def test_gravity_is_estimated_from_what_flies(gravity):
    """Among particles at rest, in even motion and in collisions, from float32 positions, to half a percent."""
    generator, dt, axes = np.random.default_rng(1), 0.0025, len(gravity)
    time_T11 = dt * np.arange(120)[:, None, None]
    start, speed = generator.uniform(0.4, 0.6, (60, axes)), generator.normal(0, 0.3, (60, axes))
    speed[40:50] = 0.0
    pull = np.where(np.arange(60)[:, None] < 40, np.array(gravity), 0.0)
    path = start + speed * time_T11 + 0.5 * pull * time_T11**2
    path[:, 50:] += 1e-4 * generator.normal(size=(120, 10, axes))
    found = estimate_gravity([path.astype(np.float32)], dt)
    assert found == pytest.approx(gravity, abs=0.005 * float(np.linalg.norm(gravity)))
    with pytest.raises(ConfigError, match=r"gravity must be given where fewer than 20 particles fall, got 0; give it"):
        estimate_gravity([path[:, 40:].astype(np.float32)], dt)


def test_gravity_that_the_metadata_contradict_is_refused(tmp_path):
    """LagrangeBench says its size alone; zero is taken, another is compared with what flies."""
    time_T11 = np.arange(40)[:, None, None] / 60
    path = (0.5 + np.zeros((40, 30, 3)) - 0.5 * np.array([0, 0.2, 0]) * time_T11**2).astype(np.float32)
    for size, expected in ((0.0, (0.0, 0.0, 0.0)), (0.2, (0.0, -0.2, 0.0)), (1.0, None)):
        info = metadata(write_every=1, g_ext_magnitude=size)
        simulations = {"train": [(path, np.zeros(30, int), NOTHING)]}
        source = write(tmp_path / f"foreign{size}", "lagrangebench", simulations, info)
        arguments = options(tmp_path / f"mine{size}", source, gravity=None)
        if expected is None:
            with pytest.raises(ConfigError, match=r"gravity must be given .* g_ext_magnitude of 1, got 0.2"):
                import_trajectories.main(arguments)
            continue
        import_trajectories.main(arguments)
        (episode,) = EpisodeStore(tmp_path / f"mine{size}", "train")
        assert episode.gravity == pytest.approx(expected, abs=2e-3)


def test_what_leaves_the_bounds_later_is_told(tmp_path, capsys):
    """One line for the whole set says how many trajectories go out by more than a radius, and where the farthest
    particle is; all of them are taken. Particles of obstacles do not count."""
    walk = np.full((9, 4, 3), 0.5, np.float32)
    slight, fallen, risen = (walk.copy() for _ in range(3))
    slight[4:, 2, 1] = -0.02
    fallen[6:, 1, 1] = -0.25
    risen[3:, 3, 2] = 1.125
    types = TYPES[[0, 1, 2, 0]]
    wall_P3 = np.array([[-4.0, 0.5, 0.5]], np.float32)

    def imported(out, *paths):
        source = write(tmp_path / f"of_{out}", "plain", {"train": [(p, types, wall_P3) for p in paths]}, metadata())
        assert import_trajectories.main(options(tmp_path / out, source)) == 0
        assert len(EpisodeStore(tmp_path / out, "train")) == len(paths)
        return [line for line in capsys.readouterr().err.splitlines() if "bounds" in line]

    assert imported("kept", walk, slight) == []
    (line,) = imported("left", slight, risen, fallen)
    assert line.startswith("bounds: particles of 2 of 3 trajectories go farther out of them than a radius (0.035)")
    assert "train.npz: 00002 to y = -0.25 in frame 6, where bounds are [0.0, 1.0]" in line
    assert line.endswith("give bounds=… around all particles, or leave these trajectories out")


def test_materials_that_are_no_mapping(tmp_path):
    """Names without their types are refused by name."""
    with pytest.raises(ConfigError, match="materials must be a mapping, got 3"):
        import_trajectories.main({"from": str(tmp_path), "out": "x", "materials": 3})


def flights(*gravities):
    time_T11 = np.arange(20)[:, None, None] / 60
    start = np.random.default_rng(1).uniform(0.4, 0.6, (10, 3))
    paths = [(start + 0.5 * np.array(gravity) * time_T11**2).astype(np.float32) for gravity in gravities]
    return {"train": [(path, np.full(10, 5), np.full((1, 3), 0.2, np.float32)) for path in paths]}


@pytest.mark.parametrize("name", ["neuralmpm", "plain_h5"])
def test_each_simulation_may_have_its_own_gravity(name, tmp_path):
    """The file's, not an estimate over all; where its unit is nowhere written down, flights have to agree."""
    own = [(0.0, -0.5, 0.0), (0.2, 0.3, 0.0)]
    source = write(tmp_path / "foreign", name, flights(*own), metadata())
    one_each = name == "neuralmpm"  # a file

    def tell(factor):
        for number, gravity in enumerate(own):
            path, group = (f"train/sim_{number}.h5", "grav") if one_each else ("train.h5", f"0000{number}/gravity")
            with h5py.File(source / path, "a") as file:
                file.pop(group, None)
                file[group] = factor * np.array(gravity)

    tell(1.0)
    import_trajectories.main(options(tmp_path / "mine", source, gravity=None))
    assert [e.gravity for e in EpisodeStore(tmp_path / "mine", "train")] == own
    if one_each:
        tell(2.0)
        message = r"sim_0.h5: gravity must be that of particles in free flight, .* got \[0.0, -1.0,"
        with pytest.raises(ConfigError, match=message):
            import_trajectories.main(options(tmp_path / "other", source, gravity=None))


def test_what_published_files_have(tmp_path):
    """LagrangeBench tells three axes of a flat set, and calls a box with walls periodic; geoelements' properties are
    several for each particle."""
    flat = {name: [tuple(part[..., :2] if part.ndim > 1 else part for part in one) for one in simulations]
            for name, simulations in flights((0.0, 0.0, 0.0)).items()}  # fmt: skip
    for number, sides in enumerate(([False, False, True], [True] * 3)):
        info = metadata(2, periodic_boundary_conditions=sides, g_ext_magnitude=0)
        source = write(tmp_path / f"sides{number}", "lagrangebench", flat, info)
        import_trajectories.main(options(tmp_path / f"out{number}", source, gravity=None))
    ((path, types, _),) = flights((0.0, 0.0, 0.0))["train"]
    source = write(tmp_path / "own", "geoelements", {}, metadata())
    pickled_npz(source / "train.npz", (path, types, np.arange(20.0).reshape(10, 2)))
    import_trajectories.main(options(tmp_path / "mine", source))
    (episode,) = EpisodeStore(tmp_path / "mine", "train")
    first, second = (episode.material_parameters[f"material_property{end}"] for end in ("", "_1"))
    assert np.array_equal(first, 2.0 * np.arange(10)) and np.array_equal(second, first + 1)


def flat_simulations(count=24):
    """Falling particles of a box from 0.1 to 0.9, with a floor of particles."""
    time_T11 = 0.0025 * np.arange(30)[:, None, None]
    start = np.random.default_rng(2).uniform(0.4, 0.6, (count, 2))
    path = start + np.array([0.3, 0.0]) * time_T11 - 0.5 * np.array([0.0, 9.8]) * time_T11**2
    floor = np.stack([np.arange(0.1, 0.9, 0.005), np.full(160, 0.12)], -1)
    types = np.where(np.arange(count) % 2, 5, 7)
    one = path.astype(np.float32), types, floor.astype(np.float32)
    return {"train": [one] * 2, "valid": [one]}


def test_options_are_refused_by_their_own_names(tmp_path):
    """What the command line says wrong is not told of metadata.json."""
    for name in ("radius", "dt"):
        with pytest.raises(ConfigError, match=f"^{name} must be a finite number > 0, got -1.0"):
            import_trajectories.main({"from": str(tmp_path), "out": str(tmp_path / "new"), name: -1.0})


@pytest.fixture
def flat(tmp_path):
    info = metadata(2, bounds=[[0.1, 0.9], [0.1, 0.9]], dt=0.0025, default_connectivity_radius=0.015)
    source = write(tmp_path / "foreign", "deepmind", flat_simulations(), info)
    assert import_trajectories.main({"from": str(source), "out": str(tmp_path / "flat")}) == 0
    return tmp_path / "flat"


def network_of(manifest, **changes):
    own = manifest.config["imported"]
    sizes: dict[str, Any] = {"width": 8, "message_passing_steps": 1}
    return NetworkConfig(
        cell_size=own["radius"], dimensions=2, materials=tuple(own["materials"]), **(sizes | changes)
    )  # fmt: skip


def test_a_flat_set_is_one_layer(flat):
    """Materials by name, gravity from flight, the box at the origin; one layer of cells a level, also with noise."""
    manifest = Manifest.load(flat)
    own = manifest.config["imported"]
    assert own["materials"] == ["water", "goop"] and own["dimensions"] == 2 and own["obstacles"]
    assert own["gravity"] == pytest.approx((0.0, -9.8, 0.0), rel=0.01)
    episode = EpisodeStore(flat, "train")[0]
    assert episode.frame_rate_hz == 400 and episode.domain_size[:2] == pytest.approx((0.8, 0.8))
    assert episode.position_TN3[..., :2].min() > 0 and len(np.unique(episode.position_TN3[..., 2])) == 1
    normal_K3 = episode.obstacle_grid.normal_K3
    assert len(normal_K3) and np.abs(normal_K3[:, 1]).min() > 0.99 and not normal_K3[:, 2].any()
    config = network_of(manifest)
    batch = make_batch([(episode, 3), (episode, 9)], config, seeds=[5, 6])
    noisy_WN3 = perturbed_window(batch, 1e-3, 0.5, config.cell_size, config.dimensions)
    assert not torch.equal(noisy_WN3[..., :2], batch.window_WN3[..., :2])
    assert torch.equal(noisy_WN3[..., 2], batch.window_WN3[..., 2])
    origin_S3 = jittered_origin(batch, config.cell_size, config.dimensions)
    assert origin_S3[:, :2].any() and not origin_S3[:, 2].any()
    grid = build_hierarchy(noisy_WN3[-2], batch.scene_N, origin_S3, config.cell_size, config.levels)
    assert not grid.fraction_N3[:, 2].any()
    for level in grid.levels:
        assert not (level.direction_E >= 4).any()  # no neighbour across
    for shown in batch.symmetries_S[0]:
        assert shown.source[2] == 2 and not shown.mirrored[2] and not shown.mirrored[1]
        assert shown.mirror_sum[0] == pytest.approx(episode.domain_size[0])
    assert len(batch.symmetries_S[0]) == 2  # the mirror that keeps gravity


@pytest.mark.parametrize("changes", [{}, {"inputs": "relative"}, {"kind": "gns", "levels": 1}])
def test_a_flat_simulation_stays_in_its_plane(changes, flat):
    """Whatever a network says, z is the same in every frame, bit by bit; the start is the set's own six frames."""
    manifest = Manifest.load(flat)
    torch.manual_seed(0)
    network = build_network(network_of(manifest, **changes))
    statistics = manifest.statistics("train")
    if network.config.relative:
        network.normaliser.set_isotropic(torch.tensor(statistics.acceleration.std), 1e-3, 2)
    else:
        for quantity in ("velocity", "acceleration"):
            moments = getattr(statistics, quantity)
            network.normaliser.set(quantity, torch.tensor(moments.mean), torch.tensor(moments.std), 1e-4, 2)
    episode = EpisodeStore(flat, "train")[0]
    simulator = Simulator(network, episode.frame_rate_hz, "torch", "fp32")
    initial = InitialState.of_episode(episode)
    state = simulator.start([initial])
    expected_WN3 = torch.from_numpy(window(episode, 0, 5))
    assert torch.equal(state.velocity_NM3.transpose(0, 1).flip(0), (expected_WN3[1:-1] - expected_WN3[:-2]))
    (path_TN3,) = simulator.rollout([initial], 20)
    assert np.array_equal(path_TN3[..., 2], np.full_like(path_TN3[..., 2], episode.position_TN3[0, 0, 2]))
    assert not np.array_equal(path_TN3[-1, :, :2], path_TN3[-2, :, :2])
    with pytest.raises(ConfigError, match=r"network.velocity_history must be at most the 5 frames"):
        make_batch([(episode, 0)], network_of(manifest, velocity_history=6))


@pytest.mark.parametrize("radius", [0.015, 0.035, 0.029, 0.1, 1.45])
def test_the_plane_is_exact_however_it_is_computed(radius):
    """Division, product with the reciprocal, and that in one rounding find the same whole number."""
    z, cell = np.float32(flat_plane(radius, radius * 0.446)), np.float32(radius)
    inverse = np.float32(1) / cell
    half, unrounded = np.float32(0.5), np.float32(float(z) * float(inverse) - 0.5)
    for place in (z / cell - half, z * inverse - half, unrounded):
        assert place == np.round(place) and place >= 16


def test_thick_walls_point_outwards():
    """In a block of boundary particles the faces' cells have the faces' normals; in a thin sheet its own."""
    side = np.arange(0.4, 0.6, 0.01)
    block = np.stack(np.meshgrid(side, side, side), -1).reshape(-1, 3)
    grid = boundary_grid(block, 3, 0.0125)
    centre_K3 = (grid.cell_K3 + 0.5) * 0.0125
    top = (centre_K3[:, 1] > 0.59) & (np.abs(centre_K3[:, [0, 2]] - 0.5).max(-1) < 0.06)
    assert top.any() and np.abs(grid.normal_K3[top, 1]).min() > 0.95
    slope = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    sheet = np.stack([slope[:, 0], slope[:, 0], slope[:, 1]], -1)
    normal_K3 = boundary_grid(sheet, 3, 0.0125).normal_K3
    assert np.abs(normal_K3 @ np.array([1, -1, 0]) / np.sqrt(2)).min() > 0.95


@pytest.mark.parametrize(
    ("experiment", "change", "message"),
    [
        (False, {}, r"dataset.folder must be one of python -m datagen without \+experiment=imported"),
        (True, {"cell_size": 0.02}, r"network.cell_size must be the data's radius of 0.015, .* got 0.02; import it"),
        (True, {"dimensions": 3}, r"network.dimensions must be the data's 2, got 3"),
        (True, {"materials": ["water"]}, r"network.materials must be all of the data's \['water', 'goop'\]"),
    ],
)
def test_networks_that_do_not_fit_are_refused(experiment, change, message, flat, tmp_path, make_config):
    """Before anything is trained; an imported set is trained on with its experiment alone."""
    mapping = train_mapping(make_config(folder=str(flat)), tmp_path / "run")
    mapping["network"] |= change
    with pytest.raises(ConfigError, match=message):
        train.main(mapping | ({"imported": True} if experiment else {}))


def test_an_own_layout_may_bring_obstacle_cells(tmp_path):
    """Cells and normals of the plain layout are taken as they are, sorted."""
    path = np.full((8, 3, 3), 0.5, np.float32)
    cell, normal = np.array([[9, 2, 2], [1, 5, 3]]), np.array([[0, 1, 0], [1, 0, 0]], np.float32)
    source = write(tmp_path / "foreign", "plain", {"train": []}, metadata(obstacle_cell_size=1 / 64))
    np.savez(source / "train.npz", **{"a/position": path, "a/obstacle_cell": cell, "a/obstacle_normal": normal})
    import_trajectories.main(options(tmp_path / "mine", source))
    (episode,) = EpisodeStore(tmp_path / "mine", "train")
    grid = episode.obstacle_grid
    assert grid.cell_K3.tolist() == [[1, 5, 3], [9, 2, 2]] and grid.cell_size == 1 / 64
    assert grid.normal_K3.tolist() == [[1, 0, 0], [0, 1, 0]]
    assert [episode.materials[i] for i in episode.material_N] == ["fluid"] * 3


def test_a_flat_set_goes_the_whole_way(flat, tmp_path, make_config):
    """Training with noise, mirrors, pushforward and pictures of its rollouts, evaluation in both conventions, a rollout
    file with the set's names, and a picture of it."""
    symmetric = {"symmetry": "gravity", "noise_correlated_fraction": 0.3, "pushforward_fraction": 0.5}
    monitored = {"pushforward_frames": 4, "monitor_rollout_frames": 4}
    mapping = train_mapping(make_config(folder=str(flat)), tmp_path / "run", **symmetric, **monitored)
    assert train.main(mapping | {"imported": True}) == 0
    with Image.open(tmp_path / "run" / "pictures" / "rollout_000000012.png") as drawn:
        assert drawn.height == 30 + 2 * (360 + 12) + 30  # two rows of squares, for the box is one; and text
    weights = tmp_path / "flat.safetensors"
    export(tmp_path / "run" / "checkpoints" / "last.ckpt", weights)
    network, _ = load_weights(weights)
    assert network.config.dimensions == 2 and network.config.materials == ("water", "goop")
    assert network.normaliser.acceleration_std[2] == np.float32(1e-30)
    figures = tmp_path / "figures.json"
    options = {"weights": str(weights), "data": str(flat), "split": "train", "rollout_frames": 24, "backend": "torch"}
    assert evaluate.main(options | {"device": "cpu", "json": str(figures)}) == 0
    with pytest.raises(ConfigError, match=r"got none in .*; it has others: split=train, split=validation"):
        evaluate.main(options | {"device": "cpu", "split": "test"})
    report = json.loads(figures.read_text())
    own, (ours, *_, simulated) = report["set_convention"], report["rows"]
    assert own["one_step"]["free"] == pytest.approx(ours["one_step_mse"] / 2)
    assert own["rollout"]["free"] == pytest.approx(simulated["mean_position_mse"] * 24 / 23 / 2)
    for errors in own.values():
        assert errors["all"] == pytest.approx(errors["free"] * 24 / (24 + 160))
    config = RolloutConfig(str(weights), str(tmp_path / "out.vtkhdf"), data=str(flat), episode="train-000001", frames=9)
    path, _ = rollout(dataclasses.replace(config, device="cpu", backend="cpu"))
    result = read_rollout(path)
    assert [result.materials[i] for i in np.unique(result.material_N)] == ["water", "goop"]
    assert len(np.unique(result.position_TN3[..., 2])) == 1
    assert result.dimensions == 2 and compare_picture(result, [0, 8]).height == drawn.height
    for scene, message in (
        ("funnel", "dimensions must be the network's 2, got 3; take weights of 3D data"),
        (None, "data must be given with weights of imported data, which random scenes are not like"),
    ):
        with pytest.raises(ConfigError, match=message):
            rollout(RolloutConfig(str(weights), str(tmp_path / "out.vtkhdf"), scene=scene, frames=2, device="cpu"))
