"""Compiles the kernels of a small training for an H100 and prints a line for each result: CANARY and the parts of
Triton's interface that are as expected; COMPILED and a kernel of a grid with relative inputs, of a rollout, or the
first with the name of a kernel that starts early; EARLY, such a kernel, the number of its waits, and the writes before
them; PRODUCT, kernel, tiles copied ahead and products in progress meanwhile; HAZARDS, kernel, precision and their
number; SHARED, kernel and its bytes of shared memory.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import torch
import triton
import triton.language as tl
from triton.backends.nvidia.compiler import CUDABackend

sys.path.insert(0, str(Path(__file__).parents[1] / "training"))

from frame_launches import frame_of
from no_gpu import use_h100
from ptx import hazards, overwritten_tiles

from hgn.config import NetworkConfig, TrainConfig, TrainingConfig
from hgn.kernels import triton_compat
from hgn.step_config import StepConfig
from hgn.training.precompile import launches_of


@triton.jit
def _copy(x, y, SIZE: tl.constexpr, PRECISION: tl.constexpr):
    tl.store(y + tl.arange(0, SIZE), tl.load(x + tl.arange(0, SIZE)))


def compiled(function, data):
    return triton_compat.compile_launches([(function, data)])[0]


use_h100()
misses = triton_compat.JitMisses()
with triton_compat.noted_launches() as launches:
    _copy[(1,)](x=torch.zeros(16, device="meta"), y=torch.zeros(16, device="meta"), SIZE=16, PRECISION="fp16")
((function, data),) = launches.values()
assert misses.count == 0 and triton_compat.capability() == 90 and not triton_compat.interpreting()
kernel = compiled(function, data)
assert misses.count == 1 and misses.seconds > 0, "Triton tells of no compilation"
assert "st.global" in kernel.asm["ptx"] and kernel.metadata.target.arch == 90
print("CANARY", function.__name__, flush=True)

CUDABackend.make_cubin = lambda *_: b""  # ptxas takes a fifth of the time, and nobody looks at what it makes
make_ptx = CUDABackend.make_ptx


def no_ptx(self, source, metadata, *_):
    """Replaces make_ptx, which takes a third of the time, if nobody reads its output."""
    metadata["name"] = "kernel"
    return ""


settings = TrainingConfig(batch_scenes=2, noise_correlated_fraction=0.0)
relative = NetworkConfig(inputs="local", width=16, levels=3, message_passing_steps=1)
of_relative = {}  # before any is compiled: what is would be launched
constrained = StepConfig(0.3, (0.02, 0.04), 1e-3)
near = replace(relative, obstacle_distance=True, own_physics=("friction", "moving"))
for seeing, step in ((relative, StepConfig()), (relative, constrained.in_training), (near, constrained)):
    of_relative |= frame_of(seeing, step, "fp16", (9000, 3000, 900), scenes=2, particles=9000)[0]
training = replace(settings, precision="fp16", symmetry="gravity")
of_relative |= launches_of(TrainConfig(network=near, training=training), False, (9000, (9000, 3000, 900)))

network = NetworkConfig(levels=1, message_passing_steps=1)
for precision in ("fp16", "tf32"):
    seen = set()
    job = TrainConfig(network=network, training=replace(settings, precision=precision))
    for function, data in launches_of(job, False, (9000, (9000,))).values():
        name = function.__name__
        many_warps = json.loads(data)["options"]["num_warps"] > 4
        if name.endswith("weight_gradient") if precision == "fp16" else many_warps and name not in seen:
            seen.add(name)
            asm = compiled(function, data).asm
            if "wgmma" not in asm["ptx"]:
                continue
            if name.endswith("weight_gradient") and precision == "fp16":
                print("PRODUCT", name, *overwritten_tiles(asm["ttgir"]))
            print("HAZARDS", name, precision, len(hazards(asm["ptx"])), flush=True)

# where a block has 99 KB of shared memory
triton_compat.use_target(89)
CUDABackend.make_ptx = no_ptx
narrow = NetworkConfig(width=64, levels=1, message_passing_steps=1)
for function, data in frame_of(narrow, StepConfig(), "fp16", (10_000,), particles=40_000)[0].values():
    if function.fn.__module__ in ("hgn.kernels.grid.kernel", "hgn.kernels.features.kernel"):
        continue  # knows no width
    print("SHARED", function.__name__, compiled(function, data).metadata.shared, flush=True)

triton_compat.use_target(90)
seen = set()
for function, data in of_relative.values():
    name, early = function.__name__, json.loads(data)["options"]["launch_pdl"]
    # by what those two differ in
    varied = function.fn.__module__.split(".")[2] in ("grid", "features", "coarsest", "step")
    if not varied and (not early or name in seen):
        continue
    seen.add(name)
    CUDABackend.make_ptx = make_ptx if early else no_ptx
    before, *after = compiled(function, data).asm["ptx"].split("griddepcontrol.wait")
    print("COMPILED", name, flush=True)
    if early:
        print("EARLY", name, len(after), before.count("st.global") + before.count("atom.global"), flush=True)
