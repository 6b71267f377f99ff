"""python -m tools.stability network: its cases, and its measures against closed forms."""

import importlib
import json
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import torch
from docs.pages import run_module
from hydra.core.global_hydra import GlobalHydra
from network.states import network_of, silent
from runtime.stability import family, one_particle, outcome_of, still_weights

from hgn.config import MpmConfig, SceneConfig
from hgn.runtime.rollouts import RolloutResult
from hgn.runtime.simulator import Simulator
from tools.stability import network, network_cases
from tools.stability.case import Case
from tools.stability.measures import conserved, share_of_way
from tools.stability.network import Runner, main
from tools.stability.network_cases import DIRECTIONS, GRAVITIES, WAY, cube, flight_frames, meeting

pytestmark = pytest.mark.usefixtures("solver_kernels")

SCENE = {"obstacle_count": 1, "obstacle_size": [0.1, 0.2]}
SCENE |= {"group_shapes": ["cube"], "group_count": 2, "group_size": 0.04}
GRAVITY = (0.0, -9.8, 0.0)
SMALL = {"frames": 3, "long_frames": 5, "scene": SCENE, "device": "cpu"}
CPU = MpmConfig(device="cpu")


def test_every_case_has_a_row(tmp_path, monkeypatch, capsys):
    """Each case has a line as it ends and a row of the JSON; a still network passes the cases of rest and fails those
    of motion."""
    for name, value in {"SPEED_FACTOR": 8.0, "DOMAIN_SIDES": (2,), "SPEEDS": (0.0, 0.1, 3.0)}.items():
        monkeypatch.setattr(network_cases, name, value)
    monkeypatch.setattr(network_cases, "TURNED_FRAMES", 3)
    monkeypatch.setattr(network_cases, "MEETING_FRAMES", 12)
    path = tmp_path / "reports" / "stability.json"
    weights = still_weights(tmp_path, materials=("sand",))
    assert main(SMALL | {"weights": weights, "json": str(path)}) == 0
    report = json.loads(path.read_text())
    assert {"device", "versions", "commit", "date", "command", "config"} <= report["meta"].keys()
    rows = {row["case"]: row for row in report["rows"]}
    flights = ["dropped", *(f"thrown at {speed} a second" for speed in ("0.1", "3"))]
    turned = [f"to rest in gravity along {way}" for way in ("-x", "-z")]
    families = (flights, [*(f"gravity {kind}" for kind in GRAVITIES), *turned], ["two bodies meet without gravity"])
    motion = [f"{case}, sand" for some in families for case in some]
    rests, singles = ["5 frames, sand"], ["single particle, sand"]
    slopes = [f"slides down {angle} degrees, sand" for angle in (15, 30, 45)]
    thrown = f"thrown at up to {8 * (2 * 9.8) ** 0.5:.1f} a second"
    held = ["particles x10", "domain x4", "at the end of 64000 cells"]
    assert list(rows) == [*motion, *rests, *held[:2], thrown, *singles, *slopes, held[2]]
    assert all(rows[f"{case}, sand"]["measured"] == pytest.approx(1.0, rel=1e-3) for case in flights)
    assert rows["thrown at 0.1 a second, sand"]["kept"] == pytest.approx(1.0, abs=1e-3)
    assert not any(rows[name]["held"] for name in motion if "none" not in name and rows[name]["measured"] != "refused")
    assert "gravity must be the weights'" in rows["gravity none, sand"]["beyond"]
    assert all(abs(rows[name]["solver_share_of_way"] - 1) < 0.3 for name in slopes)
    assert all(rows[name]["solver_rest"]["density"] > 0 for name in rests)
    for name in singles + slopes:
        assert not rows[name]["held"] and rows[name]["share_of_way"] <= 0 and "share of way" in rows[name]["beyond"]
    keys = {"part", "case", "predicted", "measured", "held", "beyond"}
    assert all(keys <= row.keys() and row["part"] == "network" for row in rows.values())
    for name in held:
        assert rows[name]["guard"] == "not needed", rows[name]
        assert "solver_collapse" in rows[name] or rows[name]["held"], rows[name]
    assert rows["particles x10"]["particles"] == pytest.approx(10 * rows["5 frames, sand"]["particles"], rel=0.05)
    assert rows["domain x4"]["particles"] == 4 * rows["5 frames, sand"]["particles"]
    assert rows["domain x4"]["domain_size"] == [2.0, 1.0, 2.0]
    printed = capsys.readouterr()
    *lines, last = printed.out.splitlines()
    assert [line[7 : 7 + len(name)] for line, name in zip(lines, rows, strict=True)] == list(rows)
    assert last == f"{sum(row['held'] for row in rows.values())} of {len(rows)} rows pass"
    assert printed.err.count("case 1 of ") == 1


class Repeats:
    """Accelerates as in the frame before, times a factor, with a drag and a wind along y."""

    def __init__(self, factor, drag, wind=0.0):
        self.factor, self.drag, self.wind = factor, drag, wind

    def __call__(self, state):
        velocity_NM3 = state.velocity_NM3
        gain_N3 = self.factor * (velocity_NM3[:, 0] - velocity_NM3[:, 1])
        return gain_N3 - self.drag * velocity_NM3[:, 0] + self.wind * torch.eye(3)[1]


def simulator_of(model):
    """Simulates with a network or with other accelerations."""
    if not isinstance(model, Repeats):
        return Simulator(model, 60.0, "torch")
    simulator = Simulator(network_of(torch.float32), 60.0, "torch")
    simulator.backend.predict = model
    return simulator


def rows_of(model, names, **scene):
    """The rows of families for sand, without the solver."""
    simulator = simulator_of(model)
    config = replace(simulator.network.config, materials=("sand",))
    cases = [case for name in names for case in family(name, config, solver=False, **({"group_size": 0.04} | scene))]
    runner = Runner(simulator, cases, None)
    return {case.name: runner.rows(case)[0] for case in cases}


def test_flight_against_its_closed_form():
    """Exact motion passes in all directions, speeds and gravities; 5 % less acceleration does not, and with a drag of
    0.5 % throws do not."""
    exact = rows_of(Repeats(1.0, 0.0), ("throw", "gravity"))
    assert len(exact) == 6 + 6 and all(row.held for row in exact.values()), exact
    frames = {name: throw["frames"] for name, throw in exact["thrown at 10 a second, sand"].more["throws"].items()}
    assert set(frames.values()) == {2, 4} and frames["diagonal"] == 4 and list(frames) == list(DIRECTIONS)
    assert exact["gravity none, sand"].more["throws"]["at rest"] == {
        "kept": None, "kept_frame": 0, "error": 0.0, "error_frame": 0, "across": 0.0, "frames": 60,
    }  # fmt: skip
    blown = rows_of(Repeats(1.0, 0.0, 1e-6), ("gravity",))["gravity half, sideways, sand"].more["throws"]["at rest"]
    # 1e-6 more in each frame: after n frames n (n + 1) / 2 of it, over n frames
    assert blown["across"] == pytest.approx(0.5e-6 * (blown["frames"] + 1) * 60**2 / 9.8, rel=0.05)
    weak = rows_of(Repeats(0.95, 0.0), ("throw", "gravity"))
    assert not any(row.held for name, row in weak.items() if name != "gravity none, sand")
    drag = rows_of(Repeats(1.0, 0.005), ("throw",))
    thrown = drag["thrown at 3 a second, sand"]
    frames = thrown.more["throws"]["+x"]["frames"]
    assert not any(row.held for row in drag.values()) and frames > 5
    speed, change = 1.0, 0.0
    for _ in range(frames):
        change -= 0.005 * speed
        speed += change
    assert thrown.more["throws"]["+x"]["kept"] == pytest.approx(speed, abs=2e-3)


def test_relative_inputs_move_exactly():
    """Relative inputs fly exactly without a contribution of their own; with random parameters they keep momentum, and
    fly exactly until walls are within their reach."""
    still = silent(network_of(torch.float32, inputs="relative", width=8, levels=2))
    rows = rows_of(still, ("gravity",))
    assert len(rows) == 6 and all(row.held for row in rows.values()), rows
    (row,) = rows_of(network_of(torch.float32, inputs="relative", message_passing_steps=1), ("collision",)).values()
    assert row.measured < 1e-5 and row.more["met"] > 0.0 and row.more["angular"] < 1e-4
    rows = rows_of(network_of(torch.float32, inputs="relative", message_passing_steps=1, levels=2), ("throw",))
    assert rows and all(row.held for row in rows.values()), rows


def test_flight_ends_before_the_walls():
    """In the last frame of a flight no particle is within two finest cells of a wall; two frames later one is."""
    for gravity in GRAVITIES.values():
        for way in DIRECTIONS.values():
            scene = cube(SceneConfig(gravity=gravity), "snow", np.full(3, 0.5), 3 * np.array(way))
            last = flight_frames(scene, 60.0, 0.07)
            for frame, clear in ((last, True), (last + 2, False)):
                seconds = frame / 60
                moved_3 = seconds * scene.velocity_N3[0] + 0.5 * seconds**2 * np.array(gravity)
                place_N3 = scene.position_N3 + moved_3
                assert ((place_N3 > 0.07) & (place_N3 < 0.93)).all() == clear or last == 60


@pytest.mark.parametrize(("wind", "held"), [(0.0, True), (-1e-3, False)])
def test_turned_gravity(wind, held, monkeypatch):
    """A hanging body is as far from a fall whichever way gravity points; with a wind along y it is not."""
    path = 0.5 * np.array(GRAVITY) * (np.arange(20)[:, None, None] / 60) ** 2
    calls = []

    def falls(scenes, *_):
        calls.append(len(scenes))
        return [RolloutResult((scene.position_N3 + path).astype(np.float32)) for scene in scenes]

    monkeypatch.setattr(network, "solver_trials", falls)
    monkeypatch.setattr(network_cases, "TURNED_FRAMES", 20)
    config = replace(network_of().config, materials=("snow",))
    turned = [case for case in family("gravity", config, group_size=0.03) if case.upright]
    runner = Runner(simulator_of(Repeats(0.0, 0.0, wind)), turned, CPU)
    rows = [runner.rows(case)[0] for case in turned]
    assert [row.held for row in rows] == [held] * 2 and calls == [8]  # both share the upright scenes
    assert not held or rows[0].measured == pytest.approx(1.0, rel=1e-3)


def test_collisions_against_the_solver():
    """The solver's cubes keep momentum, keep angular momentum but for the spin within cells, and share velocities.
    Bodies that pass through each other fail although both are kept, and so do bodies that are slowed down."""
    config = SceneConfig(group_size=0.04)
    scenes = [meeting(config, name) for name in ("snow", "water", "sand")]  # one kernel for three materials
    cases = [Case("meet", (scene,), 14, solver=True) for scene in scenes]
    film = Runner(Simulator(network_of(), 60.0), cases, CPU)._solver(cases[0].scenes, 14)
    momentum, angular, met = conserved(outcome_of(cases[0], film))
    assert momentum < 1e-3 and angular < 0.15 and 0.2 < met < 0.8
    made = scenes[0]
    still = (made.position_N3 + np.arange(14)[:, None, None] / 60 * made.velocity_N3).astype(np.float32)
    np.testing.assert_allclose(conserved(outcome_of(cases[0], [RolloutResult(still)])), 0, atol=1e-3)
    (passes,), (brakes,) = (rows_of(Repeats(1.0, drag), ("collision",)).values() for drag in (0.0, 0.01))
    assert not passes.held and passes.measured < 1e-3 and abs(passes.more["met"]) < 1e-3
    assert not brakes.held and brakes.measured > 0.1


def test_failures_are_reported():
    """A rollout that diverges has the frame; energy that grows and particles that leave the domain are failures."""
    simulator = Simulator(network_of(torch.float32), 60.0)
    push = torch.tensor(GRAVITY) / 60**2
    simulator.backend.predict = lambda state: push.expand(len(state.position_N3), 3)
    case = Case("single", (one_particle(),), 16, WAY, known_3=GRAVITY, known_frames=12)

    def row(case):
        return Runner(simulator, [case], None).rows(case)[0]

    assert row(case).held and row(case).more["share_of_way"] == pytest.approx(1, rel=1e-3)
    push[0] = 1e-2
    diverged = row(Case("single", case.scenes, 40))
    assert not diverged.held and diverged.measured < 40 and "diverged at frame" in diverged.beyond
    assert diverged.more["guard"] == "raised" and diverged.more["failed_scenes"] == 1
    heated = row(case)
    assert not heated.held and heated.measured == 16 and heated.beyond.startswith("energy growth")
    left = row(replace(case, limits=WAY[1:]))
    assert not left.held and left.beyond == "outside domain 1, must be at most 0"


def test_a_slope_against_a_closed_form():
    """A block without friction moves as its case expects, within the slope; friction reduces its share of the way."""
    made = family("slope", network_of().config)
    assert len({case.name for case in made}) == 9 and made[2].name == "slides down 45 degrees, water"
    case, (scene,) = made[2], made[2].scenes
    assert case.known_frames == 19 and case.frames == 21 and case.known_3 is not None
    along = np.array(case.known_3)
    np.testing.assert_allclose(along, 0.5 * 9.8 * np.array([0, -1, 1]), atol=1e-12)
    (slope,) = scene.obstacles
    above_N = (scene.position_N3 - slope.vertex_V3[0]) @ (np.array([0, 1, 1]) / 2**0.5)
    assert 0.5 * scene.cell_size < above_N.min() < scene.cell_size
    seconds = np.arange(case.frames)[:, None, None] / 60
    for share in (1.0, 0.7):
        slid = (scene.position_N3 + 0.5 * share * along * seconds**2).astype(np.float32)
        assert share_of_way(outcome_of(case, [RolloutResult(slid)])) == pytest.approx(share, rel=1e-3)
    low, high = slope.vertex_V3.min(0), slope.vertex_V3.max(0)
    assert ((slid.mean(1) >= low - 0.08) & (slid.mean(1) <= high + 0.08)).all()


def test_scenes_follow_the_network():
    """A network without obstacle features gets no obstacles, and only its materials; each length of rest cases is one
    launch of the solver."""
    blind = network_of(obstacle_features=False, materials=("water", "snow")).config
    rest, domains = family("rest", blind, group_size=0.05), family("domain", blind, group_size=0.05)
    assert [case.name for case in rest] == ["3000 frames, water", "3000 frames, snow"]
    assert [case.name for case in domains] == ["domain x4", "domain x9", "domain x16"]
    scenes = [scene for case in rest + domains for scene in case.scenes]
    assert not any(scene.obstacles or (scene.material_N == 1).any() for scene in scenes)
    runner = Runner(Simulator(network_of(), 60.0), rest, CPU)
    assert [len(pending) for pending in runner._to_solve.values()] == [2]


def test_the_command_names_its_parts(capfd):
    """Help names the parts; an unknown part is refused; options of a part are checked, in one line."""
    assert run_module("tools.stability", ["--help"]) == 0
    printed = capfd.readouterr()
    assert "python -m tools.stability network" in printed.out and not printed.err
    assert run_module("tools.stability", ["bridge"]) == 2
    refused = capfd.readouterr().err
    assert "must be one of" in refused and "network" in refused
    assert run_module("tools.stability", ["network", "weights=none.pt"]) == 2
    assert "weights must be an existing file" in capfd.readouterr().err
    assert run_module("tools.stability", ["solver", "cases=[galery]"]) == 2
    refused = capfd.readouterr().err
    assert refused.startswith("error: cases[0] must be one of steps, ") and refused.count("\n") == 1


def test_a_signal_while_a_part_is_loaded(capfd, monkeypatch):
    """Ctrl-C during the first seconds, in which PyTorch is loaded, ends in one line. Hydra can start again."""
    monkeypatch.setattr(importlib, "import_module", mock.Mock(side_effect=KeyboardInterrupt))
    assert run_module("tools.stability", ["solver"]) == 130
    assert capfd.readouterr().err == "error: interrupted\n"
    assert not GlobalHydra.instance().is_initialized()
