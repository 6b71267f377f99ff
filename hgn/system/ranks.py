"""The place of this process among those of a training, from variables of torchrun, Slurm and Lightning's launcher."""

import os


def first_rank() -> bool:
    """Returns whether this process starts the generator and writes the run's files."""
    if "RANK" in os.environ:
        # torchrun's variable comes first: inside Slurm, torchrun's rank 0 may be on any of the nodes
        return os.environ["RANK"] == "0"
    return all(os.environ.get(name, "0") == "0" for name in ("SLURM_PROCID", "NODE_RANK", "LOCAL_RANK"))


def first_on_machine() -> bool:
    """Returns whether this process is the first on its machine."""
    if "RANK" in os.environ:
        return os.environ.get("LOCAL_RANK", "0") == "0"
    return all(os.environ.get(name, "0") == "0" for name in ("SLURM_LOCALID", "LOCAL_RANK"))
