"""python -m hgn.rollout where little is said: shipped weights, random scenes, examples by name, pictures."""

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from network.states import silent

from hgn import rollout
from hgn.config import DEFAULT_WEIGHTS, NetworkConfig
from hgn.network.build import build_network
from hgn.render import pictures
from hgn.runtime.weights import WeightsInfo, find_weights, load_weights, save_weights, shipped_weights
from hgn.scene.rollout_file import read_rollout
from hgn.schema import ConfigError

MAXIMUM_BYTES, ALL_BYTES = 8_000_000, 20_000_000


@pytest.fixture
def small_pictures(monkeypatch):
    for name in ("compare_picture", "animate"):
        monkeypatch.setattr(pictures, name, partial(getattr(pictures, name), size=64))


@pytest.fixture
def weights(tmp_path):
    """A small network that predicts no acceleration."""
    config = NetworkConfig(width=8, levels=2, message_passing_steps=1)
    save_weights(tmp_path / "still.safetensors", silent(build_network(config)), WeightsInfo(config, 60.0, 1 / 64))
    return str(tmp_path / "still.safetensors")


def test_shipped_weights_are_whole():
    """Each shipped file loads, is small enough to ship, as all are together, and has a card that names it."""
    assert set(shipped_weights()) == {"mechanics", "obstacles_small", "own_physics"}
    assert sum(path.stat().st_size for path in shipped_weights().values()) <= ALL_BYTES
    for name, path in shipped_weights().items():
        assert find_weights(name) == path and path.stat().st_size <= MAXIMUM_BYTES
        _, info = load_weights(path)
        assert info.updates > 0
        assert f"{name}.safetensors" in path.with_suffix(".md").read_text()


def test_names_and_paths(tmp_path, monkeypatch):
    """A path stays a path, whether there is such a file or not; an unknown name lists what is shipped. Weights that
    only an experiment makes are answered with its command."""
    monkeypatch.chdir(tmp_path)
    Path("mine").touch()
    for path in ("mine", "missing.safetensors", "folder/missing"):
        assert find_weights(path) == Path(path)
    shipped = "weights must be a file or the name of shipped weights (mechanics, obstacles_small, own_physics), got "
    for name, message in (
        ("sand", "'sand'"),
        ("obstacle_small", "'obstacle_small'; did you mean obstacles_small?"),
        ("obstacles", "'obstacles'; use one of these, or train with python -m hgn.train +experiment=obstacles"),
    ):
        with pytest.raises(ConfigError, match=f"^{re.escape(shipped + message)}$"):
            find_weights(name)


def test_nothing_said(tmp_path, small_pictures, monkeypatch, capsys):
    """Without out, it draws: three files in rollout/, named by the scene, a random one with the default network."""
    monkeypatch.chdir(tmp_path)
    assert rollout.main({"frames": 2}) == 0
    names = capsys.readouterr().out.split()
    assert names == [f"rollout/random_13.{ending}" for ending in ("vtkhdf", "png", "gif")]
    made = read_rollout(tmp_path / names[0])
    assert len(made.obstacles) == 5 and made.source["scene"] == "random, seed 13"
    assert made.source["weights"] == f"{DEFAULT_WEIGHTS}.safetensors"
    assert all(Path(name).stat().st_size > 1000 for name in names)


def test_a_network_without_obstacles_gets_none(tmp_path):
    """Its random scene is one of the second data set's: four cubes and nothing else."""
    config = NetworkConfig(width=8, levels=2, message_passing_steps=1, obstacle_features=False)
    file, out = tmp_path / "free.safetensors", str(tmp_path / "a.vtkhdf")
    save_weights(file, silent(build_network(config)), WeightsInfo(config, 60.0, 1 / 64))
    assert rollout.main({"weights": str(file), "frames": 2, "out": out}) == 0
    made = read_rollout(out)
    assert not made.obstacles and made.position_TN3.shape[1] == 4296


def test_scenes(tmp_path, weights, small_pictures, monkeypatch):
    """Different seeds draw different scenes. An example is found by its name; a file of this name has priority, and a
    folder does not. With out=... no pictures are drawn by default."""
    monkeypatch.chdir(tmp_path)
    sizes = set()
    for seed in (1, 2):
        assert rollout.main({"weights": weights, "frames": 2, "seed": seed, "out": "a.vtkhdf"}) == 0
        sizes.add(read_rollout("a.vtkhdf").position_TN3[0].tobytes())
    assert len(sizes) == 2 and not Path("a.png").exists()
    Path("funnel").mkdir()  # as hgn.export arrays=funnel scene=funnel makes one
    assert rollout.main({"weights": weights, "frames": 2, "scene": "funnel", "out": "b/f.vtkhdf", "render": True}) == 0
    assert sorted(path.name for path in Path("b").iterdir()) == ["f.gif", "f.png", "f.vtkhdf"]
    assert len(read_rollout("b/f.vtkhdf").obstacles) == 5
    Path("funnel").rmdir()
    Path("funnel").write_text("groups: [{shape: cube, size: 0.05, position: [0.5, 0.5, 0.5], material: sand}]\n")
    assert rollout.main({"weights": weights, "frames": 2, "scene": "funnel", "out": "c.vtkhdf"}) == 0
    assert not read_rollout("c.vtkhdf").obstacles


def test_what_may_surprise_is_said(tmp_path, weights, capsys):
    """A network has learned one kind of water and one friction, and notes report other values in a scene file. Further
    notes name meshes that are no solids, that are outside of the domain, for example in millimetres, or within one
    cell. The last line explains how to draw the file."""
    (tmp_path / "open.obj").write_text("v 0.2 0.2 0.2\nv 0.4 0.2 0.2\nv 0.2 0.2 0.4\nf 1 2 3\n")
    obstacles = "{shape: square, size: 0.1, position: [0.8, 0.2, 0.5], friction: 0.2}, {mesh: open.obj}"
    obstacles += ", {mesh: open.obj, scale: 200, position: [500, 0, 0]}, {mesh: open.obj, scale: 0.01}"
    group = "{shape: cube, size: 0.05, position: [0.5, 0.5, 0.5], material: sand, youngs_modulus_pa: 1e5}"
    (tmp_path / "stiff.yaml").write_text(f"particles_per_cell: 4\ngroups: [{group}]\nobstacles: [{obstacles}]\n")
    out = str(tmp_path / "a.vtkhdf")
    assert rollout.main({"weights": weights, "frames": 2, "scene": str(tmp_path / "stiff.yaml"), "out": out}) == 0
    said = capsys.readouterr().err
    assert re.search(r"^\d+ particles, 2 frames$", said, re.MULTILINE)
    assert "no effect: youngs_modulus_pa of groups; still simulates each material with the solver's" in said
    assert "a sheet, not a solid, because it is not watertight: open.obj; close its" in said and "square" not in said
    assert "no effect: friction of surfaces; still simulates that of its data, own_physics the scene's" in said
    assert "particles_per_cell: 4, shipped weights were trained with 8; motion is unreliable" in said
    assert said.count("outside the domain, out of reach of particles: open.obj (x 540 to 580, y 40 to 40") == 1
    assert said.endswith(f"\nrender=true also draws it, or python -m tools.render rollout={out} out=pictures\n")
    assert said.count("smaller than a cell of 0.0156: open.obj (x 0.002 to 0.004, ") == 1


def test_what_weights_do_not_support_is_refused_before_notes(tmp_path, weights, capsys):
    """If weights do not support an elastic group, the error precedes notes on the scene and progress bars."""
    group = "{shape: cube, size: 0.05, position: [0.5, 0.5, 0.5], material: elastic, youngs_modulus_pa: 1e5}"
    (tmp_path / "a.yaml").write_text(f"groups: [{group}]\nfloor_friction: 0.5\n")
    with pytest.raises(ConfigError, match="elastic"):
        rollout.main({"weights": weights, "scene": str(tmp_path / "a.yaml"), "out": str(tmp_path / "a.vtkhdf")})
    assert capsys.readouterr() == ("", "")


def test_particles_out_of_place_are_reported(tmp_path, weights, capsys):
    """A network that predicts no acceleration carries a thrown cube into a cone, or out of the domain."""
    group = "{{shape: cube, size: 0.05, position: [0.3, 0.5, 0.5], material: sand, velocity: [{}, 0, 0]}}"
    for speed, places in ((6, ["inside obstacles"]), (-3, []), (-9, ["beyond the domain"])):
        cone = "{shape: cone, size: 0.4, position: [0.6, 0.5, 0.5]}"
        (tmp_path / "cone.yaml").write_text(f"groups: [{group.format(speed)}]\nobstacles: [{cone}]\n")
        given = {"weights": weights, "frames": 4, "scene": str(tmp_path / "cone.yaml")}
        assert rollout.main(given | {"out": str(tmp_path / "a.vtkhdf")}) == 0
        said = re.findall(r"^(.*): \d+\.\d% of the particles in the last frame$", capsys.readouterr().err, re.MULTILINE)
        assert said == places


def test_what_is_faster_than_the_data_is_said(tmp_path, capsys):
    """Where the weights know how fast groups of their data began, a faster one is simulated and a line gives both.
    Absolute inputs are a guess in flight too, and where the speed is unknown."""
    file, scene = tmp_path / "still.safetensors", tmp_path / "fast.yaml"
    group = "{shape: cube, size: 0.05, position: [0.5, 0.5, 0.5], material: sand, velocity: [3, 0, -4]}"
    scene.write_text(f"groups: [{group}]\n")
    contact, flight = "collisions and contacts are unreliable\n", "motion is unreliable, but free flight is exact"
    for inputs, known, wanted in (
        ("relative", None, None), ("relative", 5.0, None), ("relative", 5 - 1e-6, None),
        ("relative", 3.0, f"up to 3; beyond that {contact}"), ("absolute", 5.0, None),
        ("absolute", 3.0, f"up to 3; beyond that {flight}"), ("absolute", None, f"an unknown speed; {flight}"),
    ):  # fmt: skip
        config = NetworkConfig(width=8, levels=2, message_passing_steps=1, inputs=inputs)
        info = WeightsInfo(config, 60.0, 1 / 64, maximum_initial_speed=known)
        save_weights(file, silent(build_network(config)), info)
        given = {"weights": str(file), "frames": 2, "scene": str(scene), "out": str(tmp_path / "a.vtkhdf")}
        assert rollout.main(given) == 0
        line = "velocity: groups start with up to 5 domain units per second, in the data of still with "
        said = capsys.readouterr().err
        assert f"{line}{wanted}" in said if wanted else line not in said
    np.savez(tmp_path / "fast.npz", position=np.full((1, 3), 0.5), velocity=np.array([[1e38, 0, 1e38]]))
    scene.write_text("groups: [{particles: fast.npz, material: sand}]\n")
    with pytest.raises(ConfigError, match="diverged at frame 1"):  # without a warning of NumPy
        rollout.main(given)
    assert "groups start with up to 1.41e+38 domain units" in capsys.readouterr().err
