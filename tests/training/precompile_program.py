"""Launches of small updates and frames, under a driver that needs no GPU: listed twice, and one kernel compiled.

Prints two paragraphs, the keys in Triton's cache on disk of an update's kernels, one a line: asked for in the order of
a training, and from behind, as a process might that compiles a share of them.
"""

import contextlib
import io
import json
import os
import sys
import threading
from types import SimpleNamespace

from frame_launches import frame_of
from no_gpu import use_h100
from triton.compiler import ASTSource
from triton.runtime.cache import triton_key
from triton.runtime.jit import JITFunction

from hgn.config import NetworkConfig, SceneConfig, TrainConfig, TrainingConfig
from hgn.kernels import triton_compat
from hgn.kernels.triton_compat import compile_launches, noted_launches
from hgn.runtime import triton_stepper
from hgn.schema import to_mapping
from hgn.step_config import StepConfig
from hgn.training.precompile import launches_of, main, sizes_of


def tell(self, key, signature, device, constants, options, attributes, **_):
    """Replaces JITFunction._do_compile."""
    print(f"{self.__name__} {ASTSource(self, signature, constants, attributes).hash()} {options.hash()}")
    return SimpleNamespace(src=None, metadata=None)


use_h100()
network = NetworkConfig(width=16, levels=2, message_passing_steps=2)
training = TrainingConfig(batch_scenes=2, precision="fp16", ema_decay=0.9, noise_correlated_fraction=0.0)
job = TrainConfig(SceneConfig(group_size=0.02), network=network, training=training)
sizes = sizes_of(job)
found = launches_of(job, True, sizes)
expected = set(found)
assert set(launches_of(job, True, sizes, "cpu")) == expected and len(expected) > 30, len(expected)
for order in (list(found.values()), list(found.values())[::-1]):
    child = os.fork()  # what a process has seen of kernels, the next has not
    if child == 0:
        JITFunction._do_compile = tell
        for function, data in order:
            compile_launches([(function, data)])
        print(flush=True)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        sys.exit("asking for keys failed")
# the last of as many processes as there are kernels compiles one
sys.argv, sys.stdin = (
    ["", str(len(expected) - 1), str(len(expected)), "90", "1"],
    io.StringIO(json.dumps(to_mapping(job))),
)
with contextlib.redirect_stdout(io.StringIO()) as printed:
    main()
assert printed.getvalue() == "1\n"


# before a frame is captured all its kernels are compiled, two at a time; a launch would fail, as these have no launcher
def captured(parts, warm_up):
    """Replaces hgn.kernels.capture.captured."""
    with noted_launches() as missing:
        for launches in (warm_up, *parts):
            launches()
    assert not missing, [function.__name__ for function, _ in missing.values()]
    return [None]


def compiled(src, *_, **options):
    """Replaces triton.compile."""
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
