"""python -m tools.scaling: its rows, its checks, its model; no assertion on any time."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from hypothesis import given
from hypothesis import strategies as st

from hgn.schema import ConfigError, from_mapping
from tools.scaling import measure
from tools.scaling.__main__ import NODE_LAUNCH_S, NODE_LINK, SIZES, given_rows, main, model_table
from tools.scaling.config import ScalingConfig
from tools.scaling.model import (
    Cluster,
    Link,
    Step,
    all_reduce_seconds,
    expected_maximum,
    fit,
    sent_bytes,
    update,
)

SMALL: dict[str, Any] = {
    "particles": 40,
    "scenes": 2,
    "batches": 2,
    "rounds": 3,
    "message_mb": [],
    "network": {"width": 16, "levels": 2, "message_passing_steps": 1},
    "device": "cpu",
}
CLUSTER = Cluster(8, launch_s=1e-5, inside=Link(1e-6, 1e11), between=Link(1e-5, 1e10))
STEP = Step(seconds=0.1, backward_seconds=0.06, messages=(4_000_000, 4_000_000, 1_000_000), spread=0.05)


def test_rows_of_every_case(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two processes train alone and together, with equal and with unequal scenes, all checked and timed; all-reduces
    and the model's rows follow, and the tables show them."""
    path = tmp_path / "reports" / "scaling.json"
    assert main(SMALL | {"json": str(path)}) == 0
    report = json.loads(path.read_text())
    assert {"device", "versions", "commit", "date", "command", "config"} <= report["meta"].keys()
    rows = {case: [row for row in report["rows"] if row["case"] == case] for case in ("weak_scaling", "all_reduce")}
    assert {row["backend"] for row in rows["weak_scaling"]} == {"torch"}  # without a GPU
    found = [(row["devices"], row["averaged"], row["particle_spread"]) for row in rows["weak_scaling"]]
    assert found == [(1, False, 0), (1, False, 0.17), (2, False, 0), (2, True, 0), (2, True, 0.17)]
    assert all(row["check"] == "pass" and row["ms"] > 0 and row["efficiency"] > 0 for row in rows["weak_scaling"])
    parameters = sum(row["messages"][0] for row in rows["weak_scaling"][3:4])
    assert parameters % 4 == 0 and parameters > 1000  # one message of all gradients
    assert [row["bytes"] for row in rows["all_reduce"]] == list(measure.ALL_REDUCE_BYTES)
    assert rows["all_reduce"][-1]["model_ms"] == pytest.approx(rows["all_reduce"][-1]["ms"])
    model = [row for row in report["rows"] if row["case"] == "model"]
    assert [row["devices"] for row in model] == 2 * list(SIZES)
    printed = capsys.readouterr().out
    assert "| torch | fp32 | 2 | 2 | 0.17 | 1, up to 0.0 MB |" in printed
    assert model_table(report["rows"]) in printed and "| 1024 | 128 |" in printed


def test_a_given_update_is_not_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With update_ms the model alone is printed, of the network's gradients in messages as training sends them."""
    path = tmp_path / "model.json"
    assert main({"update_ms": 120.0, "backward_ms": 70.0, "json": str(path)}) == 0
    rows = json.loads(path.read_text())["rows"]
    assert capsys.readouterr().out == model_table(rows) + "\n"
    one, two = rows[:2]
    assert (one["ms"], one["all_reduce_ms"], one["efficiency"]) == (120.0, 0, 1)
    gradients = 4 * 3_501_747
    four_messages = 4 * (NODE_LAUNCH_S + 2 * NODE_LINK.latency_s) + gradients / NODE_LINK.bytes_per_second
    assert two["all_reduce_ms"] == pytest.approx(1e3 * four_messages)
    assert main({"update_ms": 6.5}) == 0  # all gradients at the end: one message, not hidden
    assert "| 2 | 1 | 0.07 | 0.07 |" in capsys.readouterr().out


def test_the_page_shows_what_the_model_says() -> None:
    """The files behind the tables of jobs/SCALING.md are what its commands give (test_tables.py does the rest)."""
    root = Path(__file__).parents[2]
    page = (root / "jobs" / "SCALING.md").read_text()
    commands = re.findall(r"`python -m tools\.scaling ([^`]*)`[^(]*\((?:\S*/)(results/scaling/\S+\.json)\)", page)
    assert len(commands) == 2
    for command, file in commands:
        values = {key: float(value) for key, value in (pair.split("=") for pair in command.split())}
        rows = json.loads((root / file).read_text())["rows"]
        assert rows == given_rows(ScalingConfig(**values))


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[dist.ProcessGroup]:
    """A group of this process alone."""
    dist.init_process_group("gloo", init_method=f"file://{tmp_path / 'store'}", rank=0, world_size=1)
    yield dist.new_group([0])
    dist.destroy_process_group()


def averaged(
    group: dist.ProcessGroup, make: type[measure.TorchUpdates | measure.TritonUpdates], config: ScalingConfig
) -> measure.Contender:
    device = torch.device("cpu")
    updates = make(config, measure._batches(config, 0, 0.1, device), device)
    found = measure.Contender("any", 1, True, 4, 0.1, updates)
    measure._average(found, group)
    return found


def test_no_time_where_a_check_is_red(alone: dist.ProcessGroup, monkeypatch: pytest.MonkeyPatch) -> None:
    """Averages that are wrong, and weights that differ between ranks, are found, and get a reason instead of a time."""
    config = from_mapping(ScalingConfig, SMALL)
    contender = averaged(alone, measure.TorchUpdates, config)
    assert contender.check == "pass" and len(contender.messages) == 1
    right = dist.all_reduce

    def wrong_sum(tensor: torch.Tensor, group: dist.ProcessGroup, async_op: bool = False) -> dist.Work | None:
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
def test_the_fast_path_is_timed_alike(alone: dist.ProcessGroup) -> None:
    """Its updates are those of backend torch on the same scenes: weights agree after them; averages are checked."""
    small = {"network": {"width": 16, "levels": 1, "message_passing_steps": 1}, "particles": 6}
    config = from_mapping(ScalingConfig, SMALL | small | {"scenes": 1, "batches": 1})
    plain, fast = (averaged(alone, make, config) for make in (measure.TorchUpdates, measure.TritonUpdates))
    assert plain.check == fast.check == "pass"
    assert plain.messages[0] <= fast.messages[0] < 2 * plain.messages[0]  # the kernels' layout has spare places
    assert plain.update is not None and fast.update is not None
    for contender in (plain, fast):
        contender.update.run()
    assert float(fast.update.weights().norm()) == pytest.approx(float(plain.update.weights().norm()), rel=1e-4)


def test_all_reduce_against_closed_forms() -> None:
    """One GPU sends nothing; a ring of n takes 2 (n - 1) steps and 2 (n - 1) / n of the bytes; across nodes each GPU
    sends its part of the bytes, in a ring or in trees, whichever is quicker."""
    size = 14e6
    assert all_reduce_seconds(size, 1, CLUSTER) == sent_bytes(size, 1) == 0
    for gpus in (2, 4, 8):
        ring = 1e-5 + 2 * (gpus - 1) * 1e-6 + 2 * (gpus - 1) / gpus * size / 1e11
        assert all_reduce_seconds(size, gpus, CLUSTER) == pytest.approx(ring)
    node = all_reduce_seconds(size, 8, CLUSTER)
    part = size / 8 / 1e10
    assert all_reduce_seconds(size, 16, CLUSTER) == pytest.approx(node + 2e-5 + part)  # two nodes: a ring
    assert all_reduce_seconds(4, 1024, CLUSTER) == pytest.approx(1e-5 + 14e-6 + 14e-5, rel=1e-3)  # seven steps, twice


def test_update_against_closed_forms() -> None:
    """Alone nothing is added. Messages that are sent in time cost what the last one takes; where sending takes longer
    than the backward pass, what is left of it. Ranks that differ wait for the slowest."""
    one = update(STEP, 1, CLUSTER)
    assert (one.seconds, one.efficiency, one.not_hidden_s, one.slowest_s) == (STEP.seconds, 1, 0, 0)
    two = update(STEP, 2, CLUSTER)
    assert two.not_hidden_s == pytest.approx(all_reduce_seconds(1_000_000, 2, CLUSTER))
    assert two.slowest_s == pytest.approx(0.564 * 0.05 * 0.1, rel=0.05)  # the larger of two normal numbers
    slow = Cluster(8, 0.0, Link(0.0, 1e8), Link(0.0, 1e8))
    late = update(STEP, 2, slow)
    first_full = 0.06 * 4 / 9
    assert late.not_hidden_s == pytest.approx(first_full + 9e6 / 1e8 - 0.06)
    assert expected_maximum(1) == 0 and expected_maximum(1000) == pytest.approx(3.241, rel=0.01)


@given(st.integers(0, 9))
def test_more_gpus_give_more_scenes_each_a_little_slower(power: int) -> None:
    """Twice the GPUs make more scenes a second, and no GPU more than before."""
    few, many = update(STEP, 2**power, CLUSTER), update(STEP, 2 ** (power + 1), CLUSTER)
    assert few.seconds < many.seconds < 2 * few.seconds and many.efficiency < few.efficiency


def test_fit_finds_the_link() -> None:
    """From all-reduces of the model itself the fit recovers latency, launch and rate; one number of GPUs suffices."""
    sizes = (4, 1_000_000, 64_000_000)
    measured = [(gpus, size, all_reduce_seconds(size, gpus, CLUSTER)) for gpus in (2, 4) for size in sizes]
    launch_s, link = fit(measured)
    assert launch_s == pytest.approx(1e-5, rel=1e-3)
    assert (link.latency_s, link.bytes_per_second) == pytest.approx((1e-6, 1e11), rel=1e-3)
    launch_s, link = fit(measured[:3])
    assert launch_s == 0 and link.bytes_per_second == pytest.approx(1e11, rel=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"devices": 0}, "devices must be at least 1"),
        ({"device": "cuda:1"}, "device must be auto, cpu or cuda"),
        ({"batches": 0}, "batches must be at least 1"),
        ({"update_ms": 0}, "update_ms must be"),
        ({"update_ms": 5, "backward_ms": 6}, "backward_ms must be at most update_ms, got 6"),
        ({"backends": ["slow"]}, r"backends\[0\] must be torch or triton"),
        ({"message_mb": [0]}, r"message_mb\[0\] must be a finite number > 0"),
        ({"particle_spread": -1}, "particle_spread must be"),
        ({"network": {"kind": "gns", "levels": 1}}, "network.kind must be hgn"),
    ],
)
def test_bad_options(change: dict[str, Any], message: str) -> None:
    """Each wrong option is named before anything is started."""
    with pytest.raises(ConfigError, match=message):
        from_mapping(ScalingConfig, change)


def test_devices_that_are_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """More GPUs than the machine has are refused."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="devices must be at most the 0 GPUs of this machine, got 2"):
        main(SMALL | {"device": "cuda", "devices": 2})
