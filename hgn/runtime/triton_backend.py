"""The backend triton: simulations in CUDA graphs, which are kept for later simulations."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from hgn.kernels.triton_compat import hashing
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.parity import ParityError
from hgn.runtime.torch_backend import Backend
from hgn.runtime.triton_stepper import CHECKED_PARTICLES, TritonStepper

IDLE_STEPPERS = 2  # number of steppers kept for later simulations, for different numbers of scenes
LEAST_FILLING = 0.5  # smallest used fraction of a stepper's capacity; launches have the size of the capacity


class TritonBackend(Backend):
    """Runs a hierarchical graph network in Triton's kernels. PyTorch computes single frames (`predict`)."""

    name = "triton"
    stepped = False
    network: HierarchicalGraphNetwork

    def __init__(self, network: HierarchicalGraphNetwork, precision: str = "auto") -> None:
        super().__init__(network, precision)
        if self.device.type == "cuda":
            hashing()  # while the scene is loaded
        self.idle: dict[int, TritonStepper] = {}  # by number of scenes

    @contextmanager
    def stepper(self, state: ParticleState, capacity: int = 0) -> Iterator[TritonStepper]:
        """Yields a new or idle stepper. It becomes idle on exit."""
        stepper = self._idle_stepper(state, capacity)
        if stepper is None:
            stepper = self._new_stepper(state, capacity)
        try:
            yield stepper
        finally:
            self.idle.pop(state.scene_count, None)
            if len(self.idle) == IDLE_STEPPERS:
                del self.idle[next(iter(self.idle))]
            self.idle[state.scene_count] = stepper

    def _new_stepper(self, state: ParticleState, capacity: int) -> TritonStepper:
        """Allocates a stepper and checks it. If it fails the check, precision `auto` becomes tf32 permanently."""
        stepper = TritonStepper(self.network, state, self.precision, capacity=capacity, step=self.step)
        if len(state.position_N3) > CHECKED_PARTICLES:
            return stepper
        try:
            stepper.require_parity(self.network, state)
            return stepper
        except ParityError as error:
            if self.precision == self.precisions[-1]:
                raise
            message = str(error)
        del stepper  # before the next one is allocated
        self.precision = self.precisions[-1]
        warnings.warn(f"{message}. precision=auto computes in {self.precision} from here on", stacklevel=1)
        return self._new_stepper(state, capacity)

    def _idle_stepper(self, state: ParticleState, capacity: int) -> TritonStepper | None:
        """Starts an idle stepper from a state that it fits. Its launches are already captured.

        An idle stepper that does not fit is freed before another one is allocated.
        """
        stepper, wanted = self.idle.pop(state.scene_count, None), max(capacity, len(state.position_N3))
        if stepper is None or not stepper.fits(state) or not wanted <= stepper.particles <= wanted / LEAST_FILLING:
            return None
        stepper.use_values(stepper.packed.gather(list(self.network.parameters())))
        stepper.begin(state, new_obstacles=True)
        return stepper

    def release(self) -> None:
        self.idle.clear()
