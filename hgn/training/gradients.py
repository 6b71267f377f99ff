"""Gradients that are not finite: such an update is skipped and counted, and too many in a row end the training.

The device counts, and the host reads the counters at log lines. Counters [5]: sum of the finite norms, their number,
skipped updates, updates skipped in a row now, largest number skipped in a row since the last log line.
"""

from collections.abc import Iterable

import torch

from hgn.schema import ConfigError

MAXIMUM_SKIPPED = 100  # number of skipped updates in a row that ends a training


class GradientGuard:
    """Skips updates that would put a NaN into the parameters. The Triton kernels do the same (finish_update).

    Gradients are checked after their average over the ranks, so all ranks skip the same updates. A norm above the
    largest float32 counts as not finite. A skipped update is still counted: its samples are used up, and the learning
    rate decays. Parameters and moments do not change.
    """

    def __init__(self, counters: torch.Tensor) -> None:
        self._counters = counters
        self._skip = torch.zeros((), device=counters.device)

    def check(self, parameters: Iterable[torch.nn.Parameter], optimizer: torch.optim.Optimizer) -> None:
        """Makes `optimizer` (a fused one) skip its next step if a gradient is not finite. No host synchronisation."""
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients)
        finite = norm.isfinite()
        self._skip.copy_(~finite)
        in_a_row = (self._counters[3] + 1) * self._skip
        self._counters[:3] += torch.stack([torch.where(finite, norm, 0), 1 - self._skip, self._skip])
        self._counters[3] = in_a_row
        self._counters[4] = torch.maximum(self._counters[4], in_a_row)
        # loss scaling uses this attribute to make fused optimisers skip a step
        optimizer.found_inf = self._skip  # type: ignore[attr-defined]


def take_counters(counters: torch.Tensor, update: int) -> tuple[int, dict[str, float]]:
    """Returns the number of skipped updates since the last call, and the mean norm of the finite gradients if any.

    Raises: ConfigError if MAXIMUM_SKIPPED updates in a row were skipped.
    """
    norm_sum, finite, skipped, _, most_in_a_row = counters.tolist()
    counters[:3] = 0
    counters[4] = 0
    if most_in_a_row >= MAXIMUM_SKIPPED:
        raise ConfigError(
            f"gradients must be finite, got others in {most_in_a_row:.0f} updates in a row, up to update {update}, "
            "which did not change the weights; lower training.learning_rate or look for damaged episodes, and resume "
            "from the last checkpoint"
        )
    return int(skipped), {"gradient_norm": norm_sum / finite} if finite else {}
