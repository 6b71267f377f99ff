"""Cases and outcomes of tools.stability, for its tests."""

from dataclasses import replace

import torch
from network.states import network_of, silent

from hgn.config import SceneConfig
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.weights import WeightsInfo, save_weights
from tools.stability.case import Outcome
from tools.stability.network_cases import FAMILIES, Context


def still_weights(folder, **changes):
    """A file of a network that never accelerates particles."""
    still = silent(network_of(torch.float32, width=8, message_passing_steps=1, levels=2, **changes))
    still.normaliser.acceleration_mean.zero_()
    save_weights(folder / "still.safetensors", still, WeightsInfo(still.config, 60.0, 1 / 64, updates=3))
    return str(folder / "still.safetensors")


def family(name, config, frames=300, solver=True, **scene):
    """The cases of a family."""
    return list(FAMILIES[name](Context(SceneConfig(**scene), config, 60.0, frames, 3000, solver)))


def outcome_of(case, trials, simulator=None, solver=None):
    scenes = [InitialState.of_scene(scene) for scene in case.scenes]
    simulator = simulator or Simulator(network_of(), 60.0)
    reference = None if solver is None else Outcome(case, scenes, solver, simulator)
    return Outcome(case, scenes, trials, simulator, reference)


def one_particle(**change):
    (case, *_) = family("single", network_of().config)
    return replace(case.scenes[0], **change)
