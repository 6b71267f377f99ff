"""The gallery: observables against closed forms, broken trajectories, files, and both commands."""

import functools
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from runtime.stability import still_weights

from hgn.config import MpmConfig
from hgn.runtime.rollouts import RolloutResult
from hgn.scene.scene_file import find_scene, load_scene, scene_files
from hgn.schema import ConfigError, from_stored
from tools.report import finite
from tools.scenes import filled
from tools.stability import gallery, network, solver, solver_gallery
from tools.stability.broken import BROKEN
from tools.stability.case import gallery_cases
from tools.stability.gallery import load_case, load_gallery
from tools.stability.observables import OBSERVABLES, BoundEntry, Film, period, series
from tools.stability.row import Report

pytestmark = pytest.mark.usefixtures("solver_kernels")

TINY = """
domain_size: [0.25, 0.25, 0.25]
particles_per_cell: 1
groups:
  - {shape: cube, size: 0.04, position: [0.125, 0.12, 0.125], material: water}
  - {shape: cube, size: 0.03, position: [0.075, 0.12, 0.075], material: water}
measure:
  kind: drop
  frames: 11
  vary:
    - {range: [-0.01, 0.01], add: {groups.0.position.1: 1, groups.1.size: 0.5}}
  far: {shape: cube, size: 0.03, position: [0.185, 0.12, 0.185], material: water}
  bounds:
    - {of: height, frames: [5, 10], times: [0.95, 1.05]}
    - {of: centre, group: 1, frames: [5, 10], within: 0.003}
    - {of: far_effect, frames: [10, 10], between: [0, 0.5]}
"""


def tiny_file(folder, **changes):
    """The tiny scene with other fields of `measure`."""
    content = yaml.safe_load(TINY)
    content["measure"] |= changes
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in content.items() if v is not None}))
    return path


def film_of(path_TN3, **more):
    """A film of three particles of the tiny scene's kind."""
    scene = filled(0, path_TN3[0], (0.0, 0.0, 0.0), domain_size=(0.25,) * 3, particles_per_cell=1.0)
    return Film(scene, path_TN3.astype(np.float32), 60.0, 1 / 64, 1.0, **more)


def bound_of(of, **more):
    return BoundEntry(**({"of": of, "frames": (5, 5), "between": (0.0, 1.0)} | more))


def test_observables():
    """Figures of three particles that fall freely and move along x, from formulas."""
    start_N3 = np.array([[0.10, 0.20, 0.10], [0.11, 0.20, 0.10], [0.15, 0.20, 0.10]])
    time_T11 = np.arange(11)[:, None, None] / 60
    fall_TN3 = start_N3 + time_T11 * np.array([0.3, 0.0, 0.0]) + 0.5 * time_T11**2 * np.array([0.0, -9.8, 0.0])
    film, x = film_of(fall_TN3, beside_far_TN3=fall_TN3 + np.array([0.0, 0.0, 1 / 64])), 0.12 + 5 / 60 * 0.3
    height, speed = 0.2 - 0.5 * 9.8 * (5 / 60) ** 2, 9.8 * 4.5 / 60
    expected = {
        "height": 64 * height, "top": 64 * height, "crowding": 2 / 3, "centre": x, "front": x + 0.0292,
        "spread": np.sqrt(0.5 * np.var([0.1, 0.11, 0.15])), "squared_speed": 0.3**2 + speed**2, "far_effect": 1.0,
        "momentum": 0.3, "displacement": 64 * np.hypot(5 / 60 * 0.3, 0.2 - height),
        "energy_gain": 0.5 * 0.3**2 - 0.5 * (9.8 / 120) ** 2,
    }  # fmt: skip
    for name, value in expected.items():
        assert series(film, bound_of(name))[0] == pytest.approx(value, rel=1e-3), name
    assert series(film, bound_of("moved", along=(2.0, 0, 0)))[0] == pytest.approx(5 / 60 * 0.3, rel=1e-3)
    assert series(film, bound_of("moved", along=(2.0, 0, 0), since=5))[1] == pytest.approx(5 / 60 * 0.3, rel=1e-3)
    for along, wide in (((0, 0, 1), 0.0), ((2.0, 0, 0), np.std([0.1, 0.11, 0.15]))):
        assert series(film, bound_of("spread", along=along))[0] == pytest.approx(wide, abs=1e-6)
    assert series(film, bound_of("below", at=0.19)) == [1.0, 1.0]
    assert series(film, bound_of("beyond", at=0.14))[0] == pytest.approx(1 / 3)
    assert {*expected, "moved", "below", "beyond"} == OBSERVABLES.keys()


def test_figures_of_series():
    """Means, extremes, swing and period of a wave; a creeping series has no period."""
    wave = np.sin(2 * np.pi * 5 * np.arange(1, 41) / 60)
    bound = bound_of("centre", take="period", frames=(5, 200))
    assert bound.reduced(wave) == pytest.approx(60, rel=0.02)
    assert np.isnan(period(np.linspace(0.0, 1.0, 20)))
    bound = bound_of("centre", take="swing", frames=(10, 20))
    assert bound.reduced([0.0, 3.0, 5.0, 4.0, 9.0]) == 2.0
    relative = bound_of("centre", between=None, times=(0.9, 1.2), within=0.5)
    assert relative.interval(10.0) == (8.5, 12.5) and relative.interval(-10.0) == (-12.5, -8.5)
    assert bound_of("centre", between=(-1.0, 2.0)).interval(7.0) == (-1.0, 2.0)


def test_broken_trajectories():
    """Each changes a falling, moving body in its own way and leaves the first frame where it is, but for its shape."""
    path_TN3 = np.random.default_rng(0).random((1, 50, 3)) * 0.1 + 0.08
    path_TN3 = (path_TN3 + np.arange(31)[:, None, None] * np.array([0.001, -0.001, 0.0])).astype(np.float32)
    scene = film_of(path_TN3).scene
    wrong = {name: change(path_TN3, scene, 60.0) for name, change in BROKEN.items()}
    assert (wrong["frozen"] == path_TN3[0]).all()
    np.testing.assert_allclose(wrong["delayed"][20], path_TN3[10], atol=1e-6)
    np.testing.assert_allclose(wrong["hurried"][[10, 30]], path_TN3[[20, 30]], atol=1e-6)
    assert wrong["compressed"][5, 0, 1] - 0.03125 == pytest.approx(0.6 * (path_TN3[5, 0, 1] - 0.03125), rel=1e-3)
    assert wrong["squeezed"][5].std() < path_TN3[5].std()
    np.testing.assert_allclose(wrong["drifting"][30] - path_TN3[30], np.tile([0.025, 0, 0.01], (50, 1)), atol=1e-6)
    assert 0.1 < 64 * (wrong["stirred"][5] - path_TN3[5]).std() < 0.2
    path_TN3[:5, 3] = np.nan  # enters in frame 5
    assert np.isnan(BROKEN["frozen"](path_TN3, scene, 60.0)[:5, 3]).all()


@functools.cache
def loaded():
    """The cases of the gallery, whose scenes are loaded once."""
    return gallery_cases("gallery")


@pytest.mark.parametrize("draw", [0, 1, 2])
def test_gallery_files(draw):
    """The gallery has 28 scenes and more in 12 kinds and more; all rows have two bounds; draws differ."""
    plain = [case.gallery for case in loaded()]
    cases = load_gallery(f"gallery_{draw}") if draw else plain
    assert len(cases) >= 28 and len({case.measure.kind for case in cases}) >= 12
    for case in cases:
        lines = case.file.read_text().splitlines()
        assert lines[0].startswith("# ") and max(map(len, lines)) <= 140, case.name
        assert all(-np.inf < low <= high < np.inf for low, high in (b.interval(1.0) for b in case.measure.bounds))
        sides = [length * cells for length in case.scenes[0].domain_size for cells in gallery.GRID_CELLS]
        assert all(side == round(side) for side in sides), f"{case.name}: whole cells on both grids"
    if draw:
        assert not {case.digest for case in cases} & {case.digest for case in plain}
        assert all(case.content["seed"] == draw for case in cases)


OUTSIDE = {"shape": "cube", "size": 0.03, "position": [0.2, 0.12, 0.2], "material": "water"}


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        (None, "measure must be a section with frames and bounds"),
        ({"far": OUTSIDE}, "measure.far: groups[0] (cube of water) must lie between"),
        *(
            ({"vary": [{"range": [0, 1], "add": {place: 1}}]}, "measure.vary[0].add must be places ")
            for place in ("groups.7.size", "groups.².size")
        ),
        *(
            (
                {"vary": [{"range": ends, "add": {"seed": 1}}]},
                "measure.vary[0].range must be in order, from -1e9 to 1e9",
            )
            for ends in ([-1e308, 1e308], [0, float("inf")])
        ),
        ([], "measure.bounds must be at least one, got []"),
        ([{"of": "hight"}], "measure.bounds[0].of must be one of height, "),
        ([{"of": "energy_gain", "group": 2}], "measure.bounds[0].group must be one of the 2 groups"),
        ([{"of": "far_effect"}], "measure.bounds[0].of must be measured in scenes with a body in measure.far"),
        ([{"of": "height", "frames": [5, 15]}], "measure.bounds[0].frames must be below frames (11), got 15"),
        ([{"of": "height", "frames": [4, 10]}], "measure.bounds[0].frames must be two multiples of 5 in order"),
        ([{"of": "height", "between": None}], "measure.bounds[0].between must be given, or else times or within"),
        ([{"of": "height", "within": 1.0}], "measure.bounds[0].between must be given, or else times or within"),
        ([{"of": "height", "between": [2, 1]}], "measure.bounds[0].between must be finite and in order"),
        ([{"of": "height", "at": 0.5}], "measure.bounds[0].at must be left out, got 0.5"),
        ([{"of": "below"}], "measure.bounds[0].at must be given with below, got None"),
        ([{"of": "height", "since": 5}], "measure.bounds[0].since must be left out except with moved"),
        ([{"of": "height", "take": "median"}], "measure.bounds[0].take must be one of mean, max"),
        ([{"of": "height", "upper": 1}], "measure.bounds[0].upper is not a known key"),
    ],
)
def test_bad_files(tmp_path, bounds, message):
    """A mistake in a gallery file is one line that starts with the file: a bound, a place, or no measure at all."""
    if isinstance(bounds, list):
        whole = [{"frames": [5, 10], "between": [0, 1]} | bound for bound in bounds]
        bounds = {"bounds": [{k: v for k, v in bound.items() if v is not None} for bound in whole], "far": None}
    path = tiny_file(tmp_path, **(bounds or {}))
    if bounds is None:
        path.write_text(TINY[: TINY.index("measure:")])
    with pytest.raises(ConfigError) as error:
        load_case("tiny", path)
    assert str(error.value).startswith(f"{path}: {message}") and "\n" not in str(error.value)


def test_draws(tmp_path):
    """A draw changes coupled values by factors of one number, is the same each time, and has its own seed."""
    path = tiny_file(tmp_path)
    first, again, other = (load_case("tiny", path, draw).content for draw in (1, 1, 2))
    assert first == again and first["seed"] == 1
    change = first["groups"][0]["position"][1] - 0.12
    assert 0 < abs(change) <= 0.01 and first["groups"][1]["size"] - 0.03 == pytest.approx(0.5 * change)
    assert other["groups"][0]["position"][1] != first["groups"][0]["position"][1]


def test_both_commands(tmp_path, monkeypatch, capsys):
    """The solver writes figures on both grids and of broken trajectories; a network is compared with them.

    A network that holds particles still fails, a changed scene is refused, a changed bound is not.
    """
    path = tiny_file(tmp_path)
    monkeypatch.setattr(gallery, "scene_files", lambda folder: {"tiny": path})
    monkeypatch.setattr("tools.stability.case.REFERENCE", tmp_path)
    monkeypatch.setattr(solver_gallery, "REFERENCE", tmp_path)
    json_file = tmp_path / "gallery_solver.json"
    options = {"weights": still_weights(tmp_path), "device": "cpu", "cases": ["gallery"]}
    with pytest.raises(
        ConfigError, match=r"gallery only where .*gallery_solver.json .*; run python -m tools.stability"
    ):
        network.main(options)
    assert solver.main({"cases": ["gallery"], "device": "cpu", "json": str(json_file)}) == 0
    report = json.loads(json_file.read_text())
    rows = report["rows"]
    assert [row["case"] for row in rows] == [
        "tiny: height, frames 5 to 10", "tiny: centre, group 1, frames 5 to 10", "tiny: far_effect, frame 10"
    ]  # fmt: skip
    assert all(set(row["solver"]) == {"64", "96"} and set(row["broken"]) == set(BROKEN) for row in rows)
    assert rows[0]["held"] and {"frozen", "compressed"} <= set(rows[0]["caught"])
    assert rows[1]["held"] and "drifting" in rows[1]["caught"]
    failed, summary = capsys.readouterr().out.splitlines()
    assert failed.startswith("FAILS  tiny: far_effect, frame 10: ") and summary == "2 of 3 rows pass"
    own = report["scenes"]["tiny"]
    assert own["kind"] == "drop" and len(own["series"]["64"]["height"].split()) == 2
    assert own["simulated"]["date"] == report["meta"]["date"]
    shown = tmp_path / "network.json"
    assert network.main(options | {"json": str(shown)}) == 0
    judged = {row["case"]: row for row in json.loads(shown.read_text())["rows"]}
    assert list(judged) == [row["case"] for row in rows]
    assert not judged["tiny: height, frames 5 to 10"]["held"]
    assert judged["tiny: far_effect, frame 10"]["measured"] == 0.0
    centre = judged["tiny: centre, group 1, frames 5 to 10"]  # tight bounds can be told apart in the printed text
    assert [float(x) for x in centre["predicted"].split(" to ")] == pytest.approx([centre["low"], centre["high"]], 1e-4)
    assert judged["tiny: height, frames 5 to 10"]["solver"] == pytest.approx(rows[0]["solver"]["64"], rel=1e-3)
    tiny_file(tmp_path, bounds=[{"of": "height", "frames": [10, 10], "within": 90.0}])
    assert network.main(options | {"json": str(shown)}) == 0
    assert [row["held"] for row in json.loads(shown.read_text())["rows"]] == [True]
    # the solver's rows, too, are compared with other bounds without a new simulation
    never = {"of": "height", "frames": [5, 10], "between": [0, 90]}
    tiny_file(tmp_path, bounds=[never, {"of": "centre", "group": 1, "frames": [5, 10], "within": 0.0025}])
    monkeypatch.setattr(solver_gallery, "solver_trials", lambda *_: pytest.fail("simulated again"))
    assert solver.main({"cases": ["gallery"], "device": "cpu", "json": str(tmp_path / "again.json")}) == 0
    again = json.loads((tmp_path / "again.json").read_text())
    assert again["scenes"]["tiny"] == own and [row["held"] for row in again["rows"]] == [False, True]
    assert "; no broken trajectory fails: frozen " in again["rows"][0]["beyond"]
    assert again["rows"][1]["broken"] == rows[1]["broken"]
    tiny_file(tmp_path, far=None, bounds=[{"of": "height", "frames": [10, 10], "within": 90.0}])
    with pytest.raises(ConfigError, match=r"tiny.yaml must be as it was when gallery_solver.json was measured"):
        network.main(options)


def falling(scenes, config, frames, *_):
    """Trajectories of the solver's form, without the solver: figures have more digits than the JSON stores."""
    fall_T11 = 0.0123456789 * (np.arange(frames)[:, None, None] / frames) ** 2
    return [RolloutResult((scene.position_N3 - [0.3, 1.0, 0.0] * fall_T11).astype(np.float32)) for scene in scenes]


def test_one_scene(tmp_path, monkeypatch, capsys):
    """Both commands check scenes by name. The solver's JSON keeps the rows of all other scenes, in order; the network's
    has only rows of the chosen scenes. Wrong names and frames are refused before a simulation."""
    files = {name: tiny_file(tmp_path).rename(tmp_path / f"{name}.yaml") for name in ("a", "c", "mine", "z")}
    shown, simulated = dict(files), []
    del shown["mine"]

    def trials(scenes, *options):
        simulated.extend(scenes)
        return falling(scenes, *options)

    for module in (gallery, solver_gallery):
        monkeypatch.setattr(module, "scene_files", lambda folder: shown)
    for module in ("case", "solver_gallery"):
        monkeypatch.setattr(f"tools.stability.{module}.REFERENCE", tmp_path)
    monkeypatch.setattr(solver_gallery, "solver_trials", trials)
    json_file, own_file = tmp_path / "gallery_solver.json", tmp_path / "network.json"

    def solve(*cases, file=json_file):
        capsys.readouterr()
        simulated.clear()
        assert solver.main({"cases": list(cases), "device": "cpu", "json": str(file)}) == 0
        return capsys.readouterr().out.splitlines(), json.loads(file.read_text())

    def check(*cases):
        capsys.readouterr()
        options = {"weights": still_weights(tmp_path), "device": "cpu", "json": str(own_file)}
        assert network.main(options | {"cases": list(cases)}) == 0
        return capsys.readouterr().out.splitlines(), json.loads(own_file.read_text())

    # without stored figures of the other scenes the JSON is one of a part, and refused as that of the gallery
    printed, part = solve("gallery:c")
    assert list(part["scenes"]) == ["c"] and len(simulated) == 4
    assert [line.partition(":")[0] for line in printed] == [*3 * ["passes c"], "3 of 3 rows pass"]
    with pytest.raises(ConfigError, match=r"a.yaml must be as it was when gallery_solver.json was measured"):
        check("gallery")
    printed, before = solve("gallery")
    assert list(before["scenes"]) == ["a", "c", "z"] and len(simulated) == 8
    assert printed == ["9 of 9 rows pass"]
    printed, again = solve("gallery", file=tmp_path / "again.json")
    assert not simulated and [again[key] for key in ("rows", "scenes")] == [before[key] for key in ("rows", "scenes")]

    shown, before["meta"]["date"] = dict(files), "2001-01-01T00:00:00+00:00"
    json_file.write_text(json.dumps(before))
    printed, after = solve("gallery:mine", "gallery:z")
    assert len(simulated) == 4 and len(printed) == 7 and printed[-1] == "6 of 6 rows pass"
    assert all(line.startswith(("passes mine: ", "passes z: ")) for line in printed[:-1])
    assert list(after["scenes"]) == ["a", "c", "mine", "z"]
    assert [row["scene"] for row in after["rows"]] == [name for name in after["scenes"] for _ in range(3)]
    assert after["meta"] == before["meta"], "it describes the rows that were copied"
    assert after["scenes"].pop("mine")["simulated"]["date"] > before["meta"]["date"]
    assert json.dumps(after["scenes"]) == json.dumps(before["scenes"])
    assert json.dumps([row for row in after["rows"] if row["scene"] != "mine"]) == json.dumps(before["rows"])

    printed, judged = check("gallery:mine")
    assert len(printed) == 4 and "FAILS  mine: height" in printed[0] and printed[-1] == "2 of 3 rows pass"
    assert len(judged["rows"]) == 3 and judged["meta"]["config"]["cases"] == ["gallery:mine"]
    printed, judged = check("gallery")
    assert len(judged["rows"]) == 12 and printed[-1] == "8 of 12 rows pass"
    assert [line[:6] for line in printed[:-1]] == 4 * ["FAILS "]

    monkeypatch.setattr("datagen.mpm.device.initialise", lambda *_: pytest.fail("the solver started"))
    for command in (solve, check):
        with pytest.raises(ConfigError, match=r"^cases must be scenes of conf/gallery, .*; did you mean mine\?$"):
            command("gallery:mein")
    with pytest.raises(ConfigError, match=r"^json must be left out with several draws of the gallery"):
        solve("gallery:c", "gallery_1")
    tiny_file(tmp_path, bounds=[{"of": "height", "frames": [5, 15], "within": 1}]).rename(files["mine"])
    with pytest.raises(ConfigError, match=r"mine.yaml: measure.bounds\[0\].frames must be below frames \(11\), got 15"):
        solve("gallery:mine")


def test_other_settings_of_the_solver():
    """Rows that were simulated with other settings are not copied, and not dropped."""
    report = json.loads((gallery.REFERENCE / "gallery_solver.json").read_text())
    mpm = from_stored(MpmConfig, report["meta"]["solver"] | {"snow_hardening": 9.0}, "mpm")
    chosen = {case.name: case.gallery for case in loaded()[:1]}
    rows = solver_gallery.gallery_rows("gallery", chosen, mpm, Report("solver", {}, None, scenes={}))
    with pytest.raises(ConfigError, match=r"cases must be the whole gallery where .* has other settings of the solver"):
        next(rows)


def test_the_stored_figures_pass():
    """The solver's stored figures are those of today's scenes and within today's bounds on both grids; of each row a
    broken trajectory fails."""
    report = json.loads((gallery.REFERENCE / "gallery_solver.json").read_text())
    rows = {row["case"]: row for row in report["rows"]}
    chosen = {case.name: case.gallery for case in loaded()}
    made = Report("solver", report["meta"], None, scenes={})
    mpm = from_stored(MpmConfig, report["meta"]["solver"], "mpm")
    made.add(solver_gallery.gallery_rows("gallery", chosen, mpm, made), brief=True)
    assert json.dumps(finite(made.rows)) == json.dumps(report["rows"]), "a new run would change stored rows"
    assert json.dumps(made.more["scenes"]) == json.dumps(report["scenes"])
    for case in loaded():
        series = report["scenes"][case.name]["series"]
        for bound in case.gallery.measure.bounds:
            own = {cells: bound.reduced([float(x) for x in one[bound.key].split()]) for cells, one in series.items()}
            low, high = bound.interval(own["64"])
            name, wrong = f"{case.name}: {bound.label}", rows[f"{case.name}: {bound.label}"]["broken"].values()
            assert set(own) == {"64", "96"} and all(low <= figure <= high for figure in own.values()), name
            assert any(figure is None or not low <= figure <= high for figure in wrong), name


@pytest.mark.parametrize("value", ["", "[", 9000 * "[", None, [], 5])
@pytest.mark.parametrize("depth", range(6))
def test_damaged_figures(tmp_path, monkeypatch, depth, value):
    """The solver's figures in another form end in one line with the command that writes them, in both commands."""
    case = loaded()[0]
    report = json.loads((gallery.REFERENCE / "gallery_solver.json").read_text())
    mpm = from_stored(MpmConfig, report["meta"]["solver"], "mpm")
    place, *names = report, "scenes", case.name, "series", "64", case.gallery.measure.bounds[0].key
    for name in names[: depth - 1]:
        place = place[name]
    if depth:
        place[names[depth - 1]] = value
    text = json.dumps(report) if depth else value if isinstance(value, str) else json.dumps(value)
    (tmp_path / "gallery_solver.json").write_text(text)
    for module in ("tools.stability.case", "tools.stability.solver_gallery"):
        monkeypatch.setattr(f"{module}.REFERENCE", tmp_path)
    monkeypatch.setattr("tools.stability.case.load_gallery", lambda _: [case.gallery])
    monkeypatch.setattr(solver_gallery, "solver_trials", lambda *_: pytest.fail("simulated"))
    solved = Report("solver", {}, None, scenes={})
    rows = solver_gallery.gallery_rows("gallery", {case.name: case.gallery}, mpm, solved)
    for read in (lambda: gallery_cases("gallery"), lambda: next(rows)):
        with pytest.raises(ConfigError, match=r"solver.json must be a report of .*run python -m tools.stab"):
            read()


def test_scenes_load_as_scene_files():
    """Commands that take scene files find the gallery's by name and ignore `measure`."""
    names = scene_files("gallery")
    assert not names.keys() & scene_files("example").keys()
    assert find_scene("pool_medium") == names["pool_medium"]
    assert load_scene(find_scene("pool_medium")).particle_count == 6022
    assert Path(names["torus"]).with_suffix(".obj").is_file()
