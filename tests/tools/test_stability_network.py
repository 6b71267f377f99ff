"""python -m tools.stability network: its cases, what counts as held, and the runtime's guard."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from docs.pages import run_module
from network.states import network_of
from PIL import Image

from hgn.config import MpmConfig, NetworkConfig, SceneConfig
from hgn.runtime.rollouts import RolloutResult, simulate_scenes
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.weights import WeightsInfo, save_weights
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.random_scene import REPORT_SEED
from hgn.schema import ConfigError, from_mapping
from tools.measures import neighbours
from tools.solver_rollouts import solver_trials
from tools.stability import network, network_cases, network_motion
from tools.stability.network import (
    STIR_FRAMES,
    case_row,
    case_trials,
    collapse,
    energy_growth,
    guard_row,
    initial_states,
    main,
    misfallen,
    mispassed,
    passing,
    pulled,
    share_of_way,
    solver_beside,
    solver_of,
)
from tools.stability.network_cases import Case, StabilityNetworkConfig, cases, cube
from tools.stability.network_motion import (
    DIRECTIONS,
    GRAVITIES,
    conserved,
    flight_frames,
    flight_row,
    meeting,
    motion_rows,
    turned_rows,
)

SCENE = {"obstacle_count": 1, "obstacle_size": [0.1, 0.2]}
SCENE |= {"group_shapes": ["cube"], "group_count": 2, "group_size": 0.04}
GRAVITY = (0.0, -9.8, 0.0)
SMALL = {"frames": 3, "long_frames": 5, "scene": SCENE, "device": "cpu", "solver_device": "cpu"}
MATERIAL_NAMES = ("water", "sand", "snow")
RESTING = {"inputs": "relative", "rest_threshold": 0.1}


@pytest.fixture
def weights(tmp_path):
    network = network_of(torch.float32, width=8, message_passing_steps=1, levels=2)
    with torch.no_grad():  # nothing accelerates: whatever happens is the scene's
        network.decode.second.weight.zero_()
        network.decode.second.bias.zero_()
        network.normaliser.acceleration_mean.zero_()
    path = tmp_path / "still.safetensors"
    save_weights(path, network, WeightsInfo(network.config, 60.0, 1 / 64, updates=3))
    return str(path)


def test_every_case_has_a_row(weights, tmp_path, monkeypatch, capsys):
    """Each case is simulated and told with the report's keys; what rests holds everywhere."""
    monkeypatch.setattr(network_cases, "SPEED_FACTOR", 8.0)
    monkeypatch.setattr(network_cases, "DOMAIN_SIDES", (2,))
    path, picture = tmp_path / "reports" / "stability.json", tmp_path / "reports" / "stability.png"
    assert main(SMALL | {"weights": weights, "json": str(path), "picture": str(picture)}) == 0
    with Image.open(picture) as drawn:
        assert drawn.height > 14 * 300
    report = json.loads(path.read_text())
    assert {"device", "versions", "commit", "date", "command", "config"} <= report["meta"].keys()
    rows = {row["case"]: row for row in report["rows"]}
    flights = ["dropped", *(f"thrown at {speed} a second" for speed in ("0.1", "0.3", "1", "3", "10"))]
    motion = [
        f"{case}, {name}" for name in MATERIAL_NAMES
        for case in (
            *flights, *(f"gravity {kind}" for kind in GRAVITIES),
            *(f"to rest in gravity along {way}" for way in ("-x", "-z")), "two bodies meet without gravity",
        )
    ]  # fmt: skip
    rests = [f"5 frames, {name}" for name in MATERIAL_NAMES]
    singles = [f"single particle, {name}" for name in MATERIAL_NAMES]
    slopes = [f"slides down {angle} degrees, {name}" for name in MATERIAL_NAMES for angle in (15, 30, 45)]
    thrown = f"thrown at up to {8 * (2 * 9.8) ** 0.5:.1f} a second"
    held = ["particles x10", "domain x4", "at the end of 64000 cells"]
    assert list(rows) == [
        *motion, *rests, *held[:2], thrown, *singles, *slopes, held[2], "a weight that explodes"
    ]  # fmt: skip
    # what never accelerates misses all of gravity, keeps what goes sideways, and meets nothing
    assert all(rows[f"{case}, sand"]["measured"] == pytest.approx(1.0, rel=1e-3) for case in flights)
    assert rows["thrown at 0.1 a second, snow"]["kept"] == pytest.approx(1.0, abs=1e-3)
    assert not any(rows[name]["held"] for name in motion if "none" not in name and rows[name]["measured"] != "refused")
    assert all("gravity must be the weights'" in rows[f"gravity none, {name}"]["beyond"] for name in MATERIAL_NAMES)
    assert all(abs(rows[name]["solver_share_of_way"] - 1) < 0.3 for name in slopes)
    assert all(rows[name]["solver_rest"]["density"] > 0 for name in rests)
    for name in singles + slopes:  # nor does a particle fall, or a block slide
        assert not rows[name]["held"] and rows[name]["share_of_way"] <= 0 and "of its way" in rows[name]["beyond"]
    keys = {"part", "case", "predicted", "measured", "held", "beyond"}
    assert all(keys <= row.keys() and row["part"] == "network" for row in rows.values())
    for name in held:
        assert rows[name]["held"] and rows[name]["guard"] == "not needed", rows[name]
    assert rows["particles x10"]["particles"] == pytest.approx(10 * rows["5 frames, sand"]["particles"], rel=0.05)
    assert rows["domain x4"]["particles"] == 4 * rows["5 frames, sand"]["particles"]
    assert rows["domain x4"]["domain_size"] == [2.0, 1.0, 2.0]
    broken = rows["a weight that explodes"]
    assert broken["held"] and broken["guard"] == "raised" and "diverged at frame 1" in broken["beyond"]
    assert "a weight that explodes" in capsys.readouterr().out


class Repeats(torch.nn.Module):
    """Accelerates as in the frame before, by a factor; adds its velocity times another, and a wind along y."""

    def __init__(self, factor, drag, wind=0.0):
        super().__init__()
        self.wind = wind
        self.config, self.weight = network_of().config, torch.nn.Parameter(torch.zeros(1))
        self.factor, self.drag = factor, drag

    def forward(self, state):
        velocity_NM3 = state.velocity_NM3
        gain_N3 = self.factor * (velocity_NM3[:, 0] - velocity_NM3[:, 1])
        return gain_N3 - self.drag * velocity_NM3[:, 0] + self.wind * torch.eye(3)[1]


def motion_of(network, cases, solver=None):
    simulator = Simulator(network, 60.0, "torch")
    scene = SceneConfig(group_size=0.04)
    return {row.case: row for row in motion_rows(simulator, scene, ("sand",), cases, 8, solver)}


def test_flight_against_its_closed_form():
    """What goes on accelerating as it did before the start holds in all directions, speeds and gravities; with 5 % less
    a frame it does not, and with a drag of 0.5 % throws do not."""
    exact = motion_of(Repeats(1.0, 0.0), ("throw", "gravity"))
    assert len(exact) == 6 + 6 and all(row.held for row in exact.values()), exact
    assert exact["thrown at 3 a second, sand"].more["scenes"] == 8
    frames = {name: throw["frames"] for name, throw in exact["thrown at 10 a second, sand"].more["throws"].items()}
    assert set(frames.values()) == {2, 4} and frames["diagonal"] == 4
    assert exact["gravity none, sand"].more["throws"]["at rest"] == {
        "kept": None, "error": 0.0, "across": 0.0, "frames": 60,
    }  # fmt: skip
    blown = motion_of(Repeats(1.0, 0.0, 1e-6), ("gravity",))["gravity half, sideways, sand"].more["throws"]["at rest"]
    # 1e-6 more in each frame: after n frames n (n + 1) / 2 of it, over n frames
    assert blown["across"] == pytest.approx(0.5e-6 * (blown["frames"] + 1) * 60**2 / 9.8, rel=0.05)
    weak = motion_of(Repeats(0.95, 0.0), ("throw", "gravity"))
    assert not any(row.held for name, row in weak.items() if name != "gravity none, sand")
    drag = motion_of(Repeats(1.0, 0.005), ("throw",))
    assert not any(row.held for row in drag.values())
    assert "of its velocity in frame" in drag["thrown at 1 a second, sand"].beyond


@pytest.mark.parametrize(("together", "rollouts"), [(None, [7]), (1, [1] * 7), (8, [8]), (5, [5, 5])])
def test_scenes_of_a_rollout(together, rollouts, monkeypatch):
    """Each rollout of a row has as many scenes as asked for; the row says how many, and has all seven throws."""
    asked: list[int] = []

    def counted(simulator, scenes, frames):
        asked.append(len(scenes))
        return simulate_scenes(simulator, scenes, frames)

    monkeypatch.setattr(network_motion, "simulate_scenes", counted)
    simulator = Simulator(Repeats(1.0, 0.0), 60.0, "torch")
    throws = {name: 10 * np.array(way) for name, way in network_motion.DIRECTIONS.items()}
    row = flight_row(simulator, "thrown", SceneConfig(group_size=0.04), "sand", throws, together)
    assert asked == rollouts and row.held and row.more["scenes"] == rollouts[0], row
    assert list(row.more["throws"]) == list(throws) and row.more["particles"] == 135 * rollouts[0]


def test_relative_inputs_take_any_gravity():
    """A network in relative inputs whose own answer is nothing flies exactly: the judges are green where they can."""
    network = network_of(torch.float32, inputs="relative", width=8, levels=2)
    with torch.no_grad():
        network.decode.second.weight.zero_()
        network.decode.second.bias.zero_()
    rows = motion_of(network, ("gravity",))
    assert len(rows) == 6 and all(row.held for row in rows.values()), rows


def test_relative_inputs_keep_momentum_in_a_collision():
    """With any weights two bodies that meet without gravity keep momentum and angular momentum, as the judge has it,
    whatever becomes of them."""
    network = network_of(torch.float32, inputs="relative", message_passing_steps=1)
    (row,) = motion_of(network, ("collision",)).values()
    assert row.measured < 1e-5 and row.more["met"] > 0.0 and row.more["angular"] < 1e-4


def test_flight_ends_before_the_walls():
    """No particle of the closed form comes within two finest cells of a wall, where it still is on the next frame."""
    for gravity in GRAVITIES.values():
        for way in DIRECTIONS.values():
            scene = cube(SceneConfig(gravity=gravity), "snow", np.full(3, 0.5), 3 * np.array(way))
            last = flight_frames(scene, 60.0, 0.07)
            for frame, clear in ((last, True), (last + 2, False)):
                seconds = frame / 60
                moved_3 = seconds * scene.velocity_N3[0] + 0.5 * seconds**2 * np.array(gravity)
                place_N3 = scene.position_N3 + moved_3
                assert ((place_N3 > 0.07) & (place_N3 < 0.93)).all() == clear or last == 60


def test_flights_end_where_contacts_may_begin():
    """With walls seen from three finest cells on flights are judged before: exact with random weights."""
    network = network_of(torch.float32, inputs="relative", message_passing_steps=1)
    rows = motion_of(network, ("throw",))
    assert rows and all(row.held for row in rows.values()), rows


def test_what_spreads_beside_the_solver():
    """A cube of sand that spreads as the solver's does holds; spread a fifth less, or a cell higher, it does not."""
    config = StabilityNetworkConfig("none", cases=("collapse",), frames=61, scene=SceneConfig(**SCENE))
    made = list(cases(config, NetworkConfig(materials=("sand",))))
    assert [case.frames for case in made] == [61] and made[0].spread_at == (30, 60)
    case, solver = made[0], MpmConfig(device="cpu")
    beside = solver_beside(made, solver, 60.0)[case.name]
    low_N = [float(scene.position_N3[:, 1].min()) for scene in case.scenes]
    assert low_N == pytest.approx([5 / 64, 20 / 64])
    truth = collapse(beside, initial_states(case), case.spread_at)
    assert misfallen(truth, truth) is None and len(truth) == 4
    assert truth[1]["spread"] > 1.5 * truth[0]["spread"] > 6  # it falls apart
    for change, beyond in (({"spread": 0.8}, "spreads by"), ({"height": 1.6}, "cells high")):
        other = [row | {name: factor * row[name] for name, factor in change.items()} for row in truth]
        assert beyond in misfallen(other, truth)
    assert "did not come to the end" in misfallen(None, truth)


def test_funnels_have_the_holes_that_are_asked_for():
    """Sheets leave a square hole of so many of the network's cells, at the height where what falls is counted. The cube
    is above it, in the middle, and keeps the clearance of scenes from all sheets. Without the solver, obstacles in the
    input, or enough frames there is no such case."""
    config = StabilityNetworkConfig("", cases=("hole",), scene=SceneConfig(domain_size=(1.5, 1.0, 2.0)))
    network = network_of(cell_size=0.03).config
    made = list(cases(config, network))
    loads = ("passes holes", "passes holes under load")
    assert [case.name for case in made] == [f"{load}, {name}" for name in MATERIAL_NAMES for load in loads]
    light, heavy = (case.scenes[0].particle_count for case in made[:2])
    assert heavy == pytest.approx(1.5**3 * light, rel=1e-2)
    assert all(case.beside_solver and case.frames == 150 for case in made)
    for cells, scene in zip(made[0].hole_cells, made[0].scenes, strict=True):
        middle_3 = 0.5 * np.array(scene.domain_size)
        for sheet in scene.obstacles:
            corner_43 = sheet.vertex_V3 - middle_3
            lowest_23 = corner_43[np.argsort(corner_43[:, 1])[:2]]
            assert middle_3[1] + lowest_23[:, 1] == pytest.approx(made[0].hole_height, abs=1e-6)
            # an edge of the hole: across its axis at half the hole's width, and beyond the hole along it
            aside_23 = np.sort(np.abs(lowest_23[:, [0, 2]]), axis=1)
            assert aside_23 == pytest.approx(np.tile([0.5 * cells * 0.03, 0.18], (2, 1)), abs=1e-6)
            plane_3 = np.cross(corner_43[1] - corner_43[0], corner_43[2] - corner_43[0])
            off_N = (scene.position_N3 - middle_3 - corner_43[0]) @ (plane_3 / np.linalg.norm(plane_3))
            assert np.abs(off_N).min() > 2 * scene.cell_size and abs(np.sign(off_N).sum()) == len(off_N)
        assert scene.position_N3.mean(axis=0)[[0, 2]] == pytest.approx(middle_3[[0, 2]], abs=5e-3)
    assert not list(cases(config, network_of(obstacle_features=False).config))
    assert not any(list(cases(replace(config, **change), network)) for change in ({"solver": False}, {"frames": 149}))


@pytest.mark.parametrize(
    ("through", "leaked", "beyond"),
    [
        (0.7, 0.0, None),
        (0.55, 0.15, None),
        (0.55, 0.4, "leaks 40 % beside a hole of 2 R, the solver 10 %"),
        (0.1, 0.0, "lets 10 % through a hole of 2 R, the solver 70 %"),
        (1.0, 0.0, "lets 100 % through a hole of 2 R, the solver 70 %"),
        (0.1, 0.6, "lets 10 % through a hole of 2 R, the solver 70 %"),
    ],
)
def test_holes_beside_the_solver(through, leaked, beyond):
    """What falls through the hole is counted, what falls below it elsewhere is not, nor what stays above or comes back.
    A hole may let through a fifth of all particles more or less than the solver, and a twentieth more may leak; beyond
    that the row does not hold and names it. Nor does it where a rollout ended early."""
    scene = replace(
        next(iter(cases(StabilityNetworkConfig("", cases=("single",)), network_of().config))).scenes[0],
        position_N3=np.full((20, 3), 0.5, np.float32),
        velocity_N3=np.zeros((20, 3), np.float32),
        material_N=np.zeros(20, np.uint8),
    )

    def falls(through, leaked):
        """Through the hole at 0.4 and then far aside; or past it and then to the middle; or in and out again."""
        path_TN3 = np.stack([scene.position_N3] * 4)
        ways = [[(0.52, 0.3), (0.9, 0.1), (0.9, 0.1)], [(0.6, 0.3), (0.5, 0.1), (0.5, 0.1)]]
        ways.append([(0.5, 0.3), (0.5, 0.6), (0.5, 0.6)])
        first, second = round(20 * through), round(20 * (through + leaked))
        for some, way in zip((slice(first), slice(first, second), slice(second, None)), ways, strict=True):
            path_TN3[1:, some, :2] = np.array(way)[:, None]
        return RolloutResult(path_TN3)

    case = Case("passes holes", (scene,) * 2, 4, hole_cells=(1.0, 2.0), hole_height=0.4)
    simulator, initial = Simulator(network_of(), 60.0), initial_states(case)
    own, solvers = [falls(0.0, 0.0), falls(through, leaked)], [falls(0.1, 0.0), falls(0.7, 0.1)]
    (_, hole), (_, solver) = (passing(some, initial, case, 0.035) for some in (own, solvers))
    assert hole == {"hole_cells": 2.0, "through": pytest.approx(through), "leaked": pytest.approx(leaked)}
    assert mispassed([hole], [solver]) == beyond
    row = case_row(simulator, case, initial, own, None, solvers)
    assert row.more["passed"][1] == hole and row.more["solver_passed"][1] == solver
    assert row.more["pull"] == row.more["solver_pull"] == [None, None]  # four frames are fewer than a history
    early = [own[0], RolloutResult(own[1].position_TN3[:3], "diverged at frame 3")]
    row = case_row(simulator, case, initial, early, None, solvers)
    assert not row.held and row.beyond == "diverged at frame 3" and row.more["passed"] is None
    assert "the solver did not come to the end" in mispassed([hole], passing(early, initial, case, 0.035))


def test_pull_in_a_hole():
    """Of what is in the hole in the solver's film, and nothing else: without contacts the network's falls with gravity,
    whatever the weights; what followed hung there, or fell."""
    network = network_of(torch.float32, inputs="relative", obstacle_features=False)
    scene = next(iter(cases(StabilityNetworkConfig("", cases=("single",)), network.config))).scenes[0]
    place_N3 = np.array([[0.5, 0.4, 0.49], [0.51, 0.405, 0.5], [0.5, 0.6, 0.5], [0.8, 0.4, 0.5]], np.float32)
    scene = replace(scene, position_N3=place_N3, velocity_N3=np.zeros_like(place_N3), material_N=np.zeros(4, np.uint8))
    case = Case("passes holes", (scene,) * 2, 20, hole_cells=(2.0, 2.0), hole_height=0.4)
    fall_T = 0.5 * scene.gravity[1] / 60**2 * np.arange(20.0) ** 2
    films = [np.stack([place_N3] * 20), np.stack([place_N3] * 20)]
    films[1][:, :2, 1] += (0.5 * (fall_T - fall_T[10]))[
        :, None
    ]  # half as fast as a free fall, and in the hole for a while
    own, true = pulled(Simulator(network, 60.0), initial_states(case), [RolloutResult(film) for film in films], case)
    assert own == [pytest.approx(1, abs=1e-3)] * 2
    assert true == [pytest.approx(0, abs=1e-3), pytest.approx(0.5, abs=1e-3)]


def test_turned_gravity(monkeypatch):
    """What hangs in the air is as far from a fall whichever way gravity points; with a wind along y it is nearer where
    that is down."""
    path = 0.5 * np.array(GRAVITY) * (np.arange(20)[:, None, None] / 60) ** 2

    def falls(scenes, *_):
        return [RolloutResult((scene.position_N3 + path).astype(np.float32)) for scene in scenes]

    monkeypatch.setattr(network_motion, "solver_trials", falls)
    monkeypatch.setattr(network_motion, "TO_REST_FRAMES", 20)
    for wind, held in ((0.0, True), (-1e-3, False)):
        simulator = Simulator(Repeats(0.0, 0.0, wind), 60.0, "torch")
        rows = list(turned_rows(simulator, SceneConfig(group_size=0.03), "snow", MpmConfig()))
        assert [row.held for row in rows] == [held] * 2
        assert not held or rows[0].measured == pytest.approx(1.0, rel=1e-3)


def test_collisions_against_the_solver():
    """The solver's two cubes keep momentum, angular momentum up to the spin within cells, and share their velocities;
    what flies through as if nothing were there keeps both too, and does not hold; nor does what loses its velocity."""
    scene = SceneConfig(group_size=0.04)
    made = meeting(scene, "snow")
    beside = [meeting(scene, name) for name in ("water", "sand")]  # the kernel of all three is compiled already
    trial, *_ = solver_trials([made, *beside], MpmConfig(device="cpu"), 14, 60.0)
    momentum, angular, met = conserved(trial, made, 0.07, 60.0)
    assert momentum < 1e-3 and angular < 0.15 and 0.2 < met < 0.8
    still = (made.position_N3 + np.arange(14)[:, None, None] / 60 * made.velocity_N3).astype(np.float32)
    through = conserved(RolloutResult(still), made, 0.07, 60.0)
    np.testing.assert_allclose(through, 0, atol=1e-3)
    (passes,), (brakes,) = (motion_of(Repeats(1.0, drag), ("collision",)).values() for drag in (0.0, 0.01))
    assert not passes.held and passes.measured < 1e-3 and abs(passes.more["met"]) < 1e-3
    assert not brakes.held and brakes.measured > 0.1


def row_of(simulator, case):
    states = initial_states(case)
    return case_row(simulator, case, states, *case_trials(simulator, case, states))


def test_failures_are_told(weights, monkeypatch):
    """A rollout that diverges says at which frame; energy from nowhere and particles that leave are failures too."""
    config = from_mapping(StabilityNetworkConfig, SMALL | {"weights": weights, "cases": ["single"]})
    simulator = Simulator(network_of(torch.float32), 60.0)
    case = next(iter(cases(config, simulator.network.config)))
    push = torch.tensor(GRAVITY) / 60**2
    simulator.backend.predict = lambda state: push.expand(len(state.position_N3), 3)
    case = Case(case.name, case.scenes, 16, GRAVITY, 12)
    row = row_of(simulator, case)
    assert row.held and row.more["share_of_way"] == pytest.approx(1, rel=1e-3)
    push[0] = 1e-2
    row = row_of(simulator, Case(case.name, case.scenes, 40))
    assert not row.held and row.measured < 40 and "diverged at frame" in row.beyond
    assert row.more["guard"] == "raised" and row.more["failed_scenes"] == 1
    row = row_of(simulator, case)
    assert not row.held and row.measured == 16 and row.beyond.startswith("energy grows")
    monkeypatch.setattr(network, "ENERGY_BOUND", 1e9)
    row = row_of(simulator, case)
    assert not row.held and row.beyond == "1e+02 % of the particles end outside of the domain"


@pytest.mark.parametrize("forces", [{"inputs": "absolute"}, {"inputs": "relative"}, RESTING])
def test_the_guard_is_asked(forces):
    """A weight that explodes is noticed at the first frame, also where free flight, floors that push along their
    normals alone, or rest by construction leave networks no answer."""
    exploding = network_of(torch.float32, width=8, levels=2, **forces)
    row = guard_row(Simulator(exploding, 60.0, "torch"), SceneConfig())
    assert row.held, row


def test_a_slope_against_a_closed_form():
    """A block that slides without friction is where its case expects it; friction is told as a share of the way. What
    slides meets neither the slope's end nor a wall."""
    made = list(cases(StabilityNetworkConfig("", cases=("slope",)), network_of().config))
    assert len({case.name for case in made}) == 9 and made[2].name == "slides down 45 degrees, water"
    case, (scene,) = made[2], made[2].scenes
    assert case.known_frames == 19 and case.frames == 21 and case.known_3 is not None
    pull = np.array(case.known_3)
    np.testing.assert_allclose(pull, 0.5 * 9.8 * np.array([0, -1, 1]), atol=1e-12)
    (slope,) = scene.obstacles
    above_N = (scene.position_N3 - slope.vertex_V3[0]) @ (np.array([0, 1, 1]) / 2**0.5)
    assert 0.5 * scene.cell_size < above_N.min() < scene.cell_size
    seconds = np.arange(case.frames)[:, None, None] / 60
    for share in (1.0, 0.7):
        slid = (scene.position_N3 + 0.5 * share * pull * seconds**2).astype(np.float32)
        found = share_of_way(RolloutResult(slid), InitialState.of_scene(scene), 60.0, case)
        assert found == pytest.approx(share, rel=1e-3)
    low, high = slope.vertex_V3.min(0), slope.vertex_V3.max(0)
    assert ((slid.mean(1) >= low - 0.08) & (slid.mean(1) <= high + 0.08)).all()


def test_energy_growth_against_a_closed_form():
    """Free fall from rest makes no energy; a throw upwards that was not there makes that of its speed."""
    scene = next(iter(cases(StabilityNetworkConfig("", cases=("single",)), network_of().config))).scenes[0]
    initial = InitialState.of_scene(scene)
    time = np.arange(12)[:, None, None] / 60
    fall = scene.position_N3 + 0.5 * np.array(scene.gravity) * time**2
    assert energy_growth(RolloutResult(fall.astype(np.float32)), initial, 60.0) < 1e-4
    thrown = fall + np.array([0, 1.4, 0]) * time
    assert energy_growth(RolloutResult(thrown.astype(np.float32)), initial, 60.0) == pytest.approx(
        0.5 * 1.4**2 / 9.8, rel=5e-3
    )
    assert energy_growth(RolloutResult(thrown[:1]), initial, 60.0) == 0


@pytest.mark.parametrize(
    ("stretch", "shift", "stir", "beyond"),
    [
        (1.0, 0.0, 0.0, None),
        (1.05, 0.05, 0.02, None),
        (1.0, 3.2, 0.0, "cells at rest, the solver"),
        (1.3, 0.0, 0.0, "times the neighbours that it had"),
        (0.4, 0.0, 0.0, "times the neighbours that it had"),
        (1.0, 0.12, 0.0, "cells high, the solver's"),
        (1.0, 0.0, 0.05, "stirs at 0.0025 squared a second, the solver at 0.0004"),
    ],
)  # fmt: skip
def test_rest_beside_the_solver(stretch, shift, stir, beyond):
    """A lattice counts its neighbours by a closed form. It may drift twice as far as the solver's and a cell, keep half
    to twice its neighbours, lie a tenth of a cell higher, and stir with twice the squared speed and a small floor, not
    counting what it has in common; beyond that the case does not hold, and says why."""
    side, cell = 6, 1 / 64
    lattice_N3 = 0.6 * cell * np.stack(np.meshgrid(*3 * [np.arange(side)]), -1).reshape(-1, 3)
    lattice_N3 += 0.4 - lattice_N3.mean(axis=0)
    assert neighbours(lattice_N3, 0.7 * cell) == pytest.approx(6 * (side - 1) / side)
    assert neighbours(lattice_N3, 0.3 * cell) == neighbours(lattice_N3[:0], cell) == 0
    empty = ObstacleGrid(cell, np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
    scene = InitialState(
        lattice_N3, 0 * lattice_N3, np.full(len(lattice_N3), 2), empty, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
    )

    # at last every other particle goes to and fro against the others, and all slide slowly in common
    every_other_N = np.where(np.arange(len(lattice_N3)) % 2, 1.0, -1.0)
    back_T = np.arange(STIR_FRAMES + 1)[:, None] % 2

    def path(stretch, shift_cells, stir, sideways_cells=0.0):
        moved_3 = np.array([sideways_cells, shift_cells, 0.0]) * cell
        last_TN3 = np.stack([0.4 + stretch * (lattice_N3 - 0.4) + moved_3] * len(back_T))
        last_TN3[..., 0] += stir / 60 * back_T * every_other_N
        last_TN3[..., 0] += 1e-4 * cell * np.arange(len(back_T))[:, None]
        return RolloutResult(np.concatenate([[lattice_N3] * 3, last_TN3]).astype(np.float32))

    own = path(stretch, 0.0, stir, shift) if shift > 1 else path(stretch, shift, stir)
    case, simulator = Case("64 frames", (), len(back_T) + 3, settled=2), Simulator(network_of(), 60.0)
    row = case_row(simulator, case, [scene], [own], None, [path(1.0, 0.0, 0.02, 1.0)])
    assert row.held is (beyond is None) and (beyond is None or beyond in row.beyond), row
    assert row.more["solver_rest"]["drift"] == pytest.approx(1.0, rel=2e-2)
    assert row.more["rest"]["squared_speed"] == pytest.approx(stir**2, abs=1e-8)
    assert row.more["solver_rest"]["squared_speed"] == pytest.approx(0.02**2, rel=1e-3)
    early = RolloutResult(own.position_TN3[:3], "diverged")
    assert not case_row(simulator, case, [scene], [own], None, [early]).held


def test_the_solver_is_asked_once(tmp_path, monkeypatch):
    """Its trajectories are kept for other weights, with the cause where it stopped; others are simulated anew where the
    scene, the frames or the physics differ."""
    asked: list[tuple[int, int]] = []

    def trials(scenes, config, frames, rate):
        asked.append((len(scenes), frames))
        paths = [np.stack([scene.position_N3] * frames) for scene in scenes]
        return [RolloutResult(path[:2] if i else path, "too fast" if i else None) for i, path in enumerate(paths)]

    monkeypatch.setattr("tools.solver_rollouts.solver_trials", trials)
    config = StabilityNetworkConfig("", cases=("rest",), long_frames=5, scene=SceneConfig(group_size=0.03))
    made, kept = list(cases(config, network_of().config)), str(tmp_path / "kept")
    first = solver_beside(made, MpmConfig(), 60.0, kept)
    again = solver_beside(made, MpmConfig(device="cpu"), 60.0, kept)
    assert asked == [(3, 5)] and first.keys() == again.keys() == {case.name for case in made}
    assert [trial.cause for name in again for trial in again[name]] == [None, "too fast", "too fast"]
    for name, stored in again.items():
        assert np.array_equal(stored[0].position_TN3, first[name][0].position_TN3)
    solver_beside(made, MpmConfig(poisson_ratio=0.3), 60.0, kept)
    solver_beside([replace(made[0], frames=6)], MpmConfig(), 60.0, kept)
    assert asked[1:] == [(3, 5), (1, 6)]


def test_rest_is_judged_on_a_scene_of_each_seed():
    """The report's own scene is one of them, and stays what it is beside others."""
    scene = SceneConfig(group_size=0.03)
    (own, *_), (both, *_) = (
        cases(StabilityNetworkConfig("", cases=("rest",), rest_seeds=seeds, scene=scene), network_of().config)
        for seeds in ((REPORT_SEED,), (REPORT_SEED, 7))
    )
    first, second = both.scenes
    assert np.array_equal(first.position_N3, own.scenes[0].position_N3)
    assert not np.array_equal(first.position_N3, second.position_N3)
    with pytest.raises(ConfigError, match="rest_seeds must be at least one"):
        StabilityNetworkConfig("", rest_seeds=())


def test_rest_goes_on_from_the_solvers_own_film():
    """The film stays as it is until then; from its last velocity on the network flies, whatever came before it."""
    network = network_of(torch.float32, inputs="relative", velocity_history=3)
    simulator = Simulator(network, 60.0, "torch", "fp32")
    scene = SceneConfig(group_size=0.03, group_count=1, gravity=(0.0, 0.0, 0.0))
    config = StabilityNetworkConfig("", cases=("rest",), frames=8, long_frames=12, rest_from=5, scene=scene)
    (case, *_) = cases(config, network.config)
    assert case.name == "12 frames, water, from frame 5 of the solver's" and case.begun == 5
    initial = initial_states(case)
    middle_N3 = 0.5 + 0.1 * (initial[0].position_N3 - initial[0].position_N3.mean(axis=0))
    velocity_3, sign_T = np.array([3e-3, -2e-3, 1e-3]), np.array([-1, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11])
    film_TN3 = (middle_N3 + sign_T[:, None, None] * velocity_3).astype(np.float32)
    film_TN3[0] += 0.2  # which no velocity from frame 5 on has seen
    (trial,), _ = case_trials(simulator, case, initial, [RolloutResult(film_TN3)])
    assert trial.frame_count == 12 and trial.cause is None
    assert np.array_equal(trial.position_TN3[:6], film_TN3[:6])
    np.testing.assert_allclose(trial.position_TN3[6:], film_TN3[6:], rtol=0, atol=1e-6)
    for refused in (2, 8):
        with pytest.raises(ConfigError, match=r"rest_from must be 0, or from 3 to 7, where all rests, got"):
            list(cases(replace(config, rest_from=refused), network.config))


def test_scenes_follow_the_network():
    """A network that sees no obstacles gets none, and one that knows two materials gets those."""
    blind = network_of(obstacle_features=False, materials=("water", "snow")).config
    config = StabilityNetworkConfig("", cases=("domain", "rest"), scene=SceneConfig(**{"group_size": 0.05}))
    made = list(cases(config, blind))
    rests = ["3000 frames, water", "3000 frames, snow"]
    assert [case.name for case in made] == [*rests, "domain x4", "domain x9", "domain x16"]
    assert all(not scene.obstacles for case in made for scene in case.scenes)
    assert not any((scene.material_N == 1).any() for case in made for scene in case.scenes)


def test_the_solver_has_the_law_that_is_named():
    """Weights are held beside sand as in their data, which need not be what new data have."""
    options = {"weights": "w", "solver_device": "cpu", "mpm": {"sand_friction_law": "compression"}}
    asked = solver_of(from_mapping(StabilityNetworkConfig, options))
    assert asked == MpmConfig(device="cpu", sand_friction_law="compression") != MpmConfig(device="cpu")
    assert solver_of(from_mapping(StabilityNetworkConfig, options | {"solver": False})) is None


def test_the_command_names_its_parts(capfd):
    """Help says what parts there are; an unknown one is refused with them; a known one takes the options of its own."""
    assert run_module("tools.stability", ["--help"]) == 0
    told = capfd.readouterr()
    assert "python -m tools.stability network" in told.out and not told.err
    assert run_module("tools.stability", ["bridge"]) == 2
    refused = capfd.readouterr().err
    assert "must be one of" in refused and "network" in refused
    assert run_module("tools.stability", ["network", "weights=none.pt"]) == 2
    assert "weights must be an existing file" in capfd.readouterr().err
