"""Trajectories of other programs: this project's own episodes in each format are the same data after the import."""

import dataclasses
import json
import re
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from data.foreign_writers import metadata, pickled_npz, write
from PIL import Image
from scene.test_episode import members_of
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
from hgn.scene.episode import decode_episode
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
    again = decode_episode(first.key, members_of(first))
    assert again.past_HN3 is not None and np.array_equal(again.past_HN3, first.past_HN3)


def test_training_losses_are_the_same(data, tmp_path):
    """Training on imported episodes gives the losses of training on the episodes themselves."""
    source = write(tmp_path / "foreign", "deepmind", own_simulations(data), metadata())
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
    with pytest.raises(ConfigError, match=r"gravity must be given if fewer than 20 particles fall freely, got 0; give"):
        estimate_gravity([path[:, 40:].astype(np.float32)], dt)


def test_gravity_that_the_metadata_contradict_is_refused(tmp_path):
    """LagrangeBench stores only the size of gravity. Zero is accepted, and other sizes are compared with free flight in
    the data."""
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
    assert line.startswith("bounds: particles of 2 of 3 trajectories leave them by more than a radius (0.035)")
    assert "to y = -0.25 in frame 6 of " in line and "train.npz: 00002 with bounds [0.0, 1.0];" in line
    assert line.endswith("give bounds=… around all particles, or leave these trajectories out")
    archive = tmp_path / "of_left" / "train.npz"  # names that the file's author chose
    np.savez(archive, **{name.replace("00002/", "\x1b[31m/"): array for name, array in np.load(archive).items()})
    assert import_trajectories.main(options(tmp_path / "named", archive.parent)) == 0
    assert "train.npz: \\x1b[31m with bounds" in capsys.readouterr().err


def test_a_folder_without_trajectories(tmp_path, capsys):
    """The error is the only line: no progress of an import that has not begun."""
    with pytest.raises(ConfigError, match="from must be a folder with train"):
        import_trajectories.main(options(tmp_path / "out", tmp_path))
    assert not capsys.readouterr().err


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
    tell(2.0)
    message = r"(sim_0.h5|00000): gravity must agree with free flight, .* got \[0.0, -1.0,"
    with pytest.raises(ConfigError, match=message):
        import_trajectories.main(options(tmp_path / "other", source, gravity=None))


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.05, -1.0, 10.0])
def test_a_gravity_that_the_flights_contradict_is_refused(factor, tmp_path):
    """As one that was copied from another set. Zero, a set without gravity, is accepted; so is that of the settings."""
    gravity = [0.0, factor * -0.5, 0.0]
    source = write(tmp_path / "foreign", "plain", flights((0.0, -0.5, 0.0)), metadata(gravity=gravity))
    if factor not in (0.0, 1.05):
        with pytest.raises(ConfigError, match=r"gravity must agree with free flight, .* instead of \[0.0, -0.5, 0.0\]"):
            import_trajectories.main(options(tmp_path / "mine", source, gravity=None))
        with pytest.raises(ConfigError, match=r"instead of \[0.0, -2.22e-05, 0.0\]; check dt"):
            import_trajectories.main(options(tmp_path / "mine", source, gravity=None, dt=2.5))
    given = None if factor in (0.0, 1.05) else gravity
    import_trajectories.main(options(tmp_path / "mine", source, gravity=given))
    assert Manifest.load(tmp_path / "mine").config["imported"]["gravity"] == gravity


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


def test_a_radius_with_no_or_all_neighbours_is_refused(tmp_path, capsys):
    """By the radius that contains about 15; the mean is printed."""
    side = 0.3 + 0.04 * np.arange(5)
    lattice = np.stack(np.meshgrid(side, side, side), -1).reshape(-1, 3)
    walk = np.repeat(lattice[None], 9, axis=0) + 0.0001 * np.random.default_rng(0).normal(size=(9, 125, 3))
    wall = np.array([[0.1, 0.1, 0.1], [0.1, 0.1, 0.2]])
    source = write(tmp_path / "near", "plain", {"train": [(walk, np.full(125, 5), wall)]}, metadata())
    message = r"radius must contain at least 1 neighbour on average, got 0 within 0.002; radius=(0.0\d+) contains abou"
    with pytest.raises(ConfigError, match=message) as refused:
        import_trajectories.main(options(tmp_path / "mine", source, radius=0.002))
    found = re.search(message, str(refused.value))
    assert found is not None and 0.056 < float(found[1]) < 0.08  # the edges of the lattice have fewer than the inside
    import_trajectories.main(options(tmp_path / "mine", source, radius=float(found[1])))
    (mean,) = re.findall(r"obstacles: yes, radius 0.0\d+ with (\d+) neighbours on average", capsys.readouterr().out)
    assert 10 <= int(mean) <= 20
    side = 0.3 + 0.016 * np.arange(11)
    lattice = np.stack(np.meshgrid(side, side, side), -1).reshape(1, -1, 3)
    walk = lattice + 0.0001 * np.random.default_rng(0).normal(size=(9, 11**3, 3))
    source = write(tmp_path / "dense", "plain", {"train": [(walk, np.full(11**3, 5), wall)]}, metadata())
    message = r"radius must contain at most 1000 neighbours on average, got 1.3e\+03 within 0.3; radius=0.02\d contains"
    with pytest.raises(ConfigError, match=message):
        import_trajectories.main(options(tmp_path / "all", source, radius=0.3))


def test_positions_in_another_unit_than_bounds_are_refused_for_bounds(tmp_path):
    """Positions rounded to mm are refused because of the bounds, not because of their resolution, distances or
    gravity. Wide bounds are accepted if they are given with the command."""
    walk = np.random.default_rng(0).uniform(300, 460, (9, 125, 3)).round().astype(np.float32)
    simulations = {"train": [(walk, np.full(125, 5), NOTHING)]}
    source = write(tmp_path / "foreign", "plain", simulations, metadata(gravity=list(GRAVITY)))
    with pytest.raises(ConfigError, match=r"bounds must contain the particles, .* 100% of .* in \[\[30\d.0, "):
        import_trajectories.main(options(tmp_path / "mine", source, gravity=None))
    walk, bounds = np.random.default_rng(0).uniform(300, 460, (9, 125, 3)), [[0, 1e5]] * 3
    source = write(tmp_path / "wide", "plain", {"train": [(walk, np.full(125, 5), NOTHING)]}, metadata(bounds=bounds))
    own = options(tmp_path / "mine", source, radius=30)
    with pytest.raises(ConfigError, match=r"bounds must be at most 100 times as wide as .* in \[\[300.\d*, .* give b"):
        import_trajectories.main(own)
    import_trajectories.main(own | {"bounds": bounds})


def flat_simulations(count=24):
    """Falling particles of a box from 0.1 to 0.9, with a floor of particles."""
    time_T11 = 0.0025 * np.arange(30)[:, None, None]
    start = np.random.default_rng(2).uniform(0.46, 0.54, (count, 2))
    path = start + np.array([0.3, 0.0]) * time_T11 - 0.5 * np.array([0.0, 9.8]) * time_T11**2
    floor = np.stack([np.arange(0.1, 0.9, 0.005), np.full(160, 0.12)], -1)
    types = np.where(np.arange(count) % 2, 5, 7)
    one = path.astype(np.float32), types, floor.astype(np.float32)
    return {"train": [one] * 2, "valid": [one]}


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
    """For any network z is bitwise the same in every frame. The start is the set's first six frames."""
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
        (False, {}, r"add \+experiment=imported, or use another folder"),
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
    fields = {"a/position": path, "a/obstacle_cell": cell, "a/obstacle_normal": normal}
    none = {"b/position": path, "b/obstacle_cell": cell[:0], "b/obstacle_normal": normal[:0]}
    np.savez(source / "train.npz", **fields, **none)
    import_trajectories.main(options(tmp_path / "mine", source))
    episode, free = EpisodeStore(tmp_path / "mine", "train")
    assert not len(free.obstacle_grid.cell_K3)
    grid = episode.obstacle_grid
    assert grid.cell_K3.tolist() == [[1, 5, 3], [9, 2, 2]] and grid.cell_size == 1 / 64
    assert grid.normal_K3.tolist() == [[1, 0, 0], [0, 1, 0]]
    assert [episode.materials[i] for i in episode.material_N] == ["fluid"] * 3


def test_a_flat_set_goes_the_whole_way(flat, tmp_path, make_config):
    """Training with noise, mirrors, pushforward and pictures of its rollouts, evaluation in both conventions, a rollout
    file with the set's names, and a picture of it."""
    symmetric = {"symmetry": "gravity", "noise_correlated_fraction": 0.3, "pushforward_fraction": 0.5}
    monitored = {"pushforward_frames": 4, "monitor_rollout_frames": 4, "monitor_every": 12}
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
        ("funnel", "dimensions must be the network's 2, got 3; use weights of 3D data"),
        (None, "data must be given with weights of imported data, which differ from random scenes"),
    ):
        with pytest.raises(ConfigError, match=message):
            rollout(RolloutConfig(str(weights), str(tmp_path / "out.vtkhdf"), scene=scene, frames=2, device="cpu"))
