"""The launch files: they are valid, start what they say, and go on after the time limit."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from training.runs import metrics, train_arguments

from hgn.config import DatagenConfig
from hgn.training.checkpoint import read_checkpoint

ROOT = Path(__file__).resolve().parents[2]
JOBS = ROOT / "jobs"
SCRIPTS = sorted([*JOBS.rglob("*.sh"), *JOBS.rglob("*.sbatch")])
SHORT = {"maximum_updates": 4, "batch_scenes": 1, "log_every": 2, "monitor_every": 4, "monitor_rollout_frames": 0}

# starts one process for each task of one node, as srun does, and returns the highest exit code
SRUN = """#!/usr/bin/env bash
while [[ $1 == --* ]]; do shift; done
pids=()
for ((task = 0; task < SLURM_NTASKS; task++)); do
    SLURM_PROCID=$task SLURM_LOCALID=$task SLURM_NODEID=0 "$@" &
    pids+=($!)
done
highest=0
for pid in "${pids[@]}"; do
    code=0
    wait "$pid" || code=$?
    ((code > highest)) && highest=$code
done
exit "$highest"
"""


def run(script: str, *arguments: str, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("SLURM_")}
    environment = kept | {"PYTHON": sys.executable, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | variables
    command = ["bash", str(JOBS / script), *arguments]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=240)


def write_program(folder: Path, name: str, text: str) -> None:
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(text)
    (folder / name).chmod(0o755)


@pytest.fixture
def slurm(tmp_path: Path) -> dict[str, str]:
    """The environment of a Slurm job on one node with two tasks, with stand-ins for srun and scontrol."""
    programs = tmp_path / "programs"
    write_program(programs, "srun", SRUN)
    write_program(programs, "scontrol", f'#!/usr/bin/env bash\necho "$@" >> {tmp_path}/scontrol.log\n')
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    return {
        "PATH": f"{programs}:{os.environ['PATH']}",
        "SLURM_JOB_ID": "4711",
        "SLURM_JOB_NAME": "hgn-train",
        "SLURM_NNODES": "1",
        "SLURM_NTASKS": "2",
        "SLURM_NTASKS_PER_NODE": "2",
        "SLURM_NODELIST": "localhost",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
    }


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_scripts_are_valid(script: Path) -> None:
    """Bash parses each launch file, shellcheck (where installed) finds nothing, and each may be executed."""
    assert subprocess.run(["bash", "-n", str(script)], capture_output=True, text=True).stderr == ""
    if shutil.which("shellcheck"):
        checked = subprocess.run(["shellcheck", "--shell", "bash", str(script)], capture_output=True, text=True)
        assert checked.returncode == 0, checked.stdout
    assert os.access(script, os.X_OK)


def test_all_are_listed() -> None:
    """The table names every launch file, and every launch file that it names is there."""
    text = (JOBS / "README.md").read_text()
    named = set(re.findall(r"jobs/[\w/]+\.\w+", text))
    assert named == {str(script.relative_to(ROOT)) for script in SCRIPTS}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_options_of_slurm_come_first(script: Path) -> None:
    """sbatch reads its options only before the first command; tasks and GPUs of a node are the same number."""
    lines = script.read_text().splitlines()
    first_command = next(i for i, line in enumerate(lines) if line and not line.startswith("#"))
    options = [line.removeprefix("#SBATCH ") for line in lines[:first_command] if line.startswith("#SBATCH ")]
    assert sum(line.startswith("#SBATCH") for line in lines) == len(options)
    assert bool(options) == (script.suffix == ".sbatch")
    assert all(re.fullmatch(r"--[a-z-]+(=\S+)?", option) for option in options)
    values = dict(option.removeprefix("--").partition("=")[::2] for option in options)
    assert values.get("ntasks-per-node", "1") == values.get("gpus-per-node", "1")


def test_torchrun_trains(
    make_config: Callable[..., DatagenConfig], make_dataset: Callable[[DatagenConfig], Path], tmp_path: Path
) -> None:
    """jobs/torchrun.sh starts one training on two processes, which writes one run folder."""
    config = make_config()
    make_dataset(config)
    done = run("torchrun.sh", *train_arguments(config, tmp_path / "run", **SHORT), cwd=tmp_path, GPUS="2")
    assert done.returncode == 0, done.stderr[-4000:]
    assert done.stdout.count("trained 4 of 4 updates") == 1
    stored = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert (stored["training"]["devices"], stored["training"]["nodes"]) == (2, 1)
    assert [record["update"] for record in metrics(tmp_path / "run") if "loss" in record] == [2, 4]


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"GPUS": "all"}, "error: GPUS must be a whole number of at least 1, got 'all'\n"),
        ({"NODES": "0"}, "error: NODES must be a whole number of at least 1, got '0'\n"),
        ({"NODES": "2"}, "error: RENDEZVOUS must be host:port of one of the 2 machines, got nothing; as in"),
    ],
)
def test_torchrun_refuses(tmp_path: Path, variables: dict[str, str], message: str) -> None:
    """Variables that make no sense are named before anything starts."""
    done = run("torchrun.sh", cwd=tmp_path, **variables)
    assert done.returncode == 2 and done.stderr.startswith(message) and done.stderr.count("\n") == 1


def test_torchrun_on_several_machines(tmp_path: Path) -> None:
    """With NODES and RENDEZVOUS torchrun is told where to meet, and the training how many take part."""
    write_program(tmp_path, "shown", '#!/usr/bin/env bash\nprintf "%s\\n" "$@"\n')
    variables = {"PYTHON": str(tmp_path / "shown"), "NODES": "3", "GPUS": "4", "RENDEZVOUS": "node0:29500"}
    done = run("torchrun.sh", "run=here and there", cwd=tmp_path, EXPERIMENT="small", **variables)
    assert done.stdout.splitlines() == [
        *("-m", "torch.distributed.run", "--nnodes", "3", "--nproc-per-node", "4"),
        *("--rdzv-backend", "c10d", "--rdzv-endpoint", "node0:29500", "--rdzv-id", "hgn-small"),
        *("-m", "hgn.train", "+experiment=small", "training.nodes=3", "training.devices=4", "run=here and there"),
    ]


def test_slurm_trains(
    slurm: dict[str, str],
    make_config: Callable[..., DatagenConfig],
    make_dataset: Callable[[DatagenConfig], Path],
    tmp_path: Path,
) -> None:
    """jobs/slurm/train.sbatch starts one training of two tasks that know their ranks from Slurm's variables."""
    config = make_config()
    make_dataset(config)
    done = run("slurm/train.sbatch", *train_arguments(config, tmp_path / "run", **SHORT), cwd=tmp_path, **slurm)
    assert done.returncode == 0, done.stderr[-4000:]
    assert done.stdout.count("trained 4 of 4 updates") == 1
    checkpoint = read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    assert checkpoint["hgn"]["updates"] == 4
    assert checkpoint["hgn"]["cursor"]["position"] == 8  # four updates with a scene on each of two tasks
    assert not (tmp_path / "scontrol.log").exists()


@pytest.mark.parametrize(
    ("script", "code", "returned", "requeued"),
    [
        ("slurm/train.sbatch", 138, 0, True),
        ("slurm/train.sbatch", 143, 143, False),
        ("slurm/train.sbatch", 2, 2, False),
        ("slurm/generate.sbatch", 130, 0, True),
        ("slurm/generate.sbatch", 143, 143, False),
        ("slurm/generate.sbatch", 0, 0, False),
    ],
)
def test_time_limit(
    slurm: dict[str, str], tmp_path: Path, script: str, code: int, returned: int, requeued: bool
) -> None:
    """Stopped by the signal before the time limit, a job is queued again; cancelled or failed, it is not."""
    write_program(tmp_path / "programs", "srun", f"#!/usr/bin/env bash\nexit {code}\n")
    assert run(script, cwd=tmp_path, **slurm).returncode == returned
    log = tmp_path / "scontrol.log"
    assert (log.read_text() if log.exists() else "") == ("requeue 4711\n" if requeued else "")


def test_slurm_generates(slurm: dict[str, str], tmp_path: Path) -> None:
    """jobs/slurm/generate.sbatch starts the generator with its experiment and arguments."""
    variables = slurm | {"SLURM_NTASKS": "1", "EXPERIMENT": "small"}
    done = run("slurm/generate.sbatch", "scenes=7", "--cfg", "job", cwd=tmp_path, **variables)
    assert done.returncode == 0, done.stderr
    composed = yaml.safe_load(done.stdout)
    assert (composed["name"], composed["scenes"]) == ("small", 7)
