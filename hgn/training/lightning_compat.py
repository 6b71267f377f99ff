"""All that this project uses of Lightning, with its private and fragile parts; pyproject.toml bounds its version.

`tests/training/test_lightning_compat.py` fails when a new version changes one of them.
"""

import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

# Lightning needs two classes of torchmetrics for metrics, which this project logs itself. torchmetrics imports SciPy's
# signal processing and Matplotlib, which takes as long as all of PyTorch. Other modules import Lightning from here.
if "torchmetrics" not in sys.modules:
    sys.modules["torchmetrics"] = metrics = ModuleType("torchmetrics")
    metrics.__dict__.update(__version__="1.0.0", Metric=type("Metric", (), {}), MetricCollection=type("", (), {}))
    import lightning.pytorch  # noqa: F401

    del sys.modules["torchmetrics"]  # a logger may need all of it

from lightning.fabric.loggers import Logger as Logger
from lightning.fabric.loggers import TensorBoardLogger as TensorBoardLogger  # the other one writes empty hparams.yaml
from lightning.fabric.plugins import TorchCheckpointIO as TorchCheckpointIO
from lightning.pytorch import Callback as Callback
from lightning.pytorch import LightningDataModule as LightningDataModule
from lightning.pytorch import LightningModule as LightningModule
from lightning.pytorch import Trainer
from lightning.pytorch import seed_everything as seed_everything
from lightning.pytorch.loggers import Logger as TrainerLogger  # noqa: F401
from lightning.pytorch.loggers import MLFlowLogger as MLFlowLogger
from lightning.pytorch.loggers import WandbLogger as WandbLogger
from lightning.pytorch.plugins.environments import (
    ClusterEnvironment,
    LightningEnvironment,
    SLURMEnvironment,
    TorchElasticEnvironment,
)
from lightning.pytorch.strategies import DDPStrategy
from torch.optim import Optimizer

from hgn.schema import ConfigError
from hgn.system.machine import memory_is_full
from hgn.training.distributed import averaging_options, started_by_srun

# what Lightning and torch raise for checkpoints whose parts are not those of a trainer
_ODD_PARTS = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError)


def quieten() -> None:
    """Silences messages and hints of Lightning, because the commands print their own."""
    for package in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(package).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", ".*LeafSpec.*")
    warnings.filterwarnings("ignore", ".*GPU available but not used.*")  # training.device=cpu was chosen on purpose


class _Srun(SLURMEnvironment):
    """Omits checks that refuse srun without --ntasks-per-node, or with fewer tasks than the job's."""

    @staticmethod
    def _validate_srun_variables() -> None:
        pass

    def validate_settings(self, num_devices: int, num_nodes: int) -> None:
        pass


def own_launcher() -> list[ClusterEnvironment]:
    """Returns the launcher that `distributed.layout` recognises. Other launchers' variables would mislead Lightning."""
    if "RANK" in os.environ:
        return [LightningEnvironment() if os.environ["WORLD_SIZE"] == "1" else TorchElasticEnvironment()]
    return [_Srun() if started_by_srun() else LightningEnvironment()]


def gradient_averaging(backend: str) -> DDPStrategy:
    """Returns the strategy of a training on several ranks; `backend` is torch or triton."""
    return _Unwrapped() if backend == "triton" else DDPStrategy(**averaging_options())


class _Unwrapped(DDPStrategy):
    """Omits DistributedDataParallel, for updates that average their gradients themselves."""

    def configure_ddp(self) -> None:
        pass


@contextmanager
def interrupts_passed_on() -> Iterator[None]:
    """Restores a KeyboardInterrupt, which Lightning turns into an exit with an error code."""
    try:
        yield
    except SystemExit as end:
        raise KeyboardInterrupt from end


def skip_sigterm_broadcast(trainer: Trainer) -> None:
    """Removes a broadcast before each training step. With it Lightning shares a SIGTERM of rank 0, and the host waits
    for the device (its issue 21487). hgn.training.callbacks.Stopper shares signals every few updates instead."""
    trainer.fit_loop.epoch_loop._broadcast_sigterm_tensor = lambda: None  # type: ignore[method-assign]


def forget_sigterm(trainer: Trainer) -> None:
    """Clears a SIGTERM that Lightning's own handler received, which also called ours. Otherwise Lightning would leave
    the loop by an exception, without a checkpoint and with exit code 0."""
    trainer._signal_connector.received_sigterm = False


def save_alone(trainer: Trainer, path: Path) -> None:
    """Saves a checkpoint on this rank, whichever it is, without the others."""
    trainer.strategy.checkpoint_io.save_checkpoint(trainer._checkpoint_connector.dump_checkpoint(), path)


def _require_shapes(optimizer: Optimizer) -> None:
    """Raises ValueError or LookupError if Adam's restored state does not belong to its parameters."""
    for parameter in optimizer.param_groups[0]["params"] if optimizer.state else ():
        for name, shape in {"step": (), "exp_avg": parameter.shape, "exp_avg_sq": parameter.shape}.items():
            stored = optimizer.state[parameter][name]
            if stored.shape != shape:
                raise ValueError(f"{name} of shape {list(stored.shape)} for a parameter of {list(shape)}")
            if not stored.isfinite().all():
                raise ValueError(f"{name} of a parameter of {list(shape)} is not finite")


def name_odd_parts(trainer: Trainer, path: Path) -> None:
    """Turns errors of restoring a checkpoint into a ConfigError with its path."""

    def named(restore: Callable[..., None]) -> Callable[..., None]:
        def call(*given: Any) -> None:
            try:
                restore(*given)
                for optimizer in trainer.optimizers:
                    _require_shapes(optimizer)
            except _ODD_PARTS as error:
                if isinstance(error, ConfigError) or memory_is_full(error):
                    raise
                cause = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
                raise ConfigError(
                    f"checkpoint must contain the state of a training of this version, got {path}: {cause}; "
                    "delete it to resume from the previous one"
                ) from error

        return call

    connector = trainer._checkpoint_connector
    for name in ("_restore_modules_and_callbacks", "restore_training_state"):
        setattr(connector, name, named(getattr(connector, name)))
