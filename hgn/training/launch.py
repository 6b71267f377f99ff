"""How many processes train, and which of them this is: launchers say so in environment variables.

torchrun sets RANK and WORLD_SIZE, srun sets SLURM_PROCID and SLURM_NTASKS, Lightning's own launcher, which starts
the other processes of a machine itself, sets LOCAL_RANK and NODE_RANK in them.
"""

from __future__ import annotations

import os

import torch

from hgn.config import TrainingConfig
from hgn.schema import ConfigError, require


def first_rank() -> bool:
    """Whether this process leads: it alone starts the generator and writes the run's files."""
    if "RANK" in os.environ:
        # torchrun's word counts: inside Slurm its rank 0 may be on any of the nodes
        return os.environ["RANK"] == "0"
    return all(os.environ.get(name, "0") == "0" for name in ("SLURM_PROCID", "NODE_RANK", "LOCAL_RANK"))


def device_count(training: TrainingConfig) -> int:
    """Processes on each machine, one for each device.

    Raises: ConfigError when there are not as many GPUs as asked for.
    """
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    require(training.accelerator != "gpu" or gpus > 0, "training.accelerator", "auto or cpu without a GPU", "gpu")
    if training.accelerator == "cpu" or gpus == 0:
        return training.devices or 1
    wanted = training.devices or gpus
    require(wanted <= gpus, "training.devices", f"at most the {gpus} GPUs of this machine", wanted)
    return wanted


def check_processes(training: TrainingConfig) -> None:
    """The launcher started as many processes as the configuration counts on.

    Otherwise each of them would train alone and write over the others' checkpoints, or wait for ever.
    Raises: ConfigError.
    """
    started = _started_processes()
    devices = device_count(training)
    if started is not None and started != devices * training.nodes:
        raise ConfigError(
            f"training.devices x training.nodes must be the {started} processes that the launcher started, got "
            f"{devices} x {training.nodes}; set training.devices to the processes of one machine and training.nodes "
            "to the number of machines, and under Slurm start one task for each device with srun"
        )


def _started_processes() -> int | None:
    if "RANK" in os.environ and "WORLD_SIZE" in os.environ:
        return int(os.environ["WORLD_SIZE"])
    interactive = os.environ.get("SLURM_JOB_NAME") in ("bash", "interactive")  # Lightning's rule: a shell, no job
    if "SLURM_PROCID" in os.environ and "SLURM_NTASKS" in os.environ and not interactive:
        return int(os.environ["SLURM_NTASKS"])
    return None
