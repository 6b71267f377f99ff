"""Learning rate, moving average and measurements as functions of the number of earlier updates."""

from hgn.config import TrainingConfig

FIRST_MEASUREMENT = 2_000  # smallest number of updates before the first measurement, if monitor_every is larger


def learning_rate(training: TrainingConfig, update: int) -> float:
    """Returns the learning rate of update number `update`, from 0: a linear warm-up, then exponential decay.

    The warm-up is at most a fifth of the training, so that a short trial reaches the configured rate.
    """
    decay = (training.final_learning_rate / training.learning_rate) ** (1 / training.maximum_updates)
    warmup = min(training.warmup_updates, training.maximum_updates // 5)
    warmth = min(1.0, (update + 1) / warmup) if warmup else 1.0
    return training.learning_rate * (decay**update * warmth)


def average_weight(training: TrainingConfig, update: int) -> float:
    """Returns the weight of the new parameters in their moving average, after update number `update`, from 0.

    Early parameters lose weight soon: at first the average extends over about the last tenth of the updates.
    """
    return 1.0 - min(training.ema_decay, (1 + update) / (10 + update))


def next_measurement(training: TrainingConfig, update: int) -> int:
    """Returns the number of updates at the next measurement of errors, after `update` updates.

    Errors are measured at every multiple of `monitor_every`. The first interval is halved while its half is at least
    FIRST_MEASUREMENT, so that a long training has a best checkpoint early.
    """
    due = training.monitor_every * (1 + update // training.monitor_every)
    while due // 2 > update and due // 2 >= FIRST_MEASUREMENT and due <= training.monitor_every:
        due //= 2
    return due


def measurement_due(training: TrainingConfig, update: int) -> bool:
    """Returns whether errors are measured after `update` updates, apart from the end of a training."""
    return next_measurement(training, update - 1) == update


def log_line_due(training: TrainingConfig, update: int) -> bool:
    """Returns whether metrics are logged after `update` updates: every `log_every`, and after the last one."""
    return update % training.log_every == 0 or update == training.maximum_updates
