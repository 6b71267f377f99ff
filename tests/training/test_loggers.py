"""Tests the loggers of a training: their records, the run that a resumed training continues, and that their faults end
nothing. A class with Lightning's interface replaces W&B and MLflow; if these are installed, they are tested too.
"""

import functools
import sys
import threading
from typing import Any

import pytest
from lightning.pytorch.loggers.logger import Logger
from training.runs import metrics, train_mapping

from hgn import train
from hgn.schema import ConfigError
from hgn.system.patience import VARIABLE
from hgn.training import loggers


class Remembered(Logger):
    """Records its calls. Each method named in `faults` fails."""

    def __init__(self, faults=()):
        self.faults = faults
        self.calls: list[tuple[str, Any]] = []

    def take(self, method, *values):
        self.calls.append((method, values))
        if method in self.faults:
            raise ValueError("not supported") from ConnectionError("the server is away")  # as Lightning does

    name = version = property(lambda self: "remembered")
    log_metrics = functools.partialmethod(take, "metrics")
    log_hyperparams = functools.partialmethod(take, "settings")
    finalize = functools.partialmethod(take, "end")


@pytest.fixture
def stand_in(monkeypatch):
    """Puts stand-ins in the place of W&B's loggers, and returns them as they are made."""
    made: list[Remembered] = []
    monkeypatch.setitem(sys.modules, "wandb", loggers)  # only its presence matters

    def use(*faults):
        def build(run, settings):
            made.append(Remembered(faults))
            made[-1].take("build")
            made[-1].log_hyperparams(settings)
            return made[-1]

        monkeypatch.setitem(loggers.BUILDERS, "wandb", build)
        return made

    return use


def test_loggers_get_what_metrics_jsonl_gets(data, tmp_path, stand_in, capsys):
    """Each record at its update, the settings once, and the end; TensorBoard as ever. The default is
    TensorBoard, and without loggers a run has metrics.jsonl only."""
    made, run = stand_in(), tmp_path / "run"
    mapping = train_mapping(data, run, loggers=["tensorboard", "wandb"], monitor_rollout_frames=3, monitor_every=12)
    assert train.main(mapping) == 0
    (logger,) = made
    settings = [values[0] for method, values in logger.calls if method == "settings"]
    assert len(settings) == 1 and settings[0]["training"]["maximum_updates"] == 12
    logged = [values for method, values in logger.calls if method == "metrics"]
    records = [{key: value for key, value in record.items() if key != "time"} for record in metrics(run)]
    assert [{"update": step} | values for values, step in logged] == records
    assert next(values for method, values in logger.calls if method == "end") == ("success",)
    assert {path.name.split(".")[0] for path in (run / "tensorboard").iterdir()} == {"events"}  # no hparams.yaml
    assert not [thread for thread in threading.enumerate() if thread.name in loggers.BUILDERS]
    assert train.main(train_mapping(data, tmp_path / "none", loggers=[])) == 0
    assert "fails" not in capsys.readouterr().err
    assert len(made) == 1 and not (tmp_path / "none" / "tensorboard").exists() and metrics(tmp_path / "none")


@pytest.mark.parametrize("fault", ["build", "metrics", "end"])
def test_a_logger_that_fails_ends_nothing(data, tmp_path, stand_in, capsys, fault):
    """One line reports it, and the training and its metrics are those without the logger."""
    made = stand_in(fault)
    assert train.main(train_mapping(data, tmp_path / "run", loggers=["wandb"])) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "wandb" in line]
    assert len(told) == 1 and "the server is away" in told[0] and "metrics.jsonl" in told[0]
    assert [record["update"] for record in metrics(tmp_path / "run") if "loss" in record] == [4, 8, 12]
    if fault == "metrics":  # the others are given to it all the same, because the server may be back
        assert len([None for method, _ in made[0].calls if method == "metrics"]) > 2


def test_tensorboard_on_a_full_disk(data, tmp_path, monkeypatch, capsys):
    """One line reports the fault of TensorBoard's own thread, without a traceback, and the training ends as ever."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tensorboard.summary.writer.record_writer.RecordWriter.write", full)
    assert train.main(train_mapping(data, tmp_path / "run", loggers=["tensorboard"])) == 0
    lines = capsys.readouterr().err.splitlines()
    told = [line for line in lines if "tensorboard" in line or "No space" in line or "Traceback" in line]
    assert len(told) == 1 and "tensorboard fails: [Errno 28] No space left on device; training continues" in told[0]
    assert [record["update"] for record in metrics(tmp_path / "run") if "loss" in record] == [4, 8, 12]


def test_a_logger_that_hangs_delays_nothing(data, tmp_path, stand_in, monkeypatch, capsys):
    """No update waits for it. At the end the training waits for it as long as for storage."""
    made, released, waiting = stand_in(), threading.Event(), []
    monkeypatch.setenv(VARIABLE, "0.2")
    monkeypatch.setattr(loggers, "MOST_WAITING", 2)
    monkeypatch.setattr(Remembered, "log_metrics", lambda *_: (waiting.append(None), released.wait()))
    try:
        assert train.main(train_mapping(data, tmp_path / "run", loggers=["wandb"])) == 0
        assert len(waiting) == 1 and len(made) == 1
        told = [line for line in capsys.readouterr().err.splitlines() if "wandb" in line]
        assert len(told) == 1 and "2 calls wait" in told[0]
    finally:
        released.set()


def test_only_the_first_rank_logs(tmp_path, monkeypatch, stand_in):
    """Other ranks have no logger, not even TensorBoard."""
    made = stand_in()
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert loggers.build_loggers(("tensorboard", "wandb"), tmp_path, {}) == [] and made == []


@pytest.mark.parametrize("package", ["wandb", "mlflow"])
def test_a_missing_package_is_named_before_data_are_made(make_config, tmp_path, monkeypatch, package):
    """In one line with the command that installs it. A folder of that name, as W&B leaves one, is no package."""
    (tmp_path / package).mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    monkeypatch.delitem(sys.modules, package, raising=False)
    config, before = make_config(), set(tmp_path.iterdir())
    with pytest.raises(ConfigError, match=rf"training.loggers\[0\] must be .* pip install 'hgn\[{package}\]'"):
        train.main(train_mapping(config, tmp_path / "run", loggers=[package], generate=True))
    assert set(tmp_path.iterdir()) == before
    with pytest.raises(ConfigError, match=r"training.loggers\[0\] must be one of tensorboard, wandb, mlflow"):
        train.main(train_mapping(config, tmp_path / "run", loggers=["comet"]))


def stopped_and_resumed(data, run, name):
    for updates in (4, 8):
        options = {"loggers": [name], "maximum_updates": updates, "monitor_rollout_frames": 3}
        assert train.main(train_mapping(data, run, **options)) == 0
    return (run / f"{name}_id").read_text()


@pytest.mark.filterwarnings("ignore")
def test_wandb_continues_its_run(data, tmp_path, monkeypatch, capsys):
    """Offline, a resumed training has the run id of its first start; a training in another folder has its own."""
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_CONSOLE", "off")
    ids = [stopped_and_resumed(data, tmp_path / name, "wandb") for name in ("a", "b")]
    assert ids[0] != ids[1]
    for name, run_id in zip("ab", ids, strict=True):
        folders = [path.name for path in (tmp_path / name / "wandb").glob("offline-run-*")]
        assert folders and all(folder.endswith(run_id) for folder in folders)
    media = {path.suffix for path in (tmp_path / "a" / "wandb").rglob("media/**/*.*")}
    assert media == {".png", ".gif"}
    assert "metrics.jsonl" not in capsys.readouterr().err  # no fault was reported


@pytest.mark.filterwarnings("ignore")
def test_mlflow_continues_its_run(data, tmp_path, monkeypatch, capsys):
    """Without a server: both starts log to one run, also with changed settings, which MLflow refuses to overwrite."""
    client = pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", (tmp_path / "mlruns").as_uri())
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    client.set_tracking_uri(None)
    run_id = stopped_and_resumed(data, tmp_path / "run", "mlflow")
    history = client.MlflowClient((tmp_path / "mlruns").as_uri())
    assert [point.step for point in history.get_metric_history(run_id, "loss")] == [4, 8]
    stored = history.get_run(run_id)
    assert (stored.info.status, stored.info.run_name) == ("FINISHED", "run")
    assert stored.data.params["training/maximum_updates"] == "4"
    assert "metrics.jsonl" not in capsys.readouterr().err
    pictures = {path.path for path in history.list_artifacts(run_id, "pictures")}
    assert "pictures/rollout_000000008.gif" in pictures
