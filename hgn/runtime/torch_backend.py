"""The backend torch. All backends have its signature; hgn.runtime.backend chooses one for a network."""

from contextlib import AbstractContextManager, nullcontext

import torch

from hgn.cpu.allocator import keep_freed_memory
from hgn.network.base import ParticleNetwork, Prediction
from hgn.network.features import ParticleState
from hgn.runtime.simulation import Stepper
from hgn.runtime.torch_stepper import TorchStepper
from hgn.step.reference import accelerations


def precisions_to_try(precision: str, device: torch.device, backend: str) -> tuple[str, ...]:
    """Returns the given precision, or for `auto` the precisions of a backend, fastest first."""
    if precision != "auto":
        return (precision,)
    if device.type == "cpu":
        return ("fp32",)
    return ("fp16", "tf32") if backend == "triton" else ("tf32",)


class Backend:
    """Runs PyTorch on the device of the network: the reference for every other backend."""

    name = "torch"
    stepped = True  # frames begin one by one, so that diverged scenes can be left out of the next

    def __init__(self, network: ParticleNetwork, precision: str = "auto") -> None:
        self.network = network
        self.note = ""  # reports which backend computes, and why
        self.step = network.step  # constraints of its simulations
        self.device = next(network.parameters()).device
        self.precisions = precisions_to_try(precision, self.device, self.name)
        self.precision = self.precisions[0]
        if self.device.type == "cpu":
            keep_freed_memory()

    def prediction(self, state: ParticleState) -> Prediction:
        """Returns the raw output, and the contacts that the rest constraint needs."""
        return self.network.prediction(state)

    def predict(self, state: ParticleState) -> torch.Tensor:
        """Returns the accelerations of a simulation [N, 3] in frame units, after the rest constraint."""
        return accelerations(self.network, state, self.prediction(state), self.step)

    def stepper(self, state: ParticleState, capacity: int = 0) -> AbstractContextManager[Stepper]:
        """Returns a stepper for the frames after a state. Backend triton allocates buffers for `capacity` particles."""
        return nullcontext(TorchStepper(self.predict, state, self.step, self.network.config.dimensions))

    def release(self) -> None:
        """Frees the buffers that are kept for later simulations."""
