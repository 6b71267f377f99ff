"""precompile_keys.py launch|behind [gns]: the keys in Triton's cache on disk of a small update's kernels, one a line.

They are asked for in the order of the launches, as a training does, or from behind, as a process might that compiles a
share of them.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

from no_gpu import use_h100
from triton.compiler import ASTSource
from triton.runtime.jit import JITFunction

from hgn.config import NetworkConfig
from hgn.kernels.triton_compat import preload
from hgn.kernels.update.op import UpdateSettings
from hgn.runtime.precompile_program import PrecompileJob, launches_of


def key_of(function: JITFunction[Any], signature: Any, constants: Any, attributes: Any, options: Any) -> str:
    return f"{function.__name__} {ASTSource(function, signature, constants, attributes).hash()} {options.hash()}"


def not_compiled(
    self: Any, key: Any, signature: Any, device: Any, constants: Any, options: Any, attributes: Any, **_: Any
) -> None:
    """Stands for JITFunction._do_compile once the launches are known."""
    print(key_of(self, signature, constants, attributes, options))


use_h100()
settings = UpdateSettings(2, 1e-3, True, 1 / 64, True, 0.5)
network, sizes = NetworkConfig(width=16, levels=2, message_passing_steps=2), (200, 60)
if "gns" in sys.argv:
    settings = replace(settings, optimizer="muon")
    network, sizes = NetworkConfig(kind="gns", width=16, levels=1, message_passing_steps=2), (9000,)
found = list(launches_of(PrecompileJob(network, settings, "fp16", True, True, 300, sizes, 90)).values())
JITFunction._do_compile = not_compiled
for function, data in found if sys.argv[1] == "launch" else reversed(found):
    preload(function, data)
