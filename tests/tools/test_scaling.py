"""python -m tools.scaling: its rows, its checks; no assertion on any time."""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.distributed as dist

from hgn.schema import ConfigError, from_mapping
from tools.scaling import measure
from tools.scaling.command import main, training_of
from tools.scaling.config import ScalingConfig

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
SMALL: dict[str, Any] = {"particles": 20, "scenes": 2, "batches": 2, "seconds": 1e-9, "device": "cpu"}
SMALL |= {"network": {"width": 16, "levels": 2, "message_passing_steps": 1}}


def test_rows_of_every_case(warm_python, tmp_path):
    """Two processes train alone and together, with equal and with unequal scenes, all checked and timed, and
    the table shows them."""
    path = tmp_path / "reports" / "scaling.json"
    program, options = Path(__file__).with_name("scaling_program.py"), json.dumps(SMALL | {"json": str(path)})
    command = [str(warm_python), str(program), options]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    report = json.loads(path.read_text())
    assert {"device", "versions", "commit", "date", "command", "config"} <= report["meta"].keys()
    rows = report["rows"]
    assert {row["backend"] for row in rows} == {"torch"}  # without a GPU
    found = [(row["devices"], row["averaged"], row["particle_spread"]) for row in rows]
    assert found == [(1, False, 0), (1, False, 0.17), (2, False, 0), (2, True, 0), (2, True, 0.17)]
    assert all(row["check"] == "pass" and row["ms"] > 0 for row in rows)
    for row in rows:  # particles a second and device, against one device with scenes of the same kind
        (base,) = (r for r in rows if r["devices"] == 1 and r["spread"] == row["spread"])
        rates = [r["particles_per_update"] / r["ms"] for r in (row, base)]
        assert row["efficiency"] == pytest.approx(rates[0] / rates[1])
    cells = [[cell.strip() for cell in line.split("|")] for line in done.stdout.splitlines()]  # long ones wrap
    assert [row[1:6] for row in cells if row[1:2] == ["torch"]][-1] == ["torch", "fp32", "2", "2", "0.17"]


def test_scenes_are_balanced():
    """All ranks have nearly equal numbers of particles in each update. The scenes that a rank trains on are those of
    its row."""
    config = from_mapping(ScalingConfig, {"batches": 20})
    counts_BRS = measure._particles(config, 4, 0.17)
    load_BR = counts_BRS.sum(-1)
    assert counts_BRS.shape == (20, 4, 8) and np.ptp(counts_BRS) > 1000
    assert (load_BR.max(1) / load_BR.mean(1)).mean() < 1.01
    sizes = [batch.particles_S for batch in measure._batches(config, 3, 4, 0.17, torch.device("cpu"))]
    assert sizes == [tuple(row) for row in counts_BRS[:, 3].tolist()]


@pytest.fixture
def alone(tmp_path):
    """A group of this process alone."""
    dist.init_process_group("gloo", init_method=f"file://{tmp_path / 'store'}", rank=0, world_size=1)
    yield dist.new_group([0])
    dist.destroy_process_group()


def averaged(group, make, config):
    device = torch.device("cpu")
    updates = make(config, measure._batches(config, 0, 1, 0.1, device), device)
    found = measure.Contender("any", 1, True, 0.1, 80.0, update=updates)
    measure._average(found, group)
    return found


def test_no_time_where_a_check_is_red(alone, monkeypatch):
    """Averages that are wrong, and weights that differ between ranks, are found, and get a reason instead of a time."""
    config = from_mapping(ScalingConfig, SMALL)
    contender = averaged(alone, measure.TorchUpdates, config)
    assert contender.check == "pass"
    right = dist.all_reduce

    def wrong_sum(tensor, group, async_op=False):
        return right(tensor, group=group, async_op=True) if async_op else tensor.mul_(1.1)

    with monkeypatch.context() as patch:
        patch.setattr(dist, "all_reduce", wrong_sum)
        wrong = averaged(alone, measure.TorchUpdates, config)
    assert wrong.check.startswith("relative error of averaged gradients 9.1e-02 exceeds 2e-02")
    monkeypatch.setattr(dist, "broadcast", lambda tensor, *_, **__: tensor.add_(1e-3))
    measure._check_weights(contender, {1: alone}, 0)
    assert contender.check == "weights of rank 0 differ from those of rank 0 after the updates"
    assert measure._row(contender, config, torch.device("cpu"))["ms"] is None


@pytest.mark.skipif(torch.cuda.is_available(), reason="the interpreter, which takes tensors of the CPU, is off here")
def test_triton_is_timed_alike(alone):
    """Its updates are those of backend torch on the same scenes: weights agree after them; averages are checked."""
    small = {"network": {"width": 16, "levels": 1, "message_passing_steps": 1}, "particles": 6}
    config = from_mapping(ScalingConfig, SMALL | small | {"scenes": 1, "batches": 1})
    plain, fast = (averaged(alone, make, config) for make in (measure.TorchUpdates, measure.TritonUpdates))
    assert plain.check == fast.check == "pass"
    assert plain.update is not None and fast.update is not None
    for contender in (plain, fast):
        contender.update.run()
    assert float(fast.update.weights().norm()) == pytest.approx(float(plain.update.weights().norm()), rel=1e-4)


@pytest.mark.parametrize("inputs", ["absolute", "relative", "local"])
def test_kernels_of_networks_with_any_inputs_are_compiled(inputs):
    """The training whose kernels are compiled ahead has the measured network, without symmetries."""
    config = from_mapping(ScalingConfig, {"network": {"inputs": inputs}})
    job = training_of(config)
    assert job.network == config.network and job.training.symmetry == "none"


def test_devices_that_are_not_there(monkeypatch):
    """More GPUs than the machine has are refused."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="devices must be at most the 0 GPUs of this machine, got 2"):
        main(SMALL | {"device": "cuda", "devices": 2})
