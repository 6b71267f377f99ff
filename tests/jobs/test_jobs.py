"""The launch files: they are valid, start what they say, and go on after the time limit."""

import os
import re
import signal
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
import yaml
from processes import BALLISTIC_PATH, completed, free_port, wait_until, write_program
from training.runs import metrics, train_arguments

from hgn.data.manifest import Manifest
from hgn.training.checkpoint import read_checkpoint

ROOT = Path(__file__).resolve().parents[2]
JOBS = ROOT / "jobs"
SCRIPTS = sorted([*JOBS.rglob("*.sh"), *JOBS.rglob("*.sbatch")])
# the second of two array tasks
_TASKS = {"ID": "1", "COUNT": "2", "MIN": "0", "MAX": "1"}
ARRAY = {f"SLURM_ARRAY_TASK_{name}": value for name, value in _TASKS.items()}
SHORT = {"maximum_updates": 4, "batch_scenes": 1, "log_every": 2, "monitor_every": 4, "monitor_rollout_frames": 0}

# starts one process for each task of one node, as srun does, and returns the highest exit code
SRUN = """#!/usr/bin/env bash
while [[ $1 == --* ]]; do shift; done
[[ $SRUN_CPUS_PER_TASK == "$SLURM_CPUS_PER_TASK" ]] || exit 99 # srun does not take it from sbatch
pids=()
for ((task = 0; task < SLURM_NTASKS; task++)); do
    SLURM_PROCID=$task SLURM_LOCALID=$task SLURM_NODEID=0 "$@" &
    pids+=($!)
    echo $! >> "$SLURM_FAKE/pids"
done
highest=0
for pid in "${pids[@]}"; do
    code=0
    wait "$pid" || code=$?
    ((code > highest)) && highest=$code
done
exit "$highest"
"""
SCONTROL = """#!/usr/bin/env bash
echo "$@" >> "$SLURM_FAKE/scontrol.log"
if [[ $1 == show ]]; then [[ $2 == hostnames ]] && echo localhost || echo "PreemptTime=${PREEMPTED:-None}"; fi
"""
# hands a signal to the tasks of the job's steps
SCANCEL = """#!/usr/bin/env bash
[[ $1 == --signal=* && $2 == "$SLURM_JOB_ID" ]] && xargs kill "-${1#--signal=}" < "$SLURM_FAKE/pids"
"""


def start(script, *arguments, cwd, **variables):
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("SLURM_", "TORCH"))}
    environment = kept | {"PYTHON": sys.executable, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | variables
    return subprocess.Popen(
        ["bash", str(JOBS / script), *arguments],
        cwd=cwd,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(script, *arguments, cwd, **variables):
    return completed(start(script, *arguments, cwd=cwd, **variables))


@pytest.fixture
def slurm(tmp_path):
    """The environment of a Slurm job on one node with two tasks, with stand-ins for srun, scontrol and scancel."""
    programs = tmp_path / "programs"
    for name, text in (("srun", SRUN), ("scontrol", SCONTROL), ("scancel", SCANCEL)):
        write_program(programs / name, text)
    return {
        "PATH": f"{programs}:{os.environ['PATH']}",
        "SLURM_JOB_ID": "4711",
        "SLURM_JOB_NAME": "hgn-train",
        "SLURM_FAKE": str(tmp_path),
        "SLURM_NNODES": "1",
        "SLURM_JOB_NUM_NODES": "1",
        "SLURM_CPUS_PER_TASK": "2",
        "SLURM_NTASKS": "2",
        "SLURM_NTASKS_PER_NODE": "2",
        "SLURM_NODELIST": "localhost",
        "SLURM_JOB_NODELIST": "localhost",
        "SLURM_GPUS_ON_NODE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(free_port()),
    }


@pytest.fixture
def warm(warm_python):
    """The environment in which scripts, torchrun among them, start trainings that need not load anything."""
    return {"PYTHON": str(warm_python), "PYTHON_EXEC": str(warm_python)}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_scripts_are_valid(script):
    """Bash parses each launch file, shellcheck finds nothing, and each may be executed."""
    assert subprocess.run(["bash", "-n", str(script)], capture_output=True, text=True).stderr == ""
    shellcheck = Path(sysconfig.get_path("scripts")) / "shellcheck"
    checked = subprocess.run([str(shellcheck), "--shell", "bash", str(script)], capture_output=True, text=True)
    assert checked.returncode == 0, checked.stdout
    assert os.access(script, os.X_OK)


def test_all_are_listed():
    """The table names every launch file, and every launch file that it names is there."""
    text = (JOBS / "README.md").read_text()
    named = set(re.findall(r"`(?:\w+ )?(?:kubectl apply -f )?(jobs/[\w/]+\.\w+)", text))
    there = [*SCRIPTS, *JOBS.glob("*/*.yaml"), *JOBS.glob("*.txt")]
    assert named == {str(path.relative_to(ROOT)) for path in there}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_options_of_slurm_come_first(script):
    """sbatch reads its options only before the first command; where tasks train, there is one for each GPU."""
    lines = script.read_text().splitlines()
    first_command = next(i for i, line in enumerate(lines) if line and not line.startswith("#"))
    options = [line.removeprefix("#SBATCH ") for line in lines[:first_command] if line.startswith("#SBATCH ")]
    assert sum(line.startswith("#SBATCH") for line in lines) == len(options)
    assert bool(options) == (script.suffix == ".sbatch")
    assert all(re.fullmatch(r"--[a-z-]+(=\S+)?", option) for option in options)
    values = dict(option.removeprefix("--").partition("=")[::2] for option in options)
    tasks = values.get("gpus-per-node", "1") if script.name == "train.sbatch" else "1"
    assert values.get("ntasks-per-node", "1") == tasks


def test_torchrun_trains(warm, data, tmp_path):
    """jobs/torchrun.sh starts one training on two processes, which writes one run folder."""
    done = run("torchrun.sh", *train_arguments(data, tmp_path / "run", **SHORT), cwd=tmp_path, GPUS="2", **warm)
    assert done.returncode == 0, done.stderr[-4000:]
    assert done.stdout.count("trained 4 of 4 updates") == 1
    stored = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert stored["training"]["devices"] is None  # torchrun sets the number of processes
    assert [record["update"] for record in metrics(tmp_path / "run") if "loss" in record] == [2, 4]


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"GPUS": "all"}, "error: GPUS must be a whole number of at least 1, got 'all'\n"),
        ({"NODES": "0"}, "error: NODES must be a whole number of at least 1, or two as in 1:4, got '0'\n"),
        ({"NODES": "1:"}, "error: NODES must be a whole number of at least 1, or two as in 1:4, got '1:'\n"),
        ({"NODES": "2"}, "error: RENDEZVOUS must be host:port of one of the 2 machines, got nothing; as in"),
        ({"NODES": "1:2"}, "error: RENDEZVOUS must be host:port of one of the 1:2 machines, got nothing; as in"),
        ({"RESTARTS": "-1"}, "error: RESTARTS must be a whole number, got '-1'\n"),
    ],
)
def test_torchrun_refuses(tmp_path, variables, message):
    """Variables that make no sense are named before anything starts."""
    done = run("torchrun.sh", cwd=tmp_path, **variables)
    assert done.returncode == 2 and done.stderr.startswith(message) and done.stderr.count("\n") == 1


def test_torchrun_on_several_machines(tmp_path):
    """With NODES and RENDEZVOUS torchrun is told where to meet and what the run is called; the training follows it."""
    write_program(tmp_path / "shown", '#!/usr/bin/env bash\nenv | grep ^TORCH | sort\nprintf "%s\\n" "$@"\n')
    variables = {"PYTHON": str(tmp_path / "shown"), "NODES": "3", "GPUS": "4", "RENDEZVOUS": "node0:29500"}
    done = run("torchrun.sh", "run=here and there", cwd=tmp_path, EXPERIMENT="small", **variables)
    assert done.stdout.splitlines() == [
        "TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1",
        "TORCH_ELASTIC_SHUTDOWN_TIMEOUT=120",
        *("-m", "torch.distributed.run", "--nnodes", "3", "--nproc-per-node", "4", "--max-restarts", "3"),
        *("--rdzv-backend", "c10d", "--rdzv-endpoint", "node0:29500", "--rdzv-id", "small"),
        *("--signals-to-handle", "SIGTERM,SIGINT,SIGHUP,SIGQUIT,SIGUSR1"),
        *("-m", "hgn.train", "+experiment=small", "run=here and there"),
    ]


def test_slurm_trains(slurm, warm, data, tmp_path):
    """jobs/slurm/train.sbatch starts one training of two tasks that know their ranks from Slurm's variables."""
    arguments = train_arguments(data, tmp_path / "run", **SHORT)
    done = run("slurm/train.sbatch", *arguments, cwd=tmp_path, **slurm, **warm)
    assert done.returncode == 0, done.stderr[-4000:]
    assert done.stdout.count("trained 4 of 4 updates") == 1
    checkpoint = read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    assert checkpoint["hgn"]["updates"] == 4
    assert checkpoint["hgn"]["sampler_state"]["position"] == 8  # four updates with a scene on each of two tasks
    assert not (tmp_path / "scontrol.log").exists()


def test_slurm_trains_with_torchrun(slurm, warm, data, tmp_path):
    """jobs/slurm/train_torchrun.sbatch starts one torchrun a node. At the time limit the training ends with a
    checkpoint and the job is queued again; started again, it goes on in the same folder, named after the job."""
    (tmp_path / "jobs").symlink_to(JOBS)
    arguments = [a for a in train_arguments(data, tmp_path, **SHORT) if not a.startswith("run=")]
    slurm |= {"SLURM_NTASKS": "1", "EXPERIMENT": "small"} | warm
    endless = (*arguments, "training.maximum_updates=1000000")
    started = start("slurm/train_torchrun.sbatch", *endless, cwd=tmp_path, **slurm)
    folder = tmp_path / "runs" / "small-4711"
    wait_until(lambda: (folder / "metrics.jsonl").exists() or started.poll() is not None)
    started.send_signal(signal.SIGUSR1)
    ended = completed(started)
    assert ended.returncode == 0, ended.stderr[-4000:]
    assert (tmp_path / "scontrol.log").read_text().splitlines() == ["show hostnames localhost", "requeue 4711"]
    updates = read_checkpoint(folder / "checkpoints" / "last.ckpt")["hgn"]["updates"]
    assert updates > 0 and updates % 10 == 0  # ranks agree at every tenth update

    last = f"training.maximum_updates={updates + 2}"
    done = run("slurm/train_torchrun.sbatch", *arguments, last, cwd=tmp_path, **slurm)
    assert done.returncode == 0, done.stderr[-4000:]
    assert done.stdout.count(f"trained {updates + 2} of {updates + 2} updates in runs/small-4711") == 1
    assert not (tmp_path / "scontrol.log").read_text().count("requeue") > 1


@pytest.mark.parametrize(
    ("script", "code", "returned", "requeued", "preempted"),
    [
        ("slurm/train.sbatch", 138, 0, True, "None"),
        ("slurm/train.sbatch", 143, 143, False, "None"),
        ("slurm/train.sbatch", 2, 2, False, "None"),
        ("slurm/train_torchrun.sbatch", 1, 1, False, "None"),
        ("slurm/train_torchrun.sbatch", 0, 0, False, "None"),
        ("slurm/generate_array.sbatch", 130, 0, True, "None"),
        ("slurm/generate_array.sbatch", 2, 2, False, "None"),
        ("slurm/generate.sbatch", 130, 0, True, "None"),
        ("slurm/generate.sbatch", 143, 143, False, "None"),
        ("slurm/generate.sbatch", 0, 0, False, "None"),
        ("slurm/train.sbatch", 143, 0, True, "2026-01-01T00:00:00"),
        ("slurm/train.sbatch", 2, 2, False, "2026-01-01T00:00:00"),
        ("slurm/train_torchrun.sbatch", 1, 0, True, "2026-01-01T00:00:00"),
        ("slurm/generate.sbatch", 143, 0, True, "2026-01-01T00:00:00"),
        ("slurm/generate_array.sbatch", 143, 0, True, "2026-01-01T00:00:00"),
    ],
)
def test_time_limit(slurm, tmp_path, script, code, returned, requeued, preempted):
    """Stopped by the signal before the time limit, or told to make room, a job is queued again; cancelled or failed, it
    is not."""
    write_program(tmp_path / "programs" / "srun", f"#!/usr/bin/env bash\nexit {code}\n")
    assert run(script, cwd=tmp_path, **slurm, **ARRAY, PREEMPTED=preempted).returncode == returned
    log = tmp_path / "scontrol.log"
    assert ("requeue 4711\n" in (log.read_text() if log.exists() else "")) == requeued


@pytest.fixture
def generating(backend, slurm, tmp_path):
    """The environment of one generating task, with an interpreter that has the solver's stand-in for the solver."""
    write_program(
        tmp_path / "programs" / "interpreter",
        f'#!/usr/bin/env bash\n[[ "$1 $2" == "-m datagen" ]] && {sys.executable} -m ballistic_command "${{@:3}}"\n',
    )
    variables = {"SLURM_NTASKS": "1", "EXPERIMENT": "small", "PYTHON": "interpreter", "PYTHONPATH": BALLISTIC_PATH}
    return slurm | variables


def generate(script, tmp_path, variables):
    sizes = ["scenes=5", "dataset.validation_scenes=1", "dataset.test_scenes=1", "dataset.frames=5"]
    arguments = [*sizes, "dataset.workers=1", f"out={tmp_path / 'data'}"]
    done = run(script, *arguments, cwd=tmp_path, **variables)
    assert done.returncode == 0, done.stderr[-4000:]
    return Manifest.load(tmp_path / "data")


def test_slurm_generates(generating, tmp_path):
    """jobs/slurm/generate.sbatch makes the whole data set that its experiment and arguments ask for."""
    manifest = generate("slurm/generate.sbatch", tmp_path, generating)
    assert manifest.complete and manifest.published("train") == 5
    assert not (tmp_path / "scontrol.log").exists()


def test_array_generates(generating, tmp_path):
    """Tasks of jobs/slurm/generate_array.sbatch make one data set between them, each shard once."""
    for task in ("1", "0"):
        variables = generating | ARRAY | {"SLURM_ARRAY_TASK_ID": task}
        manifest = generate("slurm/generate_array.sbatch", tmp_path, variables)
        assert manifest.complete is (task == "0")
    names = [shard.name for shard in manifest.shards]
    assert len(names) == len(set(names)) and manifest.published("train") == 5


def test_array_with_gaps_is_refused(slurm, tmp_path):
    """Tasks that are missing would leave their shards unmade for ever."""
    variables = slurm | ARRAY | {"SLURM_ARRAY_TASK_MIN": "1", "SLURM_ARRAY_TASK_MAX": "2"}
    done = run("slurm/generate_array.sbatch", cwd=tmp_path, **variables)
    assert done.returncode == 2 and "--array must be 0-N without gaps, got 2 tasks from 1 to 2;" in done.stderr
