"""Training on several processes: the same gradients, the same weights, one run folder, one decision to stop."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from training.runs import metrics, train_mapping

from hgn import train
from hgn.config import DatagenConfig, TrainingConfig
from hgn.schema import ConfigError
from hgn.training.checkpoint import read_checkpoint
from hgn.training.launch import default_run, first_rank, layout

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = Path(__file__).with_name("ddp_program.py")
ADAM_BETA_1 = 0.9
LAUNCHER_VARIABLES = (
    *("HGN_RUN", "RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "NODE_RANK", "TORCHELASTIC_RUN_ID"),
    *("SLURM_PROCID", "SLURM_NTASKS", "SLURM_NNODES", "SLURM_JOB_NAME", "SLURM_JOB_ID"),
)


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def torchrun(folder: Path, processes: int = 2) -> None:
    """Trains by folder/mapping.json in several CPU processes (gloo)."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--nnodes", "1", "--nproc-per-node", str(processes)]
    address = ["--master-addr", "127.0.0.1", "--master-port", str(free_port())]
    process = subprocess.run(
        [*launcher, *address, str(PROGRAM), str(folder)],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert process.returncode == 0, process.stderr[-4000:]


def load(path: Path) -> Any:
    return torch.load(path, weights_only=True)


def test_two_ranks_train_as_one(
    make_config: Callable[..., DatagenConfig],
    make_dataset: Callable[[DatagenConfig], Path],
    tmp_path: Path,
) -> None:
    """Two ranks with a scene each have the gradients of one with both (to 1e-6); their weights stay bitwise equal;
    SIGTERM to one of them ends both at the same update, with a checkpoint and the same exit code; one run folder."""
    config = make_config()
    make_dataset(config)
    folder = tmp_path / "two"
    folder.mkdir()
    changes: dict[str, Any] = {"maximum_updates": 40, "monitor_rollout_frames": 0}
    two = train_mapping(config, folder / "run", **changes, batch_scenes=1, devices=2)
    (folder / "mapping.json").write_text(json.dumps(two))
    (folder / "signal.json").write_text("[1, 13]")
    torchrun(folder)

    one = train_mapping(config, tmp_path / "one", **(changes | {"maximum_updates": 1}), batch_scenes=2)
    assert train.main(one) == 0
    alone = read_checkpoint(tmp_path / "one" / "checkpoints" / "last.ckpt")
    # Adam's first moment after one update is (1 - beta_1) times the gradient
    moments = alone["optimizer_states"][0]["state"]
    names = [name for name in alone["state_dict"] if "normaliser" not in name]
    assert len(moments) == len(names)
    reference = {name: moments[index]["exp_avg"] / (1 - ADAM_BETA_1) for index, name in enumerate(names)}

    gradients = [load(folder / f"gradients_{rank}.pt") for rank in (0, 1)]
    assert gradients[0].keys() == gradients[1].keys() == reference.keys()
    assert max(float(gradient.abs().max()) for gradient in reference.values()) > 0.1
    for name, expected in reference.items():
        assert torch.equal(gradients[0][name], gradients[1][name]), name
        difference = float((gradients[0][name] - expected).abs().max())
        assert difference <= 1e-6 * max(1.0, float(expected.abs().max())), name

    ends = [load(folder / f"end_{rank}.pt") for rank in (0, 1)]
    assert [end["update"] for end in ends] == [20, 20]  # ranks agree at every tenth update
    assert [end["exit_code"] for end in ends] == [128 + signal.SIGTERM] * 2
    stored = read_checkpoint(folder / "run" / "checkpoints" / "last.ckpt")
    assert stored["hgn"]["updates"] == 20
    cursor = stored["hgn"]["cursor"]
    assert 25 * cursor["epoch"] + cursor["position"] == 2 * 20  # two samples an update, of 5 episodes with 5 steps
    for name, tensor in stored["state_dict"].items():
        assert torch.equal(ends[0]["weights"][name], tensor), name
        assert torch.equal(ends[1]["weights"][name], tensor), name
    made = {path.name for path in folder.iterdir() if path.suffix not in (".json", ".pt")}
    assert made == {"run"}
    assert len(list((folder / "run" / "tensorboard").glob("events.*"))) == 1
    updates = [record["update"] for record in metrics(folder / "run") if "loss" in record]
    assert updates == [4, 8, 12, 16, 20]  # one line each: rank 0 alone writes


@pytest.fixture
def no_launcher(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    for name in LAUNCHER_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


@pytest.mark.parametrize(
    ("variables", "first"),
    [
        ({}, True),
        ({"RANK": "0", "LOCAL_RANK": "0"}, True),
        ({"RANK": "2", "LOCAL_RANK": "0"}, False),
        ({"RANK": "0", "LOCAL_RANK": "0", "SLURM_PROCID": "1"}, True),  # torchrun inside srun, rank 0 elsewhere
        ({"SLURM_PROCID": "0"}, True),
        ({"SLURM_PROCID": "3"}, False),
        ({"LOCAL_RANK": "1"}, False),
        ({"LOCAL_RANK": "0", "NODE_RANK": "1"}, False),
    ],
)
def test_one_process_leads(no_launcher: pytest.MonkeyPatch, variables: dict[str, str], first: bool) -> None:
    """Whatever launched the processes, exactly the one of global rank 0 leads."""
    for name, value in variables.items():
        no_launcher.setenv(name, value)
    assert first_rank() is first


@pytest.mark.parametrize(
    ("variables", "accepted"),
    [
        ({}, True),
        ({"RANK": "0", "WORLD_SIZE": "4"}, True),
        ({"RANK": "0", "WORLD_SIZE": "2"}, False),
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "4"}, True),
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "8"}, False),
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "8", "SLURM_JOB_NAME": "bash"}, True),
        ({"SLURM_PROCID": "1", "SLURM_NTASKS": "2", "RANK": "3", "WORLD_SIZE": "4"}, True),
    ],
)
def test_launcher_and_configuration_agree(
    no_launcher: pytest.MonkeyPatch, variables: dict[str, str], accepted: bool
) -> None:
    """A launcher that started another number of processes than devices x nodes is refused: each would train alone."""
    for name, value in variables.items():
        no_launcher.setenv(name, value)
    training = TrainingConfig(accelerator="cpu", devices=2, nodes=2)
    if accepted:
        assert layout(training) == (2, 2)
    else:
        with pytest.raises(
            ConfigError, match=r"training\.devices x training\.nodes must be the \d processes .* 2 x 2;"
        ):
            layout(training)


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({}, (1, 1)),
        ({"RANK": "5", "WORLD_SIZE": "6", "LOCAL_WORLD_SIZE": "2"}, (2, 3)),
        ({"RANK": "0", "WORLD_SIZE": "4"}, (4, 1)),
        ({"SLURM_PROCID": "7", "SLURM_NTASKS": "8", "SLURM_NNODES": "2"}, (4, 2)),
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "8", "SLURM_NNODES": "2", "SLURM_JOB_NAME": "interactive"}, (1, 1)),
        ({"SLURM_PROCID": "1", "SLURM_NTASKS": "2", "RANK": "3", "WORLD_SIZE": "4", "LOCAL_WORLD_SIZE": "2"}, (2, 2)),
    ],
)
def test_layout_follows_the_launcher(
    no_launcher: pytest.MonkeyPatch, variables: dict[str, str], expected: tuple[int, int]
) -> None:
    """Where the configuration leaves them open, devices and nodes are those that the launcher started."""
    for name, value in variables.items():
        no_launcher.setenv(name, value)
    assert layout(TrainingConfig(accelerator="cpu")) == expected


@pytest.mark.parametrize(
    ("variables", "folder"),
    [
        ({}, "runs/small"),
        ({"SLURM_JOB_ID": "4711"}, "runs/small"),  # a shell or a script inside a job, without srun
        ({"SLURM_JOB_ID": "4711", "SLURM_PROCID": "3", "SLURM_NTASKS": "8"}, "runs/small-4711"),
        ({"RANK": "1", "WORLD_SIZE": "2", "TORCHELASTIC_RUN_ID": "none"}, "runs/small"),
        ({"RANK": "1", "WORLD_SIZE": "2", "TORCHELASTIC_RUN_ID": "night/one two"}, "runs/night-one-two"),
        ({"RANK": "1", "TORCHELASTIC_RUN_ID": "5bd6a8f0-93a5-4c5b-9b8c-0a52b6cf3d11"}, "runs/small"),
        ({"RANK": "0", "TORCHELASTIC_RUN_ID": "a", "SLURM_JOB_ID": "1", "SLURM_PROCID": "0"}, "runs/a"),
        ({"HGN_RUN": "mine", "TORCHELASTIC_RUN_ID": "a", "SLURM_JOB_ID": "1", "SLURM_PROCID": "0"}, "runs/mine"),
        ({"HGN_RUN": "/shared/mine"}, "/shared/mine"),
    ],
)
def test_one_folder_a_run(no_launcher: pytest.MonkeyPatch, variables: dict[str, str], folder: str) -> None:
    """All processes of a job, and its restarts, agree on the folder; two jobs get two. Our own variable comes first,
    then torchrun's id (unless it is random, as --standalone makes it), then Slurm's."""
    for name, value in variables.items():
        no_launcher.setenv(name, value)
    assert str(default_run("small")) == folder


def test_devices_that_are_not_there(no_launcher: pytest.MonkeyPatch) -> None:
    """All GPUs are taken unless fewer are asked for; more than there are, or a GPU where there is none, is refused."""
    for gpus in (0, 4):
        no_launcher.setattr(torch.cuda, "is_available", lambda gpus=gpus: gpus > 0)
        no_launcher.setattr(torch.cuda, "device_count", lambda gpus=gpus: gpus)
        assert layout(TrainingConfig()) == (max(gpus, 1), 1)
        assert layout(TrainingConfig(devices=3)) == (3, 1)
        assert layout(TrainingConfig(accelerator="cpu")) == (1, 1)
    with pytest.raises(ConfigError, match=r"training\.devices must be at most the 4 GPUs of this machine, got 5"):
        layout(TrainingConfig(devices=5))
    no_launcher.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"training\.accelerator must be auto or cpu without a GPU, got 'gpu'"):
        layout(TrainingConfig(accelerator="gpu"))
