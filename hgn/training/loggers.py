"""Logs to TensorBoard, Weights & Biases and MLflow, in addition to metrics.jsonl. Each logger has its own thread.

`training.loggers` lists them. Servers and credentials come from the environment, as in WANDB_MODE and
MLFLOW_TRACKING_URI. A logger that fails, or waits for its server, neither ends nor delays a training.
"""

import os
import queue
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from hgn.schema import printable
from hgn.system.files import write_atomically
from hgn.system.patience import standard_patience_s
from hgn.system.ranks import first_rank
from hgn.training.lightning_compat import Logger, MLFlowLogger, TensorBoardLogger, TrainerLogger, WandbLogger

PROJECT = "hgn"  # project in W&B and experiment in MLflow, unless the environment names another
MOST_WAITING = 10_000  # calls that wait for a logger; later ones are dropped
Builder = Callable[[Path, dict[str, Any]], Logger]


def _tensorboard(run: Path, settings: dict[str, Any]) -> Logger:
    printed = threading.excepthook

    def hook(fault: threading.ExceptHookArgs) -> None:
        if not type(fault.thread).__module__.startswith("tensorboard."):  # its next call raises its fault again
            printed(fault)

    threading.excepthook = hook
    return TensorBoardLogger(run, name="", version="tensorboard")


def _wandb(run: Path, settings: dict[str, Any]) -> Logger:
    # otherwise a process whose server is unreachable would never end
    os.environ.setdefault("WANDB_FINISH_TIMEOUT", f"{standard_patience_s():.0f}")
    name = None if "WANDB_NAME" in os.environ else run.name
    project, run_id = os.environ.get("WANDB_PROJECT", PROJECT), _stored_id(run, "wandb", "WANDB_RUN_ID")
    logger = WandbLogger(name=name, save_dir=run, project=project, id=run_id)
    _store_id(run, "wandb", logger.experiment.id)
    logger.log_hyperparams(settings)
    return logger


def _mlflow(run: Path, settings: dict[str, Any]) -> Logger:
    import mlflow

    experiment, run_id = os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT), _stored_id(run, "mlflow", "MLFLOW_RUN_ID")
    logger = MLFlowLogger(experiment, run.name, tracking_uri=mlflow.get_tracking_uri(), run_id=run_id)
    _store_id(run, "mlflow", str(logger.run_id))
    if run_id is None:
        logger.log_hyperparams(settings)
    else:  # MLflow refuses other values of its parameters
        logger.experiment.update_run(run_id, "RUNNING")
    return logger


BUILDERS: dict[str, Builder] = {
    "tensorboard": _tensorboard,
    "wandb": _wandb,
    "mlflow": _mlflow,
}


def _stored_id(run: Path, kind: str, variable: str) -> str | None:
    """Returns the id of the run that a training continues in W&B or MLflow; None begins a new one."""
    path = run / f"{kind}_id"
    return path.read_text().strip() if path.exists() else os.environ.get(variable)


def _store_id(run: Path, kind: str, run_id: str) -> None:
    write_atomically(run / f"{kind}_id", run_id.encode())


def build_loggers(kinds: Iterable[str], run: Path, settings: dict[str, Any]) -> "list[ThreadedLogger]":
    """Returns the loggers of this rank; only the first one has any. `settings` are logged as hyper-parameters."""
    return [ThreadedLogger(kind, run, settings) for kind in dict.fromkeys(kinds)] if first_rank() else []


class ThreadedLogger(TrainerLogger):
    """Calls one of Lightning's loggers in a thread, which starts with the first call. Its first fault is printed."""

    def __init__(self, kind: str, run: Path, settings: dict[str, Any]) -> None:
        self._kind, self._run, self._settings = kind, run, settings
        self._calls: queue.Queue[Callable[[Logger], object] | None] = queue.Queue(MOST_WAITING)
        self._thread = threading.Thread(target=self._work, name=kind, daemon=True)
        self._reported = False

    @property
    def name(self) -> str:
        return self._kind

    @property
    def version(self) -> None:
        return None

    def call(self, function: Callable[[Logger], object] | None) -> None:
        """Calls `function(logger)` after all earlier calls, or drops it if too many wait. None ends the thread."""
        if self._thread.ident is None:
            self._thread.start()
        try:
            self._calls.put_nowait(function)
        except queue.Full:
            self._report(f"{MOST_WAITING} calls wait for it, later calls are dropped")

    def log_metrics(self, metrics: Any, step: int | None = None) -> None:
        self.call(lambda logger: logger.log_metrics(metrics, step))

    def log_hyperparams(self, params: Any, *arguments: Any) -> None:
        self.call(lambda logger: logger.log_hyperparams(params, *arguments))

    def finalize(self, status: str) -> None:
        """Waits until everything is logged, at most as long as for storage."""
        if not self._thread.is_alive():
            return
        self.call(lambda logger: logger.finalize(status))
        self.call(lambda logger: isinstance(logger, WandbLogger) and logger.experiment.finish(int(status != "success")))
        self.call(None)
        self._thread.join(standard_patience_s())
        if self._thread.is_alive():
            self._report("it does not end")

    def _work(self) -> None:
        try:
            logger = BUILDERS[self._kind](self._run, self._settings)
        except Exception as error:  # noqa: BLE001 - printed
            self._report(error.__cause__ or error)
            return
        while (function := self._calls.get()) is not None:
            try:
                function(logger)
            except Exception as error:  # noqa: BLE001 - printed; the server may be back at the next call
                self._report(error.__cause__ or error)  # Lightning takes every fault for an unsupported value

    def _report(self, fault: object) -> None:
        if not self._reported:
            self._reported = True
            text = " ".join(str(fault).split()) or type(fault).__name__
            print(printable(f"{self._kind} fails: {text}; training continues, see metrics.jsonl"), file=sys.stderr)
