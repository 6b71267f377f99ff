"""Learns particle physics with hierarchical graph networks.

Import the public API from here (`from hgn import Simulator, load_scene`). Each name is loaded at its first use, so that
`import hgn` loads neither torch nor NumPy.
"""

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hgn.runtime.divergence import DivergedError as DivergedError
    from hgn.runtime.live import LiveSimulation as LiveSimulation
    from hgn.runtime.simulator import InitialState as InitialState
    from hgn.runtime.simulator import Simulator as Simulator
    from hgn.scene.mesh import load_mesh as load_mesh
    from hgn.scene.rollout_file import Rollout as Rollout
    from hgn.scene.rollout_file import read_rollout as read_rollout
    from hgn.scene.rollout_file import write_rollout as write_rollout
    from hgn.scene.scene import Obstacle as Obstacle
    from hgn.scene.scene import Scene as Scene
    from hgn.scene.scene_file import load_scene as load_scene
    from hgn.schema import ConfigError as ConfigError

# OpenMP reads this when torch loads it. Otherwise its idle threads spin, and take cores from the thread for which they
# wait. While another program runs, a training then makes at most a sixth of the updates. If PyTorch was loaded before,
# hgn/system/device.py does the same in another way.
if "torch" not in sys.modules:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

_MODULES = {
    "ConfigError": "hgn.schema",
    "DivergedError": "hgn.runtime.divergence",
    "InitialState": "hgn.runtime.simulator",
    "LiveSimulation": "hgn.runtime.live",
    "Obstacle": "hgn.scene.scene",
    "Rollout": "hgn.scene.rollout_file",
    "Scene": "hgn.scene.scene",
    "Simulator": "hgn.runtime.simulator",
    "load_mesh": "hgn.scene.mesh",
    "load_scene": "hgn.scene.scene_file",
    "read_rollout": "hgn.scene.rollout_file",
    "write_rollout": "hgn.scene.rollout_file",
}
__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
