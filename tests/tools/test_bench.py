"""python -m tools.bench: its rows, its checks, its states; no assertion on any time."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from docs.pages import run_module

import datagen.mpm.solver
from datagen.mpm.solver import SceneFailure, Simulated, particle_bounds
from hgn.config import MpmConfig, NetworkConfig
from hgn.network.gns import GraphNetworkSimulator
from hgn.network.grid import build_hierarchy
from hgn.network.neighbours import neighbour_list
from hgn.runtime.simulator import Simulator
from tools import timing
from tools.bench import contenders, triton_contenders
from tools.bench.command import main, workloads
from tools.bench.config import BenchConfig
from tools.bench.states import TILE_PARTICLES, Workload, positions, scene_of
from tools.bench.triton_contenders import TritonFrame, TritonTrain
from tools.timing import Timed, alternate, statistics

CPU = torch.device("cpu")
TINY = {"width": 16, "levels": 2, "message_passing_steps": 1}
SMALL = {"particles": [60], "seconds": 1e-9, "network": TINY, "device": "cpu"}


def fake_simulate(fails):
    def simulate(scenes, config, frames, frame_rate_hz, on_frame):
        for frame in range(frames):
            on_frame(frame)
        if fails:
            return [SceneFailure("left the domain") for _ in scenes]
        return [Simulated(np.stack([scene.position_N3] * frames), {"substeps": 38}) for scene in scenes]

    return simulate


def test_rows_of_every_case(tmp_path, monkeypatch, capsys):
    """Each case gets a row with the report's keys, checked and timed; the table names them all."""
    monkeypatch.setattr(datagen.mpm.solver, "simulate", fake_simulate(False))
    monkeypatch.setattr(timing, "MINIMUM_ROUNDS", 1)
    path = tmp_path / "reports" / "bench.json"
    assert main(SMALL | {"scenes": [2], "json": str(path)}) == 0
    report = json.loads(path.read_text())
    assert {"device", "versions", "commit", "date", "command", "config"} <= report["meta"].keys()
    rows = report["rows"]
    keys = {"case", "particles", "scenes", "precision", "ms", "memory_gb", "check"}
    assert all(keys <= row.keys() and row["check"] == "pass" and row["ms"] > 0 for row in rows)
    cases = ["frame", "gns_frame", "gns_train", "mpm_frame", "torch_frame", "train"]
    assert sorted(row["case"] for row in rows) == cases and {row["scenes"] for row in rows} == {2}
    printed = capsys.readouterr().out
    assert all(row["case"] in printed for row in rows)


def test_no_time_where_a_check_is_red(tmp_path, monkeypatch, capsys):
    """A path that differs from float64, a wrong gradient and a solver that fails get a reason instead of a time."""
    monkeypatch.setattr(datagen.mpm.solver, "simulate", fake_simulate(True))
    step, project = Simulator.step, GraphNetworkSimulator.propagate

    def wrong_step(self, state):
        after = step(self, state)
        return replace(after, velocity_NM3=1.001 * after.velocity_NM3)

    def wrong_gradient(self, state, neighbours):
        output = project(self, state, neighbours)
        return output if output.dtype == torch.float64 else output + 0.1 * (output - output.detach())

    monkeypatch.setattr(Simulator, "step", wrong_step)
    monkeypatch.setattr(GraphNetworkSimulator, "propagate", wrong_gradient)
    path = tmp_path / "bench.json"
    cases = ["frame", "gns_train", "mpm_frame"]
    assert main(SMALL | {"scenes": [1], "cases": cases, "json": str(path)}) == 1
    rows = {row["case"]: row for row in json.loads(path.read_text())["rows"]}
    assert all(row["ms"] is None for row in rows.values())
    assert "relative error of acceleration" in rows["frame"]["check"]
    assert "relative error of gradient" in rows["gns_train"]["check"]
    assert rows["mpm_frame"]["check"] == "left the domain"
    assert " … " not in capsys.readouterr().out  # no quartiles


def test_checks_see_small_faults(monkeypatch):
    """Backend torch passes in float32; a 0.01 % error of the output does not."""
    frame = contenders.Frame(NetworkConfig(width=16, levels=2), Workload(50, 1), CPU, "fp32")
    assert frame.check("fp32") == "pass"
    predict = frame.simulator.backend.predict
    frame.simulator.backend.predict = lambda state: 1.0001 * predict(state)
    assert frame.check("fp32").startswith("relative error of acceleration 1.0e-04 exceeds 1e-05")


def test_triton_is_checked_like_torch(monkeypatch):
    """Frames, loss and gradients of backend triton pass in float32 (in the interpreter); small errors do not."""
    found = {}
    for name in ("check_acceleration", "check_update"):
        check = getattr(contenders, name)
        monkeypatch.setattr(triton_contenders, name, lambda *given, check=check: found.update({check: given}) or "")
    config = NetworkConfig(width=16, levels=1, message_passing_steps=1)
    TritonFrame(config, Workload(2, 1), CPU, "fp32").check("fp32")
    TritonTrain(config, Workload(2, 2), CPU, "fp32").check("fp32")
    assert all(check(*given) == "pass" for check, given in found.items())
    (velocity_N3, *others), (loss, gradient, *more) = found.values()
    faster_N3 = velocity_N3 + 0.001 * (velocity_N3 - others[1].velocity_NM3[:, 0])
    assert contenders.check_acceleration(faster_N3, *others).startswith("relative error of acceleration 1.0e-03")
    assert contenders.check_update(1.001 * loss, gradient, *more).startswith("relative error of loss 1.0e-03 exceeds")
    assert contenders.check_update(loss, 1.01 * gradient, *more).startswith("relative error of gradient 1.0e-02")


def test_a_tile_is_like_real_frames():
    """A tile has the neighbours and cells that were measured on the paper's obstacle-free scene, within a tenth."""
    position = torch.from_numpy(positions(Workload(TILE_PARTICLES, 1), 0, 0.035))
    scene = torch.zeros(TILE_PARTICLES, dtype=torch.long)
    neighbours = len(neighbour_list(position, scene, 0.035).sender_E) / TILE_PARTICLES
    grid = build_hierarchy(position, scene, torch.zeros(1, 3), 0.035, 1)
    assert neighbours == pytest.approx(97, rel=0.1)
    assert grid.levels[0].cell_count == pytest.approx(1307, rel=0.1)


@pytest.mark.parametrize("particles", [1, 5_000, 40_000])
def test_states_fill_their_domain(particles):
    """Any number of particles lies inside of its domain, clear of the solver's walls and of the grid's cell borders."""
    work = Workload(particles, 1)
    scene = scene_of(work, 3, 0.035)
    assert scene.particle_count == particles and scene.domain_size[0] * 64 % 1 == 0
    low_3, high_3 = particle_bounds(scene, MpmConfig())
    assert (scene.position_N3 > low_3).all() and (scene.position_N3 < high_3).all()
    fraction = (scene.position_N3 / 0.035 - 0.5) % 1
    assert fraction.min() > 5e-4 and fraction.max() < 1 - 5e-4
    assert not np.array_equal(scene.position_N3, scene_of(work, 4, 0.035).position_N3)


def test_contenders_take_turns():
    """After the warm-up samples alternate, a long contender joins now and then, and the median is of the rest."""
    order: list[str] = []

    class Named(Timed):
        def __init__(self, name, rounds=None):
            self.name, self.rounds, self.warm_up = name, rounds, 3 if rounds is None else 1

        def sample(self):
            order.append(self.name)
            return float(len(order))

    times = alternate([Named("a"), Named("b"), Named("c", rounds=2)], 6, lambda: False)
    assert "".join(order) == "aaabbbc" + "abc" + "ab" * 2 + "abc" + "ab" * 2
    assert [len(milliseconds) for milliseconds in times] == [6, 6, 2]
    assert statistics([4.0, 1.0, 2.0, 3.0, 5.0]) == {
        "ms": 3.0, "ms_quartiles": [2.0, 4.0], "ms_range": [1.0, 5.0], "samples": 5,
    }  # fmt: skip
    assert len(alternate([Named("d")], 100, lambda: True)[0]) == 5


def test_workloads():
    """Every number of particles as one scene, then several scenes of the smallest."""
    config = BenchConfig(particles=(400, 40), scenes=(1, 8))
    assert workloads(config, CPU) == [Workload(400, 1), Workload(40, 1), Workload(40, 8)]
    assert workloads(BenchConfig(), CPU) == [Workload(TILE_PARTICLES, 1)]


def test_json_option(tmp_path):
    """The rows of a measurement are in the file that is given as json=FILE."""
    path = tmp_path / "bench.json"
    small = ["cases=[frame]", "particles=[30]", "seconds=1e-9", "network.width=8", "network.levels=1", "device=cpu"]
    assert run_module("tools.bench", [f"json={path}", *small]) == 0
    assert json.loads(path.read_text())["rows"][0]["case"] == "frame"
