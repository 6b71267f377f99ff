"""Scene files that claim far more than they hold, or take far more time, alone or with the files that they name."""

import numpy as np
from data.strange_files import cases, glb, instances, saved, spiral

from hgn.scene.obstacle_grid import build_obstacle_grid
from hgn.scene.scene_file import load_scene
from hgn.scene.scene_notes import notes_on_files
from hgn.system.yaml_files import read_yaml


def scene(text):
    return saved("s.yaml", text.encode())


GROUP = "groups:\n- {shape: cube, size: 0.1, position: [0.5, 0.5, 0.5], material: sand}\n"


def many_keyframes(folder):
    """200 obstacles with the same 125 keyframes, of which the first is turned."""
    times = ", ".join(f"{{time: {number}}}" for number in range(1, 125))
    entries = [f"&k [{{time: 0, rotation: [0, 90, 0]}}, {times}]"] + 199 * ["*k"]
    cones = "".join(f"- {{shape: cone, size: 0.1, position: [0.1, 0.1, 0.1], keyframes: {k}}}\n" for k in entries)
    path = scene(f"{GROUP}obstacles:\n{cones}")(folder)
    notes_on_files(load_scene(path))
    return path


TRI = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -3\n"


def stored_zeros(folder):
    """Five million particles in a small file."""
    np.savez_compressed(folder / "p.npz", position=np.zeros((5_000_000, 3), np.float32))
    return folder / "p.npz"


def named_often(make, key, folder, count=256):
    """A scene that names a file 256 times."""
    name, group = make(folder).name, GROUP if key == "mesh" else ""
    section = "obstacles" if key == "mesh" else "groups"
    return scene(group + f"{section}:\n" + count * f"- {{{key}: {name}}}\n")(folder)


def many_names(count, folder):
    """A scene that names a spiral's file by 60 names, or `count` such files."""
    names = [saved(f"m{number}.obj", spiral(990))(folder).name for number in range(count)]
    entries = "".join(f"- mesh: {number * './'}{names[number % count]}\n" for number in range(60))
    return scene(GROUP + "obstacles:\n" + entries)(folder)


MESHES = {
    "instances": glb(instances(1500)),
    "pentagons": saved("m.obj", b"v 0 0 0\nv 9 0 0\nv 1 1 0\nv 0 9 0\nv -9 5 0\n" + 4000 * b"f 1 2 3 4 5\n"),
    "triangles of one place": saved("m.obj", TRI[:24] + 6000 * TRI[24:]),
}


def cells(path):
    """The obstacle cells of a scene, as all commands compute them."""
    loaded = load_scene(path)
    return build_obstacle_grid(loaded.obstacles, loaded.cell_size, loaded.seed, loaded.domain_size)


cases("experiment", {"ten megabytes": saved("e.yaml", b"a: [" + 2_500_000 * b"[], " + b"]")}, read_yaml)
cases(
    "scene",
    {
        "large obstacle": scene(GROUP + "obstacles:\n- {shape: cone, size: 9000, position: [0.5, 0.2, 0.5]}\n"),
        "sheet of 9000": scene(GROUP + "obstacles:\n- {shape: square, size: 9000, position: [0.5, 0.2, 0.5]}\n"),
        "larger obstacle": scene(GROUP + "obstacles:\n- {shape: half_sphere, size: 9.0e+20, position: [0, 0.2, 0]}\n"),
        "large domain": scene(
            GROUP + "domain_size: [9000, 9000, 9000]\nobstacles:\n- {shape: square, size: 9000, position: [1, 0, 1]}\n"
        ),
        "obstacles": scene(GROUP + "obstacles:\n" + 300 * "- {shape: cone, size: 0.01, position: [0.1,0.1,0.1]}\n"),
        "groups": scene("groups:\n" + 300 * "- {shape: cube, size: 0.001, position: [0.5,0.5,0.5], material: sand}\n"),
        "sheets on one another": scene(
            GROUP + "obstacles:\n" + 256 * "- {shape: square, size: 0.1, position: [0.2, 0.2, 0.2]}\n"
        ),
        "a mesh named often": lambda folder: named_often(saved("m.obj", 60_000 * b"v 1 2 3\n" + TRI), "mesh", folder),
        **{
            f"{name} named often": lambda folder, make=make: named_often(make, "mesh", folder, 130)
            for name, make in MESHES.items()
        },
        **{f"{count} spirals of 60 names": lambda folder, count=count: many_names(count, folder) for count in (1, 60)},
        "particles named often": lambda folder: named_often(stored_zeros, "material: sand, particles", folder),
        "particles without a name": scene("groups: [{particles: '', material: sand}]\n"),
        **{
            f"a name of {len(name)}": scene(f"{GROUP}obstacles:\n- mesh: {name}\n")
            for name in (300 * "a" + ".obj", 5000 * "a" + ".obj", 2500 * "a/" + "m.obj")
        },
        "keyframes": scene(
            GROUP + "obstacles:\n- shape: cone\n  size: 0.1\n  position: [0.1, 0.1, 0.1]\n  keyframes:\n"
            + "".join(f"  - {{time: {number}}}\n" for number in range(800))
        ),
        "keyframes of many obstacles": many_keyframes,
        "long file": scene("groups: " + 990_000 * "a"),
        "long text": scene("groups: " + 240_000 * "a"),
        "deep flow": scene("groups: " + 4_000 * "["),
        "short lists": scene("groups: [" + 3_000 * "[]," + "]"),
        "anchors": scene("a: &a " + 100_000 * "[1]\n"),
        "ten megabytes": scene("groups: [" + 2_500_000 * "[], " + "]"),
        "merges": scene(
            "a0: &a0 {x: 1}\n" + "".join(f"a{n}: &a{n} {{<<: [{9 * f'*a{n - 1}, '}]}}\n" for n in range(1, 12))
        ),
        "itself": scene("groups: &a [*a, *a]\n"),
        "complex keys": scene(100_000 * "? "),
        "nested keys": scene("".join(" " * n + "a:\n" for n in range(600))),
        "digits": scene("cell_size: " + 200_000 * "9" + "\n" + GROUP),
        "hexadecimal digits": scene("seed: 0x" + 200_000 * "f" + "\n" + GROUP),
        "base 60": scene("cell_size: 1" + 80_000 * ":10" + "\n" + GROUP),
        **{f"tag {tag}": scene(f"{GROUP}seed: !!{tag}\n") for tag in ("bool 5", "timestamp a", "int ''", "float ''")},
        "velocity": scene(GROUP[:-2] + ", velocity: [1.0e+300, 0, 0]}\n"),
        "objects": scene("a: !!python/object/apply:os.system [true]\n"),
    },
    cells,
)  # fmt: skip
