"""python -m tools.stability network: its cases, what counts as held, and the runtime's guard."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from network.states import network_of
from PIL import Image

from hgn.config import SceneConfig
from hgn.network.features import ParticleState
from hgn.runtime.rollouts import RolloutResult
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.weights import WeightsInfo, save_weights
from hgn.scene.material import MATERIALS
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.schema import ConfigError, from_mapping
from tools.measures import neighbours
from tools.stability.network import case_row, case_trials, energy_growth, initial_states, main, share_of_way
from tools.stability.network_cases import Case, StabilityNetworkConfig, cases
from tools.stability.network_free_fall import free_fall_rows
from tools.stability.row import Row

SCENE = {
    "obstacle_count": 1,
    "group_shapes": ["cube"],
    "obstacle_size": [0.1, 0.2],
    "group_count": 2,
    "group_size": 0.04,
}
GRAVITY = (0.0, -9.8, 0.0)
SMALL = {"frames": 3, "long_frames": 5, "domain_factors": [4], "scene": SCENE, "device": "cpu"}


@pytest.fixture
def weights(tmp_path: Path) -> str:
    network = network_of(torch.float32, width=8, material_embedding=2, message_passing_steps=1, levels=2)
    with torch.no_grad():  # nothing accelerates: whatever happens is the scene's
        network.decode.second.weight.zero_()
        network.decode.second.bias.zero_()
        network.normaliser.acceleration_mean.zero_()
    path = tmp_path / "still.safetensors"
    save_weights(path, network, WeightsInfo(network.config, 60.0, 1 / 64, updates=3))
    return str(path)


def test_every_case_has_a_row(weights: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each case is simulated and told with the report's keys; what rests holds everywhere."""
    path, picture = tmp_path / "reports" / "stability.json", tmp_path / "reports" / "stability.png"
    assert main(SMALL | {"weights": weights, "json": str(path), "picture": str(picture), "speed_factor": 8.0}) == 0
    with Image.open(picture) as drawn:
        assert drawn.height > 14 * 300
    report = json.loads(path.read_text())
    assert {"device", "versions", "commit", "date", "command", "config"} <= report["meta"].keys()
    rows = {row["case"]: row for row in report["rows"]}
    singles = [f"single particle, {name}" for name in ("water", "sand", "snow")]
    slopes = [f"slides down 45 degrees, {name}" for name in ("water", "sand", "snow")]
    alone = [f"{name} alone" for name in ("water", "sand", "snow")]
    thrown = f"thrown at up to {8 * (2 * 9.8) ** 0.5:.1f} a second"
    held = ["5 frames", "particles x10", "domain x4", *alone, "at the end of 64000 cells"]
    falls = [
        f"{case}, {name}" for name in ("water", "sand", "snow") for case in ("free fall", "a body's velocity error")
    ]
    assert list(rows) == [*falls, *held[:3], thrown, *singles, *slopes, *held[3:], "a weight that explodes"]
    # what never accelerates misses all of gravity, and answers to nothing
    assert all(rows[name]["measured"] == pytest.approx(1.0, rel=1e-3) and not rows[name]["held"] for name in falls[::2])
    assert all(abs(rows[name]["measured"]) < 1e-6 for name in falls[1::2])
    for name in singles + slopes:  # nor does a particle fall, or a block slide
        assert not rows[name]["held"] and rows[name]["share_of_way"] <= 0 and "of its way" in rows[name]["beyond"]
    keys = {"part", "case", "predicted", "measured", "held", "beyond"}
    assert all(keys <= row.keys() and row["part"] == "network" for row in rows.values())
    for name in held:
        assert rows[name]["held"] and rows[name]["guard"] == "not needed", rows[name]
    assert rows["particles x10"]["particles"] == pytest.approx(10 * rows["5 frames"]["particles"], rel=0.05)
    assert rows["domain x4"]["particles"] == 4 * rows["5 frames"]["particles"]
    assert rows["domain x4"]["domain_size"] == [2.0, 1.0, 2.0]
    broken = rows["a weight that explodes"]
    assert broken["held"] and broken["guard"] == "raised" and "diverged at frame 1" in broken["beyond"]
    assert "a weight that explodes" in capsys.readouterr().out


class Repeats(torch.nn.Module):
    """Accelerates as in the frame before, plus what `share` says of the last velocity along x."""

    def __init__(self, network: torch.nn.Module, share: float) -> None:
        super().__init__()
        self.config, self.share, self.weight = network.config, share, torch.nn.Parameter(torch.zeros(1))

    def forward(self, state: ParticleState) -> torch.Tensor:
        acceleration_N3 = state.velocity_NM3[:, 0] - state.velocity_NM3[:, 1]
        return acceleration_N3 * torch.tensor([self.share, 1.0, 1.0])


@pytest.mark.parametrize(("share", "held"), [(1.0, False), (-1.0, True)])
def test_free_fall(share: float, held: bool) -> None:
    """What goes on as it was falls rightly; it repeats a body's velocity error, or takes it back, and is told so."""
    network = network_of(torch.float32, width=8, material_embedding=2, message_passing_steps=1, levels=2)
    simulator = Simulator(Repeats(network, share), 60.0, "torch")  # type: ignore[arg-type]
    fall, error = free_fall_rows(simulator, SceneConfig(), "sand")
    assert fall.held and fall.measured == pytest.approx(0.0, abs=1e-3)
    assert error.held is held and error.measured == pytest.approx(share, rel=1e-3)
    assert error.more["of_a_constant_velocity"] == pytest.approx(0.0, abs=1e-3)
    assert error.more["of_a_particle"] == pytest.approx(share, rel=1e-3)


def row_of(simulator: Simulator, case: Case, energy_bound: float) -> Row:
    states = initial_states(case)
    return case_row(simulator, case, states, energy_bound, *case_trials(simulator, case, states))


def test_failures_are_told(weights: str) -> None:
    """A rollout that diverges says at which frame; energy from nowhere and particles that leave are failures too."""
    config = from_mapping(StabilityNetworkConfig, SMALL | {"weights": weights, "cases": ["single"]})
    network = network_of(torch.float32)
    case = next(iter(cases(config, network.config)))
    simulator = Simulator(network, 60.0)
    push = torch.tensor(GRAVITY) / 60**2
    simulator.backend.predict = lambda state: push.expand(len(state.position_N3), 3)
    case = Case(case.name, case.scenes, 16, GRAVITY, 12)
    row = row_of(simulator, case, 0.02)
    assert row.held and row.more["share_of_way"] == pytest.approx(1, rel=1e-3)
    push[0] = 1e-2
    row = row_of(simulator, Case(case.name, case.scenes, 40), 0.02)
    assert not row.held and row.measured < 40 and "diverged at frame" in row.beyond
    assert row.more["guard"] == "raised" and row.more["failed_scenes"] == 1
    row = row_of(simulator, case, 0.02)
    assert not row.held and row.measured == 16 and row.beyond.startswith("energy grows")
    row = row_of(simulator, case, 1e9)
    assert not row.held and row.beyond == "1e+02 % of the particles end outside of the domain"


def test_a_slope_against_a_closed_form() -> None:
    """A block that slides without friction is where its case expects it; friction is told as a share of the way. What
    slides meets neither the slope's end nor a wall."""
    made = list(cases(StabilityNetworkConfig("", cases=("slope",)), network_of().config))
    assert [case.name for case in made] == [f"slides down 45 degrees, {name}" for name in ("water", "sand", "snow")]
    case, (scene,) = made[0], made[0].scenes
    assert case.known_frames == 19 and case.frames == 21 and case.known_3 is not None
    pull = np.array(case.known_3)
    np.testing.assert_allclose(pull, 0.5 * 9.8 * np.array([0, -1, 1]), atol=1e-12)
    (slope,) = scene.obstacles
    above_N = (scene.position_N3 - slope.vertex_V3[0]) @ (np.array([0, 1, 1]) / 2**0.5)
    assert 0.5 * scene.cell_size < above_N.min() < scene.cell_size
    seconds = np.arange(case.frames)[:, None, None] / 60
    for share in (1.0, 0.7):
        slid = (scene.position_N3 + 0.5 * share * pull * seconds**2).astype(np.float32)
        found = share_of_way(RolloutResult(slid), InitialState.of_scene(scene), 60.0, case.known_3, case.known_frames)
        assert found == pytest.approx(share, rel=1e-3)
    low, high = slope.vertex_V3.min(0), slope.vertex_V3.max(0)
    assert ((slid.mean(1) >= low - 0.08) & (slid.mean(1) <= high + 0.08)).all()


def test_energy_growth_against_a_closed_form() -> None:
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


@pytest.mark.parametrize(("stretch", "held"), [(1.0, True), (1.05, True), (1.6, False), (0.3, False)])
def test_resting_snow_keeps_its_density(stretch: float, held: bool) -> None:
    """A lattice of snow counts its neighbours by a closed form; stretched or squeezed after it has settled the case
    does not hold, and says so. Other materials may spread, and what ends before it has settled says nothing."""
    side, cell = 6, 1 / 64
    lattice_N3 = 0.6 * cell * np.stack(np.meshgrid(*3 * [np.arange(side)]), -1).reshape(-1, 3) + 0.4
    assert neighbours(lattice_N3, 0.7 * cell) == pytest.approx(6 * (side - 1) / side)
    assert neighbours(lattice_N3, 0.3 * cell) == neighbours(lattice_N3[:0], cell) == 0
    snow, sand = MATERIALS.index("snow"), MATERIALS.index("sand")
    empty = ObstacleGrid(cell, np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))

    def row(material: int, settled: int, broken: float = 0.0) -> Row:
        scene = InitialState(
            lattice_N3, 0 * lattice_N3, np.full(len(lattice_N3), material), empty, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
        )
        path = np.stack([lattice_N3] * 3 + [0.4 + stretch * (lattice_N3 - 0.4)]).astype(np.float32)
        path[-1, 5] += broken
        case = Case("4 frames", (), 4, settled=settled)
        return case_row(Simulator(network_of(), 60.0), case, [scene], 1.0, [RolloutResult(path)], None)

    found = row(snow, 2)
    assert found.held is held and (held or "times the neighbours that it had after 2 frames" in found.beyond)
    assert stretch != 1.0 or found.more["snow_density"] == 1.0
    for other in (row(sand, 2), row(snow, 4)):
        assert other.held and other.more["snow_density"] is None
    lost = row(snow, 2, np.nan)
    assert not lost.held and lost.beyond.startswith("positions are not finite") and lost.more["guard"] == "missed"


def test_scenes_follow_the_network() -> None:
    """A network that sees no obstacles gets none, and one that knows two materials gets those."""
    blind = network_of(obstacle_features=False, materials=("water", "snow")).config
    config = StabilityNetworkConfig("", cases=("domain", "material"), scene=SceneConfig(**{"group_size": 0.05}))
    made = list(cases(config, blind))
    assert [case.name for case in made] == ["domain x4", "domain x9", "domain x16", "water alone", "snow alone"]
    assert all(not scene.obstacles for case in made for scene in case.scenes)
    assert not any((scene.material_N == 1).any() for case in made for scene in case.scenes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cases": ["wide"]}, r"cases\[0\] must be one of free_fall"),
        ({"domain_factors": [5]}, r"domain_factors\[0\] must be a square"),
        ({"frames": 1}, "frames must be at least 2"),
        ({"energy_bound": 0.0}, "energy_bound must be a finite number > 0"),
        ({"precision": "fp8"}, "precision must be one of fp32, tf32, fp16"),
        ({"backend": "quick"}, "backend must be one of auto, torch, triton, cpu"),
    ],
)
def test_bad_options(change: dict[str, Any], message: str) -> None:
    """Each wrong option is named before anything is simulated."""
    with pytest.raises(ConfigError, match=message):
        from_mapping(StabilityNetworkConfig, {"weights": "w"} | change)


def test_the_command_names_its_parts(warm_python: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Help says what parts there are; an unknown one is refused with them; a known one takes the options of its own."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    command = [str(warm_python), "-m", "tools.stability"]
    told = subprocess.run([*command, "--help"], capture_output=True, text=True, timeout=120)
    assert told.returncode == 0 and "python -m tools.stability network" in told.stdout and not told.stderr
    refused = subprocess.run([*command, "bridge"], capture_output=True, text=True, timeout=120)
    assert refused.returncode == 2 and "must be one of" in refused.stderr and "network" in refused.stderr
    missing = subprocess.run([*command, "network", "weights=none.pt"], capture_output=True, text=True, timeout=120)
    assert missing.returncode == 2 and "weights must be an existing file" in missing.stderr
