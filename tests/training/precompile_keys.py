"""precompile_keys.py ORDER…: the keys in Triton's cache on disk of a small update's kernels, one a line.

They are asked for in a process for each order: `launch`, as a training does, `behind`, as a process might that
compiles a share of them.
"""

import os
import sys

from no_gpu import use_h100
from triton.compiler import ASTSource
from triton.runtime.jit import JITFunction

from hgn.config import NetworkConfig
from hgn.kernels.triton_compat import preload
from hgn.kernels.update.op import UpdateSettings
from hgn.runtime.precompile_program import PrecompileJob, launches_of


def key_of(function, signature, constants, attributes, options):
    return f"{function.__name__} {ASTSource(function, signature, constants, attributes).hash()} {options.hash()}"


def not_compiled(self, key, signature, device, constants, options, attributes, **_):
    """Stands for JITFunction._do_compile once the launches are known."""
    print(key_of(self, signature, constants, attributes, options))


def tell(order):
    """Prints a blank line, and then the keys."""
    settings = UpdateSettings(2, 1e-3, True, 1 / 64, True, 0.5)
    network, sizes = NetworkConfig(width=16, levels=2, message_passing_steps=2), (200, 60)
    found = list(launches_of(PrecompileJob(network, settings, "fp16", True, True, 300, sizes, 90)).values())
    JITFunction._do_compile = not_compiled
    print()
    for function, data in reversed(found) if order == "behind" else found:
        preload(function, data)
    sys.stdout.flush()


use_h100()
for order in sys.argv[1:]:
    child = os.fork()  # what a process has seen of kernels, the next has not
    if child == 0:
        tell(order)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        sys.exit(f"{order} failed")
