"""The training command on backend triton: counts, logs, checkpoints, resume, and the way back to backend torch."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from kernels.engines import device
from training.runs import metrics, train_mapping
from training.test_weights import data as data

from hgn import train
from hgn.config import NetworkConfig, TrainingConfig
from hgn.kernels.update.op import UpdateSettings
from hgn.network.build import build_network
from hgn.runtime.backend import choose, pick, triton_unsupported_reason
from hgn.schema import ConfigError
from hgn.training.checkpoint import read_checkpoint
from hgn.training.data_module import chunk_length
from hgn.training.readers import EpisodeReader
from hgn.training.triton_updates import TritonUpdates

pytestmark = pytest.mark.usefixtures("large_tiles")

NETWORK = {"width": 16, "levels": 1, "message_passing_steps": 1, "cell_size": 0.2}


def run_mapping(config, run, **training):
    values = {"maximum_updates": 4, "log_every": 4, "checkpoint_every": 4, "monitor_every": 4}
    values |= {"backend": "triton", "precision": "fp32", "device": "auto"} | training
    mapping = train_mapping(config, run, **values)
    return mapping | {"network": NETWORK}


def without_jitter(monkeypatch):
    """Both backends draw the grid's origin from random streams of their own."""
    settings = UpdateSettings.of
    monkeypatch.setattr("hgn.training.torch_updates.jittered_origin", lambda *_: None)
    monkeypatch.setattr(UpdateSettings, "of", lambda *arguments: replace(settings(*arguments), grid_jitter=False))


def test_fast_training_is_the_plain_one(data, tmp_path, monkeypatch, capsys):
    """Without noise and jitter both backends make the same updates: every count and log line is there, weights,
    their average and moments agree; a training may change backend at any checkpoint, and ends where the others do."""
    monkeypatch.setattr("hgn.training.session.triton_unsupported_reason", lambda *_: None)  # in float32
    without_jitter(monkeypatch)
    same = {"noise_std": 0.0, "warmup_updates": 3, "ema_decay": 0.7}
    ends = {}
    for name, parts in {
        "torch": [("torch", 4)],
        "triton": [("triton", 4)],
        "mixed": [("torch", 1), ("triton", 2), ("torch", 4)],
    }.items():
        for backend, updates in parts:
            with monkeypatch.context() as patch:
                if updates < 4:
                    stop_at(patch, updates)
                assert train.main(run_mapping(data, tmp_path / name, backend=backend, **same)) == 0
            ends[name] = read_checkpoint(tmp_path / name / "checkpoints" / "last.ckpt")
            assert ends[name]["hgn"]["updates"] == updates
    assert "training backend: triton, precision fp32" in capsys.readouterr().err
    for name in ("triton", "mixed"):
        assert ends[name]["hgn"] == ends["torch"]["hgn"]
        for key, value in ends["torch"]["state_dict"].items():
            torch.testing.assert_close(ends[name]["state_dict"][key], value, rtol=1e-3, atol=2e-5)
        states, expected = ends[name]["optimizer_states"][0], ends["torch"]["optimizer_states"][0]
        assert states["param_groups"] == expected["param_groups"]
        for parameter, state in expected["state"].items():
            assert float(states["state"][parameter]["step"]) == float(state["step"]) == 4
            torch.testing.assert_close(states["state"][parameter]["exp_avg"], state["exp_avg"], rtol=1e-2, atol=1e-6)
    plain, fast = ([record for record in metrics(tmp_path / name) if "loss" in record] for name in ("torch", "triton"))
    assert [record["update"] for record in fast] == [record["update"] for record in plain] == [4]
    for found, expected in zip(fast, plain, strict=True):
        assert found["learning_rate"] == expected["learning_rate"] and found["skipped_updates"] == 0
        assert found["loss"] == pytest.approx(expected["loss"], rel=1e-4)
        assert found["gradient_norm"] == pytest.approx(expected["gradient_norm"], rel=1e-3)
    monitored = [
        [record["one_step/validation"] for record in metrics(tmp_path / name) if "one_step/validation" in record]
        for name in ("torch", "triton")
    ]
    assert len(monitored[0]) == 1 and monitored[1] == pytest.approx(monitored[0], rel=1e-3)


@pytest.mark.skipif(device().type != "cpu", reason="on a GPU sums are taken in another order each time")
def test_a_part_of_the_data_is_enough(make_config, make_dataset, tmp_path, monkeypatch):
    """A training that holds 6 of 14 episodes at a time, into its second epoch, ends with the weights of one that holds
    all, bitwise."""
    config = make_config(training_scenes=14, validation_scenes=1, test_scenes=0, frames=3)
    make_dataset(config)
    monkeypatch.setattr("hgn.training.session.triton_unsupported_reason", lambda *_: None)  # in float32
    updates = {"maximum_updates": 9, "batch_scenes": 2, "log_every": 2, "checkpoint_every": 9, "monitor_every": 9}
    ends, most = [], []
    original, built = TritonUpdates.run, EpisodeReader.__init__
    for held in (6, 14):
        sizes: list[int] = []

        def run(trainer, *arguments, sizes=sizes):
            original(trainer, *arguments)
            sizes.append(len(trainer._episodes))

        def limited(reader, *arguments, held=held):
            built(reader, *arguments)
            reader.capacity = held

        monkeypatch.setattr(TritonUpdates, "run", run)
        monkeypatch.setattr(EpisodeReader, "__init__", limited)
        assert train.main(run_mapping(config, tmp_path / str(held), shuffle_episodes=3, **updates)) == 0
        ends.append(read_checkpoint(tmp_path / str(held) / "checkpoints" / "last.ckpt")["state_dict"])
        most.append(max(sizes))
    assert most[0] <= 6 < most[1]
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])


def stop_at(monkeypatch, update):
    """Lets the next training end once it has made that many updates, or just after."""
    from hgn.training.callbacks import Stopper

    original = Stopper.on_train_batch_end

    def on_train_batch_end(self, trainer, module, *arguments):
        trainer.should_stop = module.update >= update
        return original(self, trainer, module, *arguments)

    monkeypatch.setattr(Stopper, "on_train_batch_end", on_train_batch_end)


def test_chunks_end_where_something_is_due():
    """Chunks meet every multiple of the log, checkpoint, monitor and rollout intervals and the last update, whatever
    update a training begins at, and the first ones are short."""
    training = TrainingConfig(
        maximum_updates=1000,
        log_every=50,
        checkpoint_every=70,
        monitor_every=300,
        pushforward_fraction=0.2,
        pushforward_every=32,
    )
    for begun in (0, 37, 999):
        update, ends = begun, []
        while update < 1000:
            count = chunk_length(training, begun, update, EpisodeReader.updates_at_once)
            assert 1 <= count <= EpisodeReader.updates_at_once
            update += count
            ends.append(update)
        due = {n for every in (50, 70, 300, 32) for n in range(every, 1001, every) if n > begun} | {1000}
        assert due <= set(ends) and ends[-1] == 1000 and ends[0] == begun + 1


GOLD, HALF = "it needs gold", "it has no fp16"


@pytest.mark.parametrize(
    ("backend", "precision", "reasons", "expected"),
    [
        ("auto", "tf32", (None, None), ("triton", "training backend: triton, precision tf32")),
        ("torch", "tf32", (None, None), ("torch", "training backend: torch, precision tf32")),
        (
            "auto",
            "tf32",
            (GOLD, None),
            ("torch", "training backend: torch (not triton: it needs gold), precision tf32"),
        ),
        ("triton", "tf32", (GOLD, None), "training.backend must be torch or auto here, got triton: it needs gold"),
        ("auto", "fp16", (GOLD, HALF), "precision must be tf32 or fp32 on backend torch, got fp16; triton: it"),
        ("torch", "fp16", (None, HALF), "got fp16; training.backend=torch was asked for"),
    ],
)
def test_the_backend_is_chosen_and_said(backend, precision, reasons, expected):
    """auto takes backend triton where it runs and says so; what cannot be had is refused, never replaced silently."""
    keeps = dict(zip(("triton", "torch"), reasons, strict=True))
    if isinstance(expected, tuple):
        assert pick(keeps, backend, precision, "training.backend") == expected
    else:
        with pytest.raises(ConfigError, match=expected):
            pick(keeps, backend, precision, "training.backend")


def test_what_a_cpu_takes():
    """An HGN compiled C, unless torch is asked for; a GNS PyTorch; fp16 is refused for both."""
    cpu = torch.device("cpu")
    hgn, gns = (build_network(NetworkConfig(width=16, kind=kind, levels=1)) for kind in ("hgn", "gns"))
    assert [choose(cpu, hgn, "tf32", name).name for name in ("auto", "torch", "cpu")] == ["cpu", "torch", "cpu"]
    assert choose(cpu, gns).name == "torch"
    for network, precision, backend, message in (
        (hgn, "fp16", "auto", "got fp16; triton: it needs a CUDA device"),
        (gns, "fp16", "auto", "precision must be tf32 or fp32 on backend torch, got fp16; triton"),
        (hgn, "tf32", "triton", "backend must be cpu or torch or auto here, got triton: it needs a CUDA device"),
        (gns, "tf32", "cpu", "backend must be torch or auto here, got cpu: it computes hgn networks, not gns"),
    ):
        with pytest.raises(ConfigError, match=message):
            choose(cpu, network, precision, backend)


def test_why_backend_triton_does_not_run():
    """A CPU, GNS, an odd width and too many levels are each named."""
    gpu, hgn = torch.device("cuda"), NetworkConfig()
    assert triton_unsupported_reason(gpu, hgn) is None
    assert "not cpu" in str(triton_unsupported_reason(torch.device("cpu"), hgn))
    assert "hgn networks, not gns" in str(triton_unsupported_reason(gpu, NetworkConfig(kind="gns", levels=1)))
    assert "not 48" in str(triton_unsupported_reason(gpu, NetworkConfig(width=48)))
    assert "in tf32 or fp16, not fp32" in str(triton_unsupported_reason(gpu, hgn, "fp32"))
    assert "at most 8" in str(triton_unsupported_reason(gpu, NetworkConfig(levels=9)))


def test_little_shared_memory(monkeypatch):
    """A GPU with 99 KB of shared memory takes backend torch, which says why; triton where the network is narrower."""
    small = SimpleNamespace(shared_memory_per_block_optin=101_376)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: small)
    monkeypatch.setattr("hgn.runtime.backend.host_unsupported_reason", lambda: None)
    gpu, reason = torch.device("cuda"), "its kernels need 160 KB of shared memory at width 128, and this GPU has 99"
    assert triton_unsupported_reason(gpu, NetworkConfig()) == reason
    reasons = {"triton": reason, "torch": None}
    assert reason in pick(reasons, "auto", "tf32", "backend")[1]
    assert triton_unsupported_reason(gpu, NetworkConfig(width=64)) is None
