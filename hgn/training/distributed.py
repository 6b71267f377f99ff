"""The processes that train together, the run's folder, and the averaging of gradients.

Launchers set environment variables. torchrun sets RANK, WORLD_SIZE and LOCAL_WORLD_SIZE. srun sets SLURM_PROCID,
SLURM_NTASKS and SLURM_NNODES. Lightning's launcher sets LOCAL_RANK and NODE_RANK in a machine's other processes.
"""

import inspect
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from hgn.config import TrainingConfig
from hgn.schema import ConfigError, require

RUN_VARIABLE = "HGN_RUN"  # environment variable with the run's name or folder
MESSAGE_MB = 4  # size of a message: gradients of the last layers are sent while those of the first layers are computed
_RANKS = {"RANK": "WORLD_SIZE", "LOCAL_RANK": "LOCAL_WORLD_SIZE", "SLURM_PROCID": "SLURM_NTASKS"}
_COUNTS = (*_RANKS.values(), "SLURM_NNODES")
# variables of mpirun, jsrun, prun and flux, with their values for a single process; prun sets no count
_MPI_COUNTS = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MV2_COMM_WORLD_SIZE", "MPI_LOCALNRANKS", "JSM_NAMESPACE_SIZE")
_SINGLE = dict.fromkeys((*_MPI_COUNTS, "FLUX_JOB_SIZE"), "1")
_SINGLE |= dict.fromkeys(("OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK", "FLUX_TASK_RANK"), "0")
_RANDOM_ID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")


def default_run(name: str) -> Path:
    """Returns the run's default folder. It is the same in all processes and after every restart.

    The folder is in runs/. Its name is the first of these that is set: HGN_RUN (which may be a path), torchrun's run id
    (--rdzv-id), `name` with Slurm's job id (a requeued job keeps it), `name`. So each job gets its own folder.
    """
    torchrun_id = os.environ.get("TORCHELASTIC_RUN_ID", "none")  # torchrun sets "none" if no id was given
    if _RANDOM_ID.fullmatch(torchrun_id):
        torchrun_id = "none"  # torchrun --standalone draws an id at each start, so such a run could not be resumed
    if os.environ.get(RUN_VARIABLE):
        return Path("runs", os.environ[RUN_VARIABLE])
    if torchrun_id != "none":
        return Path("runs", re.sub(r"[^\w.-]+", "-", torchrun_id))
    if "RANK" not in os.environ and _inside_slurm_step() and "SLURM_JOB_ID" in os.environ:
        return Path("runs", f"{name}-{os.environ['SLURM_JOB_ID']}")
    return Path("runs", name)


def layout(training: TrainingConfig) -> tuple[int, int]:
    """Returns (processes on each machine, machines): as launched, else as configured, else all GPUs of this machine.

    Raises: ConfigError if this machine has fewer GPUs, or if the launcher started another number of processes.
    """
    _check_numbers()
    _check_restarts()
    _check_launcher()
    launched = _launched(training.devices)
    devices = _devices(training.device, training.devices or (launched and launched[0]))
    if launched is None:
        return devices, 1
    if devices != launched[0]:
        # each process would train on its own and overwrite the others' checkpoints, or wait forever
        raise ConfigError(
            f"training.devices must be {launched[0]}, the processes that the launcher started on each of {launched[1]} "
            f"machines, got {devices}; leave it out, and under Slurm start one task for each device with srun"
        )
    return launched


def averaging_options() -> dict[str, Any]:
    """Returns the arguments of DistributedDataParallel, which averages the gradients of backend torch.

    Gradients are sent in buckets while the backward pass still runs. Buffers are not sent, because the normaliser is
    constant and each rank has its own sum of losses.
    """
    from torch.nn.parallel import DistributedDataParallel

    # torch 2.13 renamed this argument
    renamed = "forward_sync_buffers" in inspect.signature(DistributedDataParallel).parameters
    keep_buffers = "forward_sync_buffers" if renamed else "broadcast_buffers"
    return {"gradient_as_bucket_view": True, "bucket_cap_mb": MESSAGE_MB, keep_buffers: False}


def sum_over_ranks(tensor: torch.Tensor) -> None:
    """Sums a tensor over all ranks in place. Backend triton sends the gradients of an update in one such message."""
    torch.distributed.all_reduce(tensor)


def checksum(tensors: Iterable[torch.Tensor]) -> torch.Tensor:
    """Returns a checksum of float32 tensors, int64 [] on their device. A change of any single value changes it."""
    bits = torch.cat([tensor.detach().flatten() for tensor in tensors]).view(torch.int32)
    # modulo 2^64 the product of a non-zero difference and an odd number is not 0
    return (bits * torch.arange(1, 2 * len(bits), 2, device=bits.device)).sum()


def same_on_all_ranks(number: torch.Tensor) -> bool:
    """Returns whether an int64 number is the same on all ranks, with one message of 16 bytes."""
    lowest = torch.stack([number, ~number])
    torch.distributed.all_reduce(lowest, torch.distributed.ReduceOp.MIN)
    low, high = lowest.tolist()
    return bool(low == ~high)


def _check_numbers() -> None:
    """Refuses launchers' variables that are not numbers, and ranks that do not exist."""
    for name in (*_RANKS, *_COUNTS):
        given, count = os.environ.get(name, "0" if name in _RANKS else "1"), os.environ.get(_RANKS.get(name, ""), "")
        least, most = int(name in _COUNTS), int(count) - 1 if count.isdecimal() else 1 << 30
        fits = given.isdecimal() and least <= int(given) <= most
        require(fits, name, f"a whole number from {least} to {most}", given, remedy="start with torchrun or srun")


def _check_restarts() -> None:
    shared = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    if shared and int(os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0")) > 0:
        # Restarted processes would read the addresses of processes that have ended, and wait for half an hour.
        name, restarts = "TORCH_DISABLE_SHARE_RDZV_TCP_STORE", os.environ["TORCHELASTIC_MAX_RESTARTS"]
        rule = f"1 in torchrun's environment if it may restart processes (--max-restarts {restarts})"
        raise ConfigError(f"{name} must be {rule}, got {os.environ.get(name, 'nothing')}; see pytorch issue 135712")


def _devices(device: str, wanted: int | None) -> int:
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    require(device != "cuda" or gpus > 0, "training.device", "auto or cpu without a GPU", "cuda")
    if device == "cpu" or gpus == 0:
        return wanted or 1
    wanted = wanted or gpus
    require(wanted <= gpus, "training.devices", f"at most the {gpus} GPUs of this machine", wanted)
    return wanted


def _launched(devices: int | None) -> tuple[int, int] | None:
    """Returns (processes on each machine, machines) of a launcher; None without a launcher.

    If the launcher reports only the total, each machine has `devices` processes; one machine has all of them if
    `devices` is None or does not divide the total.
    """
    here: int | None = None
    if "RANK" in os.environ and "WORLD_SIZE" in os.environ:
        processes = int(os.environ["WORLD_SIZE"])
        here = int(os.environ["LOCAL_WORLD_SIZE"]) if "LOCAL_WORLD_SIZE" in os.environ else devices
    elif started_by_srun():
        processes, nodes = int(os.environ["SLURM_NTASKS"]), int(os.environ.get("SLURM_NNODES", "1"))
        rule, remedy = f"a multiple of the {nodes} nodes", "start srun with --ntasks-per-node"
        require(processes % nodes == 0, "SLURM_NTASKS", rule, processes, remedy=remedy)
        here = processes // nodes if "SLURM_NNODES" in os.environ else devices
    else:
        return None
    if here is None or processes % here:
        here = processes
    return here, processes // here


def _check_launcher() -> None:
    """Refuses variables of a launcher that did not start this process. It would wait for other processes forever."""
    if "RANK" in os.environ:
        needed = ("WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")
        missing = [name for name in needed if not os.environ.get(name)]
        if missing and os.environ.get("WORLD_SIZE") != "1":
            raise ConfigError(
                f"{' and '.join(missing[:2])} must be set with RANK, got only RANK={os.environ['RANK']}; "
                "start with torchrun, or unset RANK for one process"
            )
    elif _inside_slurm_step() and not started_by_srun() and os.environ["SLURM_NTASKS"] != "1":
        raise ConfigError(
            f"training must be started with srun in a job of {os.environ['SLURM_NTASKS']} tasks, got one "
            "process without; for example srun python -m hgn.train, or sbatch --ntasks=1"
        )
    elif not started_by_srun():
        for name, single in _SINGLE.items():  # each process would train alone
            rule, number = f"{single} without torchrun's variables", os.environ.get(name, single)
            require(number == single, name, rule, number, remedy="start with torchrun or srun instead")
        for name in ("LOCAL_RANK", "NODE_RANK"):  # Lightning's launcher sets them with WORLD_SIZE
            alone, rank = "WORLD_SIZE" not in os.environ, os.environ.get(name, "0")
            require(not alone or rank == "0", name, "0 without WORLD_SIZE", rank, remedy="unset it for one process")


def started_by_srun() -> bool:
    """Returns whether srun started this process as one of SLURM_NTASKS. Batch scripts and shells do not count."""
    own = os.environ.get("SLURM_STEP_NUM_TASKS", os.environ.get("SLURM_NTASKS"))
    return _inside_slurm_step() and "SLURM_STEP_ID" in os.environ and own == os.environ["SLURM_NTASKS"]


def _inside_slurm_step() -> bool:
    interactive = os.environ.get("SLURM_JOB_NAME") in ("bash", "interactive")  # a shell, by Lightning's rule
    return "SLURM_PROCID" in os.environ and "SLURM_NTASKS" in os.environ and not interactive
