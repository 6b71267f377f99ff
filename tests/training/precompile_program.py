"""Launches of small updates and frames, under a driver that needs no GPU: listed twice, and one kernel compiled.

Prints two paragraphs, the keys in Triton's cache on disk of an update's kernels, one a line: asked for in the order of
a training, and from behind, as a process might that compiles a share of them.
"""

import os
import sys
import threading
from types import SimpleNamespace

from frame_launches import frame_of
from no_gpu import use_h100
from triton.compiler import ASTSource
from triton.runtime.cache import triton_key
from triton.runtime.jit import JITFunction

from hgn.config import NetworkConfig
from hgn.kernels import triton_compat
from hgn.kernels.triton_compat import noted_launches, preload
from hgn.kernels.update.op import UpdateSettings
from hgn.runtime import triton_stepper
from hgn.step_config import StepConfig
from hgn.training.precompile import PrecompileJob, compile_part, launches_of


def tell(self, key, signature, device, constants, options, attributes, **_):
    """Stands for JITFunction._do_compile."""
    print(f"{self.__name__} {ASTSource(self, signature, constants, attributes).hash()} {options.hash()}")
    return SimpleNamespace(src=None, metadata=None)


use_h100()
settings = UpdateSettings(2, 1e-3, True, 1 / 64)
network = NetworkConfig(width=16, levels=2, message_passing_steps=2)
job = PrecompileJob(network, settings, "fp16", True, True, 300, (200, 60), 90)
found = launches_of(job)
expected = set(found)
assert set(launches_of(job, "cpu")) == expected and len(expected) > 30, len(expected)
for order in (list(found.values()), list(found.values())[::-1]):
    child = os.fork()  # what a process has seen of kernels, the next has not
    if child == 0:
        JITFunction._do_compile = tell
        for function, data in order:
            preload(function, data)
        print(flush=True)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        sys.exit("asking for keys failed")
assert compile_part(job, len(expected) - 1, len(expected)) == 1


# before a frame is captured all its kernels are compiled, two at a time; a launch would fail, as these have no launcher
def captured(parts, warm_up):
    """Stands for hgn.kernels.capture.captured."""
    with noted_launches() as missing:
        for launches in (warm_up, *parts):
            launches()
    assert not missing, [function.__name__ for function, _ in missing.values()]
    return [None]


def compiled(src, *_, **options):
    """Stands for triton.compile."""
    compiling.append(src.fn.__name__)
    if len(compiling) <= 2:
        both.wait()
    triton_key()
    return SimpleNamespace(src=src, metadata=None)


compiling, both = [], threading.Barrier(2, timeout=60)
triton_stepper.captured, triton_stepper.available_cpus = captured, lambda: 2
frame, stepper = frame_of(network, StepConfig(), "fp16", (200, 50), particles=300)
for function, _ in frame.values():
    function.compile = compiled
triton_key.cache_clear()
triton_compat.hashing.cache_clear()
stepper._capture()
assert len(compiling) == len(frame), (compiling, len(frame))
assert triton_key.cache_info().misses == 1  # Triton's files are hashed once, not by each thread
