"""Starts Taichi once in a process, on the device of the solver's config."""

import contextlib
import ctypes
import functools
import io
import os
from dataclasses import dataclass
from pathlib import Path

from hgn.schema import ConfigError, require
from hgn.system.machine import available_cpus, available_memory, writable_folder

# Taichi aborts the process if HOME is not set, as in a system's service; a user without a name has no home
os.environ.setdefault("HOME", os.path.expanduser("~").replace("~", "/nonexistent"))  # noqa: PTH111
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # stdout belongs to the command
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # a simulation makes no network calls

import taichi as ti

from datagen.mpm.taichi_compat import remove_useless_work


@dataclass(frozen=True)
class Device:
    """The device that this process simulates on."""

    kind: str  # cpu or cuda
    threads: int  # number of threads of the CPU; 1 on a GPU
    processors: int = 1  # multiprocessors of the GPU


_started: Device | None = None


def initialise(device: str = "auto", cpu_threads: int | None = None) -> Device:
    """Starts Taichi, or returns the device that an earlier call of this process started.

    `device` is auto (CUDA if this machine has it, else the CPU), cpu or cuda. `cpu_threads` is the number of threads on
    a CPU; None: all cores that this process may use. Compiled kernels are stored in Taichi's cache on disk, so the next
    process starts fast.

    Raises: ConfigError if cuda is requested without a GPU, or if the process already uses another device or number of
    threads (Taichi has one runtime per process).
    """
    global _started
    require(device in ("auto", "cpu", "cuda"), "device", "one of auto, cpu, cuda", device)
    if cpu_threads is not None:
        require(cpu_threads >= 1, "cpu_threads", "at least 1", cpu_threads)
    if _started is not None:
        if device not in ("auto", _started.kind):
            raise ConfigError(
                f"device must stay {_started.kind} for the whole process, got {device!r}; use another process"
            )
        if _started.kind == "cpu" and cpu_threads not in (None, _started.threads):
            raise ConfigError(
                f"cpu_threads must stay {_started.threads} for the whole process, got {cpu_threads}; "
                "use another process"
            )
        return _started
    remove_useless_work()
    ti.set_logging_level(ti.ERROR)  # without a GPU the search for CUDA warns
    has_gpu = device != "cpu" and ti.lang.misc.is_arch_supported(ti.cuda)
    if device == "cuda" and not has_gpu:
        raise ConfigError("device must be cpu or auto if CUDA finds no device, got 'cuda'")
    threads = cpu_threads or available_cpus()
    # if Taichi cannot write to its cache, it crashes at the end of the process
    kernels = writable_folder(Path(ti.lang.impl.default_cfg().offline_cache_file_path), "taichi")
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(
            arch=ti.cuda if has_gpu else ti.cpu,
            cpu_max_num_threads=threads,
            offline_cache=True,
            offline_cache_file_path=str(kernels),
            default_fp=ti.f32,
            default_ip=ti.i32,
            fast_math=False,  # it would reorder sums depending on nearby code, and remove tests for NaN
            # Taichi's optimisation takes nine tenths of the compile time, and LLVM repeats it
            cfg_optimization=False,
            opt_level=0,  # elimination of common subexpressions
            log_level=ti.ERROR,
        )
    _started = Device("cuda", 1, _processors()) if has_gpu else Device("cpu", threads)
    return _started


def _processors() -> int:
    """Returns the number of multiprocessors of the GPU that Taichi uses."""
    count = ctypes.c_int()
    multiprocessors, device = 16, 0
    status = cuda_driver().cuDeviceGetAttribute(ctypes.byref(count), multiprocessors, device)
    if status != 0:
        raise ConfigError(f"device must be a GPU that CUDA can query, got error {status}; choose cpu")
    return count.value


def memory_bytes(device: Device) -> int:
    """Returns the size of the memory that simulations on the device use."""
    if device.kind == "cpu":
        return available_memory()
    size = ctypes.c_size_t()
    status = cuda_driver().cuDeviceTotalMem_v2(ctypes.byref(size), 0)
    if status != 0:
        raise ConfigError(f"device must be a GPU whose memory CUDA can query, got error {status}; choose cpu")
    return size.value


@functools.cache
def cuda_driver() -> ctypes.CDLL:
    """Returns CUDA's driver, for functions that Taichi does not provide."""
    return ctypes.CDLL("libcuda.so.1")
