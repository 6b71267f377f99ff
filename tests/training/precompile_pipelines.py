"""The weights' products of a training as compiled for an H100, a line each: the kernel, how many of its tiles are
copied ahead, and how many products may be under way while the next tile is copied."""

from __future__ import annotations

import re

from no_gpu import use_h100

from hgn.config import NetworkConfig
from hgn.kernels.precompile import PrecompileJob, launches_of
from hgn.kernels.triton_compat import preload
from hgn.kernels.update.op import UpdateSettings

use_h100()
settings = UpdateSettings(2, 1e-3, True, 1 / 64)
network = NetworkConfig(levels=2, message_passing_steps=1)
for function, data in launches_of(PrecompileJob(network, settings, "fp16", False, False, 300, (200, 60), 90)).values():
    if function.__name__ in ("weight_gradient", "particle_cell_weight_gradient"):
        text = preload(function, data).asm["ttgir"]
        ahead = len(re.findall(r"local_alloc : \(\) -> !ttg.memdesc<[2-9]x", text))
        pending = max(map(int, re.findall(r"warp_group_dot_wait.*pendings = (\d+)", text)))
        print(function.__name__, ahead, pending)
