"""Launches of small updates and frames, under a driver that needs no GPU: listed twice, and one kernel compiled.

Prints two paragraphs, the keys in Triton's cache on disk of an update's kernels, one a line: asked for in the order of
a training, and from behind, as a process might that compiles a share of them.
"""

import os
import sys
import threading
from dataclasses import replace
from types import SimpleNamespace

from no_gpu import use_h100
from triton.compiler import ASTSource
from triton.runtime.cache import triton_key
from triton.runtime.jit import JITFunction

from hgn.config import NetworkConfig
from hgn.kernels import triton_compat
from hgn.kernels.grid.op import Window
from hgn.kernels.triton_compat import noted_launches, preload
from hgn.kernels.update.op import UpdateSettings
from hgn.runtime import precompile_program, triton_stepper
from hgn.runtime.precompile_program import FrameJob, PrecompileJob, compile_part, launches_of
from hgn.runtime.triton_stepper import TritonStepper
from hgn.step_config import StepConfig


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
rolling = replace(job, pushforward_scenes=(3,))
with_frames = set(launches_of(rolling, "cpu"))
assert set(launches_of(rolling)) == with_frames > expected, len(with_frames)
assert compile_part(job, len(expected) - 1, len(expected)) == 1
# frames: of two precisions each has kernels of its own, and a network with fewer levels only tables of its own
frames = FrameJob(((network, StepConfig(), "fp16"),), ((300, 200), (40_000, 20_000)), 90)


def more(*case):
    """Launches of these frames, and of another network's."""
    return set(launches_of(replace(frames, networks=(*frames.networks, case))))


listed = set(launches_of(frames, "cpu"))
assert set(launches_of(frames)) == listed and len(listed) > len(launches_of(replace(frames, sizes=frames.sizes[:1])))
assert more(network, StepConfig(), "tf32") > listed
assert len(more(replace(network, levels=1), StepConfig(), "fp16") - listed) < 8
assert len(more(network, StepConfig(obstacle_clearance=1e-3), "fp16") - listed) == 1


# before a frame is captured all its kernels are compiled, two at a time; a launch would fail, as these have no launcher
class Kept(TritonStepper):
    """The stepper of launches_of, which stays."""

    def _window(self):
        steppers.append(self)
        return Window.around((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), self.config.cell_size, self.config.levels)


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


steppers, compiling, both = [], [], threading.Barrier(2, timeout=60)
precompile_program._Unplaced = Kept
triton_stepper.captured, triton_stepper.available_cpus = captured, lambda: 2
frame = launches_of(replace(frames, sizes=frames.sizes[:1]))
for function, _ in frame.values():
    function.compile = compiled
triton_key.cache_clear()
triton_compat.hashing.cache_clear()
steppers[0]._capture()
assert len(compiling) == len(frame), (compiling, len(frame))
assert triton_key.cache_info().misses == 1  # Triton's files are hashed once, not by each thread
