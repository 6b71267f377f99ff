"""Training on several processes: the same gradients, the same weights, one run folder, one decision to stop."""

import dataclasses
import json
import os
import pickle
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from processes import PATIENCE_S, answers, free_port, wait_until
from training.runs import metrics, train_mapping

from hgn import train
from hgn.config import TrainingConfig
from hgn.data.sampler import EpisodeSampler
from hgn.schema import ConfigError
from hgn.system.ranks import first_rank
from hgn.training import watch as watch_ranks
from hgn.training.checkpoint import read_checkpoint
from hgn.training.distributed import checksum, default_run, layout
from hgn.training.torch_updates import TorchUpdates

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = Path(__file__).with_name("ddp_program.py")
ADAM_BETA_1 = 0.9
# values for one process of variables that mpirun, jsrun, prun and flux set
ALONE = dict.fromkeys(("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "JSM_NAMESPACE_SIZE", "FLUX_JOB_SIZE"), "1")
ALONE |= dict.fromkeys(("OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK", "FLUX_TASK_RANK"), "0")
LAUNCHER_VARIABLES = (
    *("HGN_RUN", "RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "NODE_RANK", "TORCHELASTIC_RUN_ID"),
    *("TORCHELASTIC_USE_AGENT_STORE", "TORCHELASTIC_MAX_RESTARTS", "TORCH_DISABLE_SHARE_RDZV_TCP_STORE"),
    *(f"SLURM_{name}" for name in ("PROCID", "NTASKS", "NNODES", "JOB_NAME", "JOB_ID", "STEP_ID", "STEP_NUM_TASKS")),
    *ALONE,
)


def torchrun(folder, *options, python, prefix=(), **variables):
    """Starts torchrun on ddp_program.py, CPU processes that talk through gloo."""
    return subprocess.Popen(
        [*prefix, str(python), "-m", "torch.distributed.run", *options, str(PROGRAM), str(folder)],
        cwd=folder,
        env=os.environ
        | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}
        | {"PYTHON_EXEC": str(python)}
        | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def output(process):
    """Returns the output of a process up to its end, which must come within a time limit."""
    try:
        return process.communicate(timeout=PATIENCE_S)[0]
    except subprocess.TimeoutExpired:
        process.terminate()
        raise AssertionError(process.communicate(timeout=PATIENCE_S)[0][-4000:]) from None


def load(path):
    return torch.load(path, weights_only=True)


@dataclasses.dataclass(frozen=True)
class Reference:
    """The data set, the first gradients of one rank with two scenes, and a folder for a training of two ranks."""

    mapping: Callable[[Path], dict[str, Any]]
    gradients: dict[str, torch.Tensor]

    def folder(self, path, faults):
        """Returns a folder for ddp_program.py: 40 updates of two ranks with a scene each, and their faults."""
        path.mkdir()
        (path / "mapping.json").write_text(json.dumps(self.mapping(path)))
        (path / "faults.json").write_text(json.dumps(faults))
        (path / "watch.json").write_text("{}")  # short intervals between counts: a rank waits three for a killed one
        return path

    def check(self, folder, exit_code):
        """Checks that the gradients of both ranks equal those of one rank with both scenes, to 1e-6, and that both
        ended at update 20 with the checkpoint's parameters and one run folder. In updates without log (every 4),
        checkpoint (5), agreement (10) or new epoch, ranks exchange only gradients. Returns the parameters."""
        gradients = [load(folder / f"gradients_{rank}.pt") for rank in (0, 1)]
        assert gradients[0].keys() == gradients[1].keys() == self.gradients.keys()
        for name, expected in self.gradients.items():
            assert torch.equal(gradients[0][name], gradients[1][name]), name
            difference = float((gradients[0][name] - expected).abs().max())
            assert difference <= 1e-6 * max(1.0, float(expected.abs().max())), name
        ends = [load(folder / f"end_{rank}.pt") for rank in (0, 1)]
        assert [end["update"] for end in ends] == [20, 20]  # ranks agree at every tenth update
        assert [end["exit_code"] for end in ends] == [exit_code] * 2
        stored = read_checkpoint(folder / "run" / "checkpoints" / "last.ckpt")
        assert stored["hgn"]["updates"] == 20
        sampler_state = stored["hgn"]["sampler_state"]
        samples = 25 * sampler_state["epoch"] + sampler_state["position"]  # of 5 episodes with 5 steps
        assert samples == 2 * 20  # two an update
        for name, tensor in stored["state_dict"].items():
            assert torch.equal(ends[0]["weights"][name], tensor), name
            assert torch.equal(ends[1]["weights"][name], tensor), name
        for rank in (0, 1):
            talked = set(json.loads((folder / f"talk_{rank}.json").read_text()))
            assert {8, 20} & talked and not {2, 3, 6, 7, 17, 18, 19} & talked
        made = {path.name for path in folder.iterdir() if path.suffix not in (".json", ".pt")}
        assert made == {"run", "starts_0", "starts_1"}
        return stored["state_dict"]


@pytest.fixture
def reference(data, tmp_path):
    changes: dict[str, Any] = {"monitor_rollout_frames": 0, "monitor_every": 1000}
    run = tmp_path / "one"
    assert train.main(train_mapping(data, run, **changes, maximum_updates=1, batch_scenes=2)) == 0
    alone = read_checkpoint(run / "checkpoints" / "last.ckpt")
    # Adam's first moment after one update is (1 - beta_1) times the gradient
    moments = alone["optimizer_states"][0]["state"]
    names = [name for name in alone["state_dict"] if "normaliser" not in name]
    assert len(moments) == len(names)
    gradients = {name: moments[index]["exp_avg"] / (1 - ADAM_BETA_1) for index, name in enumerate(names)}
    assert max(float(gradient.abs().max()) for gradient in gradients.values()) > 0.1
    two = changes | {"maximum_updates": 40, "batch_scenes": 1}
    return Reference(lambda folder: train_mapping(data, folder / "run", **two), gradients)


def test_two_ranks_train_as_one(reference, warm_python, tmp_path):
    """Two ranks with a scene each have the gradients of one with both (to 1e-6); their weights stay bitwise equal;
    SIGTERM to one of them ends both at the same update, with a checkpoint and the same exit code. A `kill -9` of a rank
    instead restarts both from the last checkpoint, SIGTERM to torchrun then ends all ranks in order, and the weights
    are bitwise the same. A training goes on from there on one rank, where it left the order."""
    one_machine = ("--nnodes", "1", "--nproc-per-node", "2", "--rdzv-backend", "c10d", "--rdzv-endpoint", "localhost:0")
    cut = reference.folder(tmp_path / "cut", [(0, 1, 13, signal.SIGTERM, "self")])
    assert "exitcode  : 143" in output(torchrun(cut, *one_machine, python=warm_python))
    weights = reference.check(cut, 128 + signal.SIGTERM)
    assert (cut / "starts_0").read_text() == "0\n"
    assert len(list((cut / "run" / "tensorboard").glob("events.*"))) == 1
    updates = [record["update"] for record in metrics(cut / "run") if "loss" in record]
    assert updates == [4, 8, 12, 16, 20]  # one line each: rank 0 alone writes

    faults = [(0, 1, 13, signal.SIGKILL, "self"), (1, 0, 16, signal.SIGTERM, "launcher")]
    killed = reference.folder(tmp_path / "killed", faults)
    process = torchrun(killed, *one_machine, "--max-restarts", "1", python=warm_python)
    text = output(process)
    assert process.returncode != 0 and "signal" in text.lower()
    assert (killed / "starts_1").read_text() == "0\n10\n", text  # a checkpoint at every fifth update
    for name, tensor in reference.check(killed, 128 + signal.SIGTERM).items():
        assert torch.equal(tensor, weights[name]), name

    alone = reference.mapping(cut)
    alone["training"] |= {"devices": 1, "batch_scenes": 1}
    seen: list[tuple[int, ...]] = []
    with pytest.MonkeyPatch.context() as patch:
        original = TorchUpdates.run
        patch.setattr(TorchUpdates, "run", lambda u, c, n: (seen.append(c.batch.seeds_S), original(u, c, n))[1])
        assert train.main(alone) == 0
    order = EpisodeSampler(alone["training"].get("seed", 0), 2, lambda _: [6] * 5)
    for _ in range(20):
        order.next_batch()
    rest = EpisodeSampler(order.seed, 1, lambda _: [6] * 5, order.state)
    assert seen == [tuple(sample.seed for sample in rest.next_batch()) for _ in range(20)]


@pytest.fixture
def two_machines():
    """Two network namespaces joined by a cable: their names and the address of the first."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and ip")
    first, second = f"hgn-a-{os.getpid()}", f"hgn-b-{os.getpid()}"
    if subprocess.run(["ip", "netns", "add", first], capture_output=True).returncode:
        pytest.skip("this machine allows no network namespaces")

    def ip(*arguments):
        subprocess.run(["ip", *arguments], check=True, capture_output=True)

    try:
        ip("netns", "add", second)
        ip("-n", first, "link", "add", "cable", "type", "veth", "peer", "name", "cable", "netns", second)
        for name, address in ((first, "10.213.7.1/24"), (second, "10.213.7.2/24")):
            ip("-n", name, "addr", "add", address, "dev", "cable")
            ip("-n", name, "link", "set", "cable", "up")
            ip("-n", name, "link", "set", "lo", "up")
        yield first, second, "10.213.7.1"
    finally:
        for name in (first, second):
            subprocess.run(["ip", "netns", "del", name], capture_output=True)


def test_two_machines_train_as_one(reference, two_machines, warm_python, tmp_path):
    """Two machines (network namespaces) under torchrun have the gradients of one process and equal weights after 20
    updates; SIGUSR1 to one rank of one machine ends both, with a checkpoint."""
    folder = reference.folder(tmp_path / "two", [(0, 1, 11, signal.SIGUSR1, "self")])
    *machines, address = two_machines
    processes = [
        torchrun(
            folder,
            *("--nnodes", "2", "--nproc-per-node", "1", "--rdzv-backend", "c10d", "--rdzv-id", "two"),
            *("--rdzv-endpoint", f"{address}:29500", "--rdzv-conf", f"is_host={int(number == 0)}"),
            *("--local-addr", f"10.213.7.{number + 1}"),
            python=warm_python,
            prefix=("ip", "netns", "exec", machine),
            GLOO_SOCKET_IFNAME="cable",
        )
        for number, machine in enumerate(machines)
    ]
    texts = [output(process) for process in processes]
    assert all(process.returncode != 0 for process in processes)
    assert any("exitcode  : 138" in text for text in texts), texts
    reference.check(folder, 128 + signal.SIGUSR1)


@pytest.fixture
def no_launcher(monkeypatch):
    for name in LAUNCHER_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


ADDRESS = {"MASTER_ADDR": "a", "MASTER_PORT": "1"}  # where nobody listens: no rank meets another
TORCHRUN = {"RANK": "0", "LOCAL_RANK": "0", "WORLD_SIZE": "4"}
SLURM = {"SLURM_STEP_ID": "0", "SLURM_PROCID": "0", "SLURM_NTASKS": "8", "SLURM_NNODES": "2"}
JOB = {"SLURM_JOB_ID": "4711"}
COUNTS = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE", "SLURM_NTASKS", "SLURM_NNODES")
BOTH = {"SLURM_PROCID": "1", "SLURM_NTASKS": "2", "RANK": "3", "LOCAL_RANK": "1", "WORLD_SIZE": "4"}
RANDOM_ID = "5bd6a8f0-93a5-4c5b-9b8c-0a52b6cf3d11"
NO_RESTARTS = (("MAX_RESTARTS", "0"), ("USE_AGENT_STORE", "False"))
RESTARTS = {"TORCHELASTIC_USE_AGENT_STORE": "True", "TORCHELASTIC_MAX_RESTARTS": "3"}
OTHERS = "devices must be {}, the processes that the launcher started on each of {} machines"


@pytest.mark.parametrize(
    ("variables", "first", "started", "folder"),
    [  # whether it leads, devices and nodes that the launcher started, the folder's name
        ({}, True, (1, 1), "runs/small"),
        *((TORCHRUN | {"WORLD_SIZE": f"{n}"}, True, (n, 1), "runs/small") for n in (3, 4)),
        ({"RANK": "5", "LOCAL_RANK": "0", "WORLD_SIZE": "6", "LOCAL_WORLD_SIZE": "2"}, False, (2, 3), "runs/small"),
        ({"RANK": "0", "WORLD_SIZE": "1"}, True, (1, 1), "runs/small"),  # of a container
        ({"SLURM_STEP_ID": "0", "SLURM_PROCID": "0", "SLURM_NTASKS": "4"}, True, (4, 1), "runs/small"),
        (SLURM | JOB, True, (4, 2), "runs/small-4711"),
        (SLURM | JOB | {"SLURM_PROCID": "7"}, False, (4, 2), "runs/small-4711"),
        *((SLURM | {"SLURM_JOB_NAME": name}, True, (1, 1), "runs/small") for name in ("bash", "interactive")),
        (JOB | {"SLURM_NTASKS": "4"}, True, (1, 1), "runs/small"),  # a shell or a script inside a job, without srun
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "1"}, True, (1, 1), "runs/small"),  # a batch job of one task
        (BOTH | JOB | {"LOCAL_WORLD_SIZE": "2"}, False, (2, 2), "runs/small"),  # torchrun inside srun
        (BOTH | {"RANK": "0", "TORCHELASTIC_RUN_ID": "a", "SLURM_JOB_ID": "1"}, True, (4, 1), "runs/a"),
        *(({rank: "1", "WORLD_SIZE": "2"}, False, (1, 1), "runs/small") for rank in ("LOCAL_RANK", "NODE_RANK")),
        (TORCHRUN | {"TORCHELASTIC_RUN_ID": "none"}, True, (4, 1), "runs/small"),
        ({"TORCHELASTIC_RUN_ID": "night/one two"}, True, (1, 1), "runs/night-one-two"),
        ({"TORCHELASTIC_RUN_ID": RANDOM_ID}, True, (1, 1), "runs/small"),
        (SLURM | JOB | {"HGN_RUN": "mine", "TORCHELASTIC_RUN_ID": "a"}, True, (4, 2), "runs/mine"),
        ({"HGN_RUN": "/shared/mine"}, True, (1, 1), "/shared/mine"),
        *((RESTARTS | {f"TORCHELASTIC_{name}": none}, True, (1, 1), "runs/small") for name, none in NO_RESTARTS),
    ],
)
def test_what_a_launcher_says(no_launcher, variables, first, started, folder):
    """Exactly the process of global rank 0 leads. Devices and nodes that the configuration leaves open are those that
    the launcher started. All processes of a job, and its restarts, agree on the folder, and two jobs get two: our own
    variable comes first, then torchrun's id (unless it is random, as --standalone makes it), then Slurm's."""
    for name, value in (ADDRESS | variables).items():
        no_launcher.setenv(name, value)
    assert (first_rank(), layout(TrainingConfig(device="cpu")), str(default_run("small"))) == (first, started, folder)


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        (ALONE, (2, 1)),
        (TORCHRUN | dict.fromkeys(ALONE, "4"), (2, 2)),
        (TORCHRUN | {"WORLD_SIZE": "3"}, OTHERS.format(3, 1)),
        (TORCHRUN | {"LOCAL_WORLD_SIZE": "4"}, OTHERS.format(4, 1)),
        ({"SLURM_STEP_ID": "0", "SLURM_PROCID": "0", "SLURM_NTASKS": "4", "PMI_SIZE": "4"}, (2, 2)),
        (SLURM, OTHERS.format(4, 2)),
        (SLURM | {"SLURM_JOB_NAME": "bash"}, (2, 1)),
        (BOTH, (2, 2)),
        ({"RANK": "0", "WORLD_SIZE": "2"}, "LOCAL_RANK must be set with RANK, got only RANK=0"),
        ({"RANK": "3", "WORLD_SIZE": "4", "LOCAL_WORLD_SIZE": "2"}, "LOCAL_RANK must be set with RANK"),
        ({"RANK": "1"}, "WORLD_SIZE and LOCAL_RANK must be set with RANK"),
        (TORCHRUN | {"MASTER_PORT": ""}, "MASTER_PORT must be set with RANK"),
        *((SLURM | {name: text}, f"{name} must be a whole number") for name in COUNTS for text in ("", "-1", "x")),
        ({"RANK": "1", "LOCAL_RANK": "1"}, "WORLD_SIZE must be set with RANK"),
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "4"}, "must be started with srun in a job of 4 tasks"),
        ({**SLURM, "SLURM_STEP_NUM_TASKS": "1"}, "must be started with srun in a job of 8 tasks"),
        *(({name: "4"}, f"{name} must be {alone} .*, got '4'; start with torchrun") for name, alone in ALONE.items()),
        *(({name: "1"}, f"{name} must be 0 without WORLD_SIZE, got '1'") for name in ("LOCAL_RANK", "NODE_RANK")),
        (SLURM | {"SLURM_NNODES": "3"}, "SLURM_NTASKS must be a multiple of the 3 nodes, got 8"),
        (RESTARTS, r"STORE must be 1 in torchrun's environment .*--max-restarts 3\), got nothing"),
    ],
)
def test_launcher_and_configuration_agree(no_launcher, variables, expected):
    """With two devices asked for, a launcher that started another number on a machine is refused, and so are variables
    without their launcher, for whose other processes it would wait, and restarts that would hang."""
    for name, value in (ADDRESS | variables).items():
        no_launcher.setenv(name, value)
    training = TrainingConfig(device="cpu", devices=2)
    if isinstance(expected, tuple):
        assert layout(training) == expected
        return
    with pytest.raises(ConfigError, match=expected):
        layout(training)


def test_devices_that_are_not_there(no_launcher):
    """By default all GPUs are used. More GPUs than there are, or a GPU on a machine without one, are refused."""
    for gpus in (0, 4):
        no_launcher.setattr(torch.cuda, "is_available", lambda gpus=gpus: gpus > 0)
        no_launcher.setattr(torch.cuda, "device_count", lambda gpus=gpus: gpus)
        assert layout(TrainingConfig()) == (max(gpus, 1), 1)
        assert layout(TrainingConfig(devices=3)) == (3, 1)
        assert layout(TrainingConfig(device="cpu")) == (1, 1)
    with pytest.raises(ConfigError, match=r"training\.devices must be at most the 4 GPUs of this machine, got 5"):
        layout(TrainingConfig(devices=5))
    no_launcher.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"training\.device must be auto or cpu without a GPU, got 'cuda'"):
        layout(TrainingConfig(device="cuda"))


def test_checksum():
    """Any one other bit, anywhere, is another number; so are two values that change places."""
    tensors = [torch.arange(6.0).view(2, 3), torch.full((4,), -0.5)]
    found = {int(checksum(tensors))}
    for tensor in tensors:
        for place in range(tensor.numel()):
            for bit in (0, 22, 30, 31):
                bits = tensor.view(torch.int32).view(-1)
                bits[place] ^= -(2**31) if bit == 31 else 2**bit
                found.add(int(checksum(tensors)))
                bits[place] ^= -(2**31) if bit == 31 else 2**bit
    assert len(found) == 1 + 4 * 10
    assert int(checksum([tensors[0].T.contiguous()])) != int(checksum(tensors[:1]))


GPUS = (pytest.mark.multigpu, pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices"))


DIFFERENT = "weights must be the same on all ranks, got others at"


@pytest.mark.parametrize(
    ("device", "faults", "watch", "code", "message"),
    [
        ("cpu", [(0, 1, 3, "weights", "self")], {}, None, DIFFERENT),
        *(("cpu", [(0, rank, 3, "storage", "self")], {}, None, "the data stay away") for rank in (0, 1)),
        ("cpu", [(0, 1, 3, signal.SIGKILL, "self")], {}, 1, "ranks [1] ended without a message"),
        ("cpu", [(0, 1, 3, signal.SIGSTOP, "self")], {"SILENCE_S": 3.0}, 1, "ranks [1] must answer within 3 s"),
        (
            "cpu",
            [(0, 1, 3, signal.SIGTERM, "launcher"), (0, 1, 4, signal.SIGSTOP, "self")],
            {"GRACE_S": 1.0},
            128 + signal.SIGTERM,
            "the other ranks must answer after SIGTERM",
        ),
        *(  # rank 1, a fork of the warm interpreter, outlives rank 0 until GRACE_S has passed
            pytest.param("cuda", [(0, rank, 3, fault, "self")], {"GRACE_S": 10.0}, None, message, marks=GPUS)
            for fault, message in (("error", "this rank fails"), ("weights", DIFFERENT))
            for rank in (0, 1)
        ),
    ],
)
def test_no_rank_waits_for_one_that_fails(
    data, no_launcher, warm_python, tmp_path, device, faults, watch, code, message
):
    """Two ranks of Lightning's own launcher end where one of them meets an error of its own; where one has other
    weights, which the next log line finds; where one misses its data, which saves first; and where one was stopped,
    after a while, or after SIGTERM to the other."""
    options: dict[str, Any] = {"device": device, "backend": "torch", "devices": 2, "maximum_updates": 10**6}
    (tmp_path / "mapping.json").write_text(json.dumps(train_mapping(data, tmp_path / "run", **options)))
    (tmp_path / "faults.json").write_text(json.dumps(faults))
    (tmp_path / "watch.json").write_text(json.dumps(watch))
    python = str(warm_python)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PYTHON_EXEC": python}
    with (tmp_path / "log").open("w") as log:  # which a rank that was stopped keeps open
        process = subprocess.Popen([python, PROGRAM, tmp_path], env=environment, stdout=log, stderr=log)
    try:
        process.wait(PATIENCE_S)
    finally:
        for stopped in tmp_path.glob("stopped_*"):
            os.kill(int(stopped.read_text()), signal.SIGKILL)
    text = (tmp_path / "log").read_text()
    assert message in text and (process.returncode == code if code is not None else process.returncode != 0)
    assert "Traceback" not in text or "without a message" not in message
    prefix = str(tmp_path / "run" / watch_ranks.TRACE)
    for rank in (0, 1):
        recorder = json.loads((tmp_path / f"recorder_{rank}.json").read_text())
        assert recorder["TORCH_FR_DUMP_TEMP_FILE"] == prefix and recorder["TORCH_NCCL_DUMP_ON_TIMEOUT"] == "1"
    traces = [path.name for path in (tmp_path / "run").glob(f"{watch_ranks.TRACE}*")]
    assert traces == (["hang_rank_0"] if "must answer" in message else [])
    for name in traces:
        names = [entry["profiling_name"] for entry in pickle.loads((tmp_path / "run" / name).read_bytes())["entries"]]
        assert len(names) > 3 and names[-1].startswith("gloo:")
    if "data" in message:
        assert read_checkpoint(tmp_path / "run/checkpoints/last.ckpt")["hgn"]["updates"] == 3


def test_variables_of_the_recorder_that_the_user_set_stay(monkeypatch, tmp_path):
    """Under their earlier names too."""
    names = ("TORCH_FR_BUFFER_SIZE", "TORCH_FR_DUMP_TEMP_FILE", "TORCH_NCCL_DUMP_ON_TIMEOUT")
    set_by_user = {"TORCH_NCCL_TRACE_BUFFER_SIZE": "7", "TORCH_NCCL_DEBUG_INFO_TEMP_FILE": "mine_"}
    monkeypatch.setattr(os, "environ", set_by_user | {"TORCH_NCCL_DUMP_ON_TIMEOUT": "0"})
    watch_ranks.record_collectives(tmp_path)
    assert os.environ == set_by_user | {"TORCH_NCCL_DUMP_ON_TIMEOUT": "0"}
    monkeypatch.setattr(os, "environ", {})
    watch_ranks.record_collectives(tmp_path)
    assert os.environ == dict(zip(names, ("2000", str(tmp_path / "hang_rank_"), "1"), strict=True))


def test_signals_before_ranks_have_met(data, no_launcher, warm_python, tmp_path):
    """A rank that waits for others ends on each signal that ends a training, without waiting for a time-out."""
    processes = []
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1):
        folder, port = tmp_path / number.name, free_port()
        folder.mkdir()
        options: dict[str, Any] = {"device": "cpu", "backend": "torch", "devices": 2}
        (folder / "mapping.json").write_text(json.dumps(train_mapping(data, folder / "run", **options)))
        (folder / "faults.json").write_text("[]")
        place = {
            "RANK": "0",
            "LOCAL_RANK": "0",
            "WORLD_SIZE": "2",
            "MASTER_ADDR": "127.0.0.1",
            "MASTER_PORT": str(port),
        }
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | place
        command = [str(warm_python), str(PROGRAM), str(folder)]
        processes.append((subprocess.Popen(command, env=environment), port, number))
    for process, port, number in processes:
        wait_until(lambda port=port: answers(port))
        process.send_signal(number)
    for process, _, number in processes:
        assert process.wait(PATIENCE_S) == -number


@pytest.mark.parametrize(("local_rank", "expected"), [("0", []), ("1", [signal.SIGKILL])])
def test_ranks_end_with_the_one_that_started_them(no_launcher, make_config, tmp_path, local_rank, expected):
    """Lightning's launcher leaves the other ranks waiting when the first one fails: the kernel ends them. The first
    one of a machine outlives its shell, as any command."""
    no_launcher.setenv("LOCAL_RANK", local_rank)
    asked: list[int] = []
    no_launcher.setattr(train, "die_with_parent", asked.append)

    def far_enough(training):
        raise ConfigError("far enough")

    no_launcher.setattr("hgn.training.distributed.layout", far_enough)
    with pytest.raises(ConfigError, match="far enough"):
        train.main(train_mapping(make_config(), tmp_path / "run"))
    assert asked == expected
