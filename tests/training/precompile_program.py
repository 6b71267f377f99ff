"""Launches of small updates and frames, under a driver that needs no GPU: listed twice, and one kernel compiled.

Prints two paragraphs, the keys in Triton's cache on disk of an update's kernels, one a line: asked for in the order of
a training, and from behind, as a process might that compiles a share of them.
"""

import os
import sys
from dataclasses import replace

from no_gpu import use_h100
from triton.compiler import ASTSource
from triton.runtime.jit import JITFunction

from hgn.config import NetworkConfig
from hgn.kernels.triton_compat import preload
from hgn.kernels.update.op import UpdateSettings
from hgn.runtime.precompile_program import FrameJob, PrecompileJob, compile_part, launches_of
from hgn.step_config import StepConfig


def tell(self, key, signature, device, constants, options, attributes, **_):
    """Stands for JITFunction._do_compile."""
    print(f"{self.__name__} {ASTSource(self, signature, constants, attributes).hash()} {options.hash()}")


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
