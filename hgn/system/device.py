"""Chooses the device on which a command computes."""

import os
import threading

import torch

from hgn.schema import ConfigError
from hgn.system.machine import available_cpus


def choose_device(name: str) -> torch.device:
    """Returns a torch device. `auto` is CUDA if it is available; other names are torch's (cpu, cuda, cuda:1).

    Limits CPU threads to a container's quota. Raises ConfigError if the device does not exist.
    """
    keep_to_quota()
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ConfigError(f"device must be auto, cpu or cuda[:index], got {name!r}") from None
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ConfigError(f"device must exist, got {name!r} with {torch.cuda.device_count()} CUDA devices; use cpu")
    return device


def keep_to_quota() -> None:
    """Limits PyTorch's threads to a container's CPU quota. Above the quota the system would slow all threads.

    A value of OMP_NUM_THREADS takes precedence. Idle threads sleep.
    """
    if "OMP_WAIT_POLICY" not in os.environ and torch.get_num_threads() > 1:
        _let_idle_threads_sleep()
    if "OMP_NUM_THREADS" not in os.environ and available_cpus() < torch.get_num_threads():
        torch.set_num_threads(available_cpus())


def _let_idle_threads_sleep() -> None:
    """Lets idle threads of OpenMP sleep although PyTorch was loaded before `hgn` could set OMP_WAIT_POLICY.

    Without this variable an idle thread of GCC's OpenMP spins 300,000 times before it sleeps, but 100 times in a
    process with more threads than cores (GOMP_SPINCOUNT in its manual). So a second team, one thread for each core, is
    started and sleeps from now on.
    """
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"  # for processes that this one starts
    threads, started = torch.get_num_threads(), threading.Event()

    def start_and_sleep() -> None:
        torch.set_num_threads(len(os.sched_getaffinity(0)))  # of this thread, and of threads that start later
        torch.ones(1 << 17)  # a whole team computes large tensors
        torch.set_num_threads(threads)
        started.set()
        threading.Event().wait()

    threading.Thread(target=start_and_sleep, daemon=True).start()
    started.wait()
