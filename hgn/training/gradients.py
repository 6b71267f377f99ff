"""Gradients that are not finite: such an update is skipped and counted, and too many in a row end the training.

Everything happens on the device. The host reads the counters where it writes a log line, so no update waits for
it, and the same operations can be captured in a graph.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from hgn.schema import ConfigError

MAXIMUM_SKIPPED = 100  # updates in a row, after which a training ends


class GradientGuard(Callback):
    """Norms of the gradients, and the skipping of updates that would put a NaN into the weights.

    Gradients are looked at after they were averaged over the ranks, so all ranks skip the same updates. A norm above
    the largest float32 counts as not finite. A skipped update still counts as one: the sample is used up, the learning
    rate decays; weights and moments stay as they were.
    """

    def __init__(self) -> None:
        self._skipped_before = 0
        self._counters: torch.Tensor | None = None
        self._skip: torch.Tensor | None = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        counters = pl_module.gradient_counters
        assert isinstance(counters, torch.Tensor)
        self._counters = counters  # the Triton kernels count there by themselves

    def state_dict(self) -> dict[str, Any]:
        return {"skipped": self.skipped}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._skipped_before = state_dict["skipped"]

    @property
    def skipped(self) -> int:
        """Updates skipped since the run began; waits for the device."""
        return self._skipped_before + (0 if self._counters is None else int(self._counters[2]))

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        self.check(pl_module.parameters(), optimizer)

    def check(self, parameters: Iterable[torch.nn.Parameter], optimizer: torch.optim.Optimizer) -> None:
        """Makes `optimizer` (a fused one) skip its next step if a gradient is not finite. No host synchronisation."""
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients)
        if self._counters is None:
            # sum of finite norms, how many those are, skipped, skipped in a row, most in a row since the last look
            self._counters = torch.zeros(5, device=norm.device)
        if self._skip is None:
            self._skip = torch.zeros((), device=norm.device)
        finite = norm.isfinite()
        self._skip.copy_(~finite)
        in_a_row = (self._counters[3] + 1) * self._skip
        self._counters[:3] += torch.stack([torch.where(finite, norm, 0), 1 - self._skip, self._skip])
        self._counters[3] = in_a_row
        self._counters[4] = torch.maximum(self._counters[4], in_a_row)
        # the attribute by which loss scaling tells fused optimisers to leave everything as it is
        optimizer.found_inf = self._skip  # type: ignore[attr-defined]

    def take(self, update: int) -> dict[str, float]:
        """Mean norm of the finite gradients since the last call (if there were any), and updates skipped in all.

        Raises: ConfigError when MAXIMUM_SKIPPED updates in a row had to be skipped.
        """
        if self._counters is None:
            return {}
        norm_sum, finite, skipped, _, most_in_a_row = self._counters.tolist()
        self._counters[:3] = 0
        self._counters[4] = 0
        self._skipped_before += int(skipped)
        if most_in_a_row >= MAXIMUM_SKIPPED:
            raise ConfigError(
                f"gradients must be finite, got {most_in_a_row:.0f} updates in a row without, up to update {update}; "
                "the weights are as before them: lower training.learning_rate or look for damaged episodes, and go on "
                "from the last checkpoint"
            )
        values = {"skipped_updates": float(self._skipped_before)}
        return values | ({"gradient_norm": norm_sum / finite} if finite else {})
