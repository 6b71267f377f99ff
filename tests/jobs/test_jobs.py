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
from processes import completed, free_port, wait_until, write_program
from training.runs import metrics, train_arguments

from datagen.generate import datagen_config
from hgn.training.checkpoint import read_checkpoint

ROOT = Path(__file__).resolve().parents[2]
JOBS = ROOT / "jobs"
SCRIPTS = sorted([*JOBS.rglob("*.sh"), *JOBS.rglob("*.sbatch")])
# the second of two array tasks
ARRAY = {f"SLURM_ARRAY_TASK_{name}": value for name, value in (("ID", "1"), ("COUNT", "2"), ("MIN", "0"), ("MAX", "1"))}
SHORT = {"maximum_updates": 4, "batch_scenes": 1, "log_every": 2, "monitor_every": 4, "monitor_rollout_frames": 0}
SHOWN = '#!/usr/bin/env bash\nenv | grep ^TORCH | sort\nprintf "%s\\n" "$@"\n'  # an interpreter that prints its call

STAND_INS = {
    # starts one process for each task of one node, and returns the highest exit code
    "srun": """#!/usr/bin/env bash
while [[ $1 == --* ]]; do shift; done
[[ $SRUN_CPUS_PER_TASK == "$SLURM_CPUS_PER_TASK" ]] || exit 99 # srun does not take it from sbatch
pids=()
for ((task = 0; task < SLURM_NTASKS; task++)); do
    SLURM_STEP_ID=0 SLURM_PROCID=$task SLURM_LOCALID=$task SLURM_NODEID=0 "$@" &
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
""",
    "scontrol": """#!/usr/bin/env bash
echo "$@" >> "$SLURM_FAKE/scontrol.log"
if [[ $1 == show ]]; then [[ $2 == hostnames ]] && echo localhost || echo "PreemptTime=${PREEMPTED:-None}"; fi
""",
    # hands a signal to the tasks of the job's steps
    "scancel": """#!/usr/bin/env bash
[[ $1 == --signal=* && $2 == "$SLURM_JOB_ID" ]] && xargs kill "-${1#--signal=}" < "$SLURM_FAKE/pids"
""",
}


def start(script, *arguments, cwd, **variables):
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("SLURM_", "TORCH"))}
    environment = kept | {"PYTHON": sys.executable, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | variables
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(["bash", str(JOBS / script), *arguments], cwd=cwd, env=environment, **pipes)


def run(script, *arguments, cwd, **variables):
    return completed(start(script, *arguments, cwd=cwd, **variables))


@pytest.fixture
def slurm(tmp_path):
    """The environment of a Slurm job on one node with two tasks, with stand-ins for srun, scontrol and scancel."""
    programs = tmp_path / "programs"
    for name, text in STAND_INS.items():
        write_program(programs / name, text)
    values = {"JOB_ID": "4711", "JOB_NAME": "hgn-train", "FAKE": str(tmp_path), "NNODES": "1", "JOB_NUM_NODES": "1"}
    values |= {"CPUS_PER_TASK": "2", "NTASKS": "2", "NTASKS_PER_NODE": "2", "GPUS_ON_NODE": "2"}
    values |= {"NODELIST": "localhost", "JOB_NODELIST": "localhost"}
    address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    return {f"SLURM_{k}": v for k, v in values.items()} | address | {"PATH": f"{programs}:{os.environ['PATH']}"}


@pytest.fixture
def warm(warm_python):
    """The environment in which scripts, torchrun among them, start trainings that need not load anything."""
    return {"PYTHON": str(warm_python), "PYTHON_EXEC": str(warm_python)}


def test_files_are_valid():
    """Shellcheck finds no fault in the scripts, and all are executable. The table names every launch file, and no
    others. sbatch reads its options only before the first command. Training jobs have one task for each GPU."""
    shellcheck = [str(Path(sysconfig.get_path("scripts")) / "shellcheck"), "--shell", "bash"]
    checked = subprocess.run([*shellcheck, *map(str, SCRIPTS)], capture_output=True, text=True)
    assert checked.returncode == 0, checked.stdout
    assert all(os.access(script, os.X_OK) for script in SCRIPTS)
    named = set(re.findall(r"`(?:[\w. -]+ )?(jobs/[\w/]+\.\w+)", (JOBS / "README.md").read_text()))
    there = [*SCRIPTS, *JOBS.glob("*/*.yaml"), *JOBS.glob("*/*.def"), *JOBS.glob("*.txt")]
    assert named == {str(path.relative_to(ROOT)) for path in there}
    for script in SCRIPTS:
        lines = script.read_text().splitlines()
        first_command = next(i for i, line in enumerate(lines) if line and not line.startswith("#"))
        options = [line.removeprefix("#SBATCH ") for line in lines[:first_command] if line.startswith("#SBATCH ")]
        assert sum(line.startswith("#SBATCH") for line in lines) == len(options)
        assert bool(options) == (script.suffix == ".sbatch")
        assert all(re.fullmatch(r"--[a-z-]+(=\S+)?", option) for option in options)
        values = dict(option.removeprefix("--").partition("=")[::2] for option in options)
        tasks = values.get("gpus-per-node", "1") if script.name == "train.sbatch" else "1"
        assert values.get("ntasks-per-node", "1") == tasks


def test_skypilot_and_apptainer():
    """SkyPilot's task has keys of its schema (sky/utils/schemas.py in skypilot-org/skypilot), and starts torchrun.sh
    with variables that it reads; Apptainer's definition has sections of the user guide, and copies what docker does."""
    task = yaml.safe_load((JOBS / "skypilot/train.yaml").read_text())
    assert list(task) == ["name", "workdir", "num_nodes", "resources", "envs", "file_mounts", "setup", "run"]
    assert set(task["resources"]) <= {"accelerators", "cpus", "memory", "use_spot", "job_recovery"}
    assert task["file_mounts"] == {"/shared": {"name": "hgn-shared", "mode": "MOUNT_CACHED"}}
    variables = set(re.findall(r"\$(\w+)", task["run"])) - set(task["envs"])
    assert variables == {"SKYPILOT_NUM_NODES", "SKYPILOT_NUM_GPUS_PER_NODE", "SKYPILOT_NODE_IPS"}
    read = set(re.findall(r"^# ([A-Z_]+) ", (JOBS / "torchrun.sh").read_text(), re.MULTILINE))
    assert {*re.findall(r"([A-Z]+)=", task["run"]), *task["envs"]} <= read

    header, *parts = re.split(r"^%(\w+)\n", (JOBS / "slurm/hgn.def").read_text(), flags=re.MULTILINE)
    docker, copied = (JOBS / "k8s/Dockerfile").read_text(), (JOBS / "k8s/Dockerfile.dockerignore").read_text()
    base = re.findall(r"^FROM (.*)", docker, re.MULTILINE)
    assert re.findall(r"^[^#\s].*", header, re.MULTILINE) == ["Bootstrap: docker", *(f"From: {name}" for name in base)]
    sections = dict(zip(parts[::2], parts[1::2], strict=True))
    files = [line.split()[0] for line in sections.pop("files").strip().splitlines()]
    assert files == re.findall(r"^!(\S+)", copied, re.MULTILINE)
    assert list(sections) == ["post", "environment", "runscript", "test"]
    for text in (task["setup"], task["run"], *sections.values()):
        shellcheck = [str(Path(sysconfig.get_path("scripts")) / "shellcheck"), "--shell", "sh", "-"]
        assert subprocess.run(shellcheck, input=text, text=True).returncode == 0


@pytest.mark.parametrize(
    ("script", "variables", "message"),
    [
        ("torchrun.sh", {"GPUS": "all"}, "GPUS must be a whole number of at least 1, got 'all'\n"),
        ("torchrun.sh", {"NODES": "0"}, "NODES must be a whole number of at least 1, or two as in 1:4, got '0'\n"),
        ("torchrun.sh", {"NODES": "1:"}, "NODES must be a whole number of at least 1, or two as in 1:4, got '1:'\n"),
        ("torchrun.sh", {"NODES": "2"}, "RENDEZVOUS must be host:port of one of the 2 machines, got nothing; as in"),
        ("torchrun.sh", {"NODES": "1:2"}, "RENDEZVOUS must be host:port of one of the 1:2 machines, got nothing; as"),
        ("torchrun.sh", {"RESTARTS": "-1"}, "RESTARTS must be a whole number, got '-1'\n"),
        (
            *("slurm/generate_array.sbatch", ARRAY | {"SLURM_ARRAY_TASK_MIN": "1", "SLURM_ARRAY_TASK_MAX": "2"}),
            "--array must be 0-N without gaps, got 2 tasks from 1 to 2;",
        ),
    ],
)
def test_variables_are_refused(slurm, tmp_path, script, variables, message):
    """Variables that make no sense are named before anything starts."""
    done = run(script, cwd=tmp_path, **slurm, **variables)
    assert done.returncode == 2 and done.stderr.startswith(f"error: {message}") and done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("variables", "told"),
    [
        ({"NODES": "3", "GPUS": "4", "RENDEZVOUS": "node0:1", "EXPERIMENT": "small"}, "3 4 3 node0:1 small small 1"),
        ({"HGN_RUN": "mine", "RESTARTS": "0"}, "1 1 0 localhost:0 mine obstacles "),
    ],
)
def test_torchrun_is_told(tmp_path, variables, told):
    """torchrun is told how many processes there are, where they meet and what the run is called, on several machines
    or one; the training follows it. Several processes have a thread each, without torchrun's warning."""
    write_program(tmp_path / "shown", SHOWN.replace("^TORCH", "-e ^TORCH -e ^OMP_NUM"))
    nodes, gpus, restarts, place, name, experiment, threads = told.split(" ")
    variables |= {"PYTHON": str(tmp_path / "shown"), "OMP_NUM_THREADS": ""}
    done = run("torchrun.sh", "run=here and there", cwd=tmp_path, **variables)
    assert done.stdout.splitlines() == [
        f"OMP_NUM_THREADS={threads}",
        "TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1",
        "TORCH_ELASTIC_SHUTDOWN_TIMEOUT=120",
        *("-m", "torch.distributed.run", "--nnodes", nodes, "--nproc-per-node", gpus, "--max-restarts", restarts),
        *("--rdzv-backend", "c10d", "--rdzv-endpoint", place, "--rdzv-id", name),
        *("--signals-to-handle", "SIGTERM,SIGINT,SIGHUP,SIGQUIT,SIGUSR1"),
        *("-m", "hgn.train", f"+experiment={experiment}", "run=here and there"),
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
    """jobs/slurm/train_torchrun.sbatch starts jobs/torchrun.sh on a node, and that one training of two processes. At
    the time limit the training ends with a checkpoint and the job is queued again; started again, it goes on in the
    same folder, named after the job."""
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
    assert updates > 0 and updates % 4 == 0  # ranks agree at each measured update

    last = f"training.maximum_updates={updates + 2}"
    done = run("slurm/train_torchrun.sbatch", *arguments, last, cwd=tmp_path, **slurm)
    assert done.returncode == 0, done.stderr[-4000:]
    assert done.stdout.count(f"trained {updates + 2} of {updates + 2} updates in runs/small-4711") == 1
    assert not (tmp_path / "scontrol.log").read_text().count("requeue") > 1
    assert [record["update"] for record in metrics(folder) if "loss" in record][-1] == updates + 2
    stored = yaml.safe_load((folder / "config.yaml").read_text())
    assert stored["training"]["devices"] is None  # torchrun sets the number of processes


# script, PreemptTime, exit code of its step: its own, with 0 for a job that is queued again after a step that failed
ENDS = [
    ("train", "None", {138: 0, 143: 143, 2: 2}),
    ("train_torchrun", "None", {1: 1, 0: 0}),
    ("generate_array", "None", {130: 0, 2: 2}),
    ("generate", "None", {130: 0, 143: 143, 0: 0}),
    ("train", "2026-01-01T00:00:00", {143: 0, 2: 2}),
    ("train_torchrun", "2026-01-01T00:00:00", {1: 0}),
    ("generate", "2026-01-01T00:00:00", {143: 0}),
    ("generate_array", "2026-01-01T00:00:00", {143: 0}),
]


@pytest.mark.parametrize(("script", "preempted", "codes"), ENDS)
def test_time_limit(slurm, tmp_path, script, preempted, codes):
    """Stopped by the signal before the time limit, or told to make room, a job is queued again; cancelled or failed, it
    is not."""
    log = tmp_path / "scontrol.log"
    for code, returned in codes.items():
        write_program(tmp_path / "programs" / "srun", f"#!/usr/bin/env bash\nexit {code}\n")
        log.write_text("")
        done = run(f"slurm/{script}.sbatch", cwd=tmp_path, **slurm, **ARRAY, PREEMPTED=preempted)
        assert done.returncode == returned
        assert ("requeue 4711\n" in log.read_text()) == (code != 0 and returned == 0)


@pytest.mark.parametrize("script", ["generate", "generate_array"])
def test_slurm_generates(slurm, tmp_path, script, composed):
    """A job starts one generator with its experiment, its arguments, and its place in the array where it is one."""
    write_program(tmp_path / "shown", SHOWN)
    variables = slurm | ARRAY | {"SLURM_NTASKS": "1", "EXPERIMENT": "small", "PYTHON": str(tmp_path / "shown")}
    done = run(f"slurm/{script}.sbatch", "scenes=5", "out=here and there", cwd=tmp_path, **variables)
    assert done.returncode == 0 and not (tmp_path / "scontrol.log").exists(), done.stderr
    module, *arguments = done.stdout.splitlines()[1:]
    assert module == "datagen" and arguments[0] == "+experiment=small"
    made = datagen_config(composed("datagen", arguments)).dataset
    assert (made.training_scenes, made.folder) == (5, "here and there")
    assert (made.array_task, made.array_tasks) == ((1, 2) if script == "generate_array" else (None, None))
