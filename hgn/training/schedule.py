"""Learning rate and moving average as functions of the number of updates made before."""

from __future__ import annotations

from hgn.config import TrainingConfig


def learning_rate(training: TrainingConfig, update: int) -> float:
    """Returns the learning rate of update number `update`, from 0: exponential decay, after a linear warm-up."""
    decay = (training.final_learning_rate / training.learning_rate) ** (1 / training.maximum_updates)
    warmth = min(1.0, (update + 1) / training.warmup_updates) if training.warmup_updates else 1.0
    return training.learning_rate * (decay**update * warmth)


def average_weight(training: TrainingConfig, update: int) -> float:
    """Returns the weight of the new parameters in their moving average, after update number `update`, from 0.

    Early parameters are forgotten soon: while there are few updates, the average is over the last tenth of them.
    """
    return 1.0 - min(training.ema_decay, (1 + update) / (10 + update))
