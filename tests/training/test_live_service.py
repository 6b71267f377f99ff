"""Training from a data set that a service makes and serves at the same time."""

import os
import signal
import subprocess
import threading
import time

import fsspec
import pytest
from processes import free_port, start_module, wait_until
from training.runs import metrics, train_mapping

import hgn.data.storage
import hgn.training.data_module
from datagen.pool.plan import scene_seed
from hgn import train
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.data.storage import TOKEN_VARIABLE
from hgn.training.checkpoint import read_checkpoint
from hgn.training.torch_updates import TorchUpdates

SCENES = 5


class Service:
    """The ballistic service in processes of its own, always on the same port."""

    def __init__(self, folder, log):
        self.port = free_port()
        self.folder, self.url, self._log = folder, f"http://127.0.0.1:{self.port}", log
        self.process: subprocess.Popen[bytes] | None = None

    def start(self):
        dataset = {"training_scenes": SCENES, "validation_scenes": 1, "test_scenes": 0, "frames": 6, "workers": 1}
        overrides = [f"dataset.{key}={value}" for key, value in dataset.items()]
        overrides += [f"out={self.folder}", f"port={self.port}"]
        with self._log.open("ab") as log:
            self.process = start_module("ballistic_service", *overrides, stdout=log, stderr=log)

    def kill(self):
        """Kills the service together with all its child processes."""
        if self.process is not None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            self.process = None


@pytest.fixture
def service(control, cache, tmp_path, monkeypatch):
    monkeypatch.setenv(TOKEN_VARIABLE, "correct-horse-battery")
    monkeypatch.setattr(hgn.data.storage, "_AWAY_S", 0.2)
    service = Service(tmp_path / "made", tmp_path / "service.log")
    yield service
    service.kill()


def test_service_restarted_midway(make_config, service, control, tmp_path, monkeypatch):
    """A trainer reads a growing data set over HTTP. The service is killed with all its processes and restarted. The
    training continues meanwhile with its present scenes, and then with new ones."""
    config = make_config(folder=service.url, training_scenes=SCENES, validation_scenes=1, test_scenes=0)
    run = tmp_path / "run"
    seen: dict[str, int] = {}
    held = control / f"hold-{scene_seed(0, 'train', 2, 0)}"
    held.touch()
    service.start()
    step = TorchUpdates.step
    monkeypatch.setattr(TorchUpdates, "step", lambda *given: (time.sleep(0.05), step(*given)))  # it mostly waits

    ended = threading.Event()

    def steer():
        try:
            wait_until(lambda: ended.is_set() or updates(run) >= 8)
            service.kill()
            held.unlink()
            seen["published"] = Manifest.load(service.folder).published("train")
            seen["killed at"] = updates(run)
            wait_until(lambda: ended.is_set() or updates(run) >= seen["killed at"] + 8)
            service.start()
            wait_until(lambda: ended.is_set() or any(record.get("episodes") == SCENES for record in metrics(run)))
        finally:
            if not ended.is_set():  # else it would end this process, which listens no more
                os.kill(os.getpid(), signal.SIGUSR1)

    steering = threading.Thread(target=steer)
    steering.start()
    try:
        options = {"maximum_updates": 10**6, "minimum_episodes": 1, "monitor_every": 8}
        code = train.main(train_mapping(config, run, **options))
    finally:
        ended.set()
        steering.join()
    log = (tmp_path / "service.log").read_text()
    assert code == 128 + signal.SIGUSR1, log
    lines = [record for record in metrics(run) if "loss" in record]
    assert [line["update"] for line in lines] == [4.0 * (i + 1) for i in range(len(lines))]
    assert lines[0]["episodes"] <= seen["published"] == 2
    assert lines[-1]["episodes"] == SCENES, log
    assert read_checkpoint(run / "checkpoints" / "last.ckpt")["hgn"]["updates"] >= lines[-1]["update"]
    cached = {path.stem for path in (tmp_path / "cache" / "shards").glob("*.tar")}
    assert cached >= {shard.sha256 for shard in EpisodeStore(service.folder, "train").manifest.shards_of("train")}


def test_stopped_while_its_service_is_away(make_config, make_dataset, tmp_path, cache, monkeypatch):
    """SIGTERM during a wait for an absent server ends the training immediately, after a checkpoint of all updates. The
    same command continues from it."""
    monkeypatch.setattr(hgn.training.data_module, "LOOK_S", 0.05)
    make_dataset(make_config())
    files = fsspec.filesystem("memory")
    files.put(str(tmp_path / "data"), "/leaving", recursive=True)
    real, opened, asked = EpisodeStore.read, [], []

    def gone(*arguments, **options):
        asked.append(1)
        os.kill(os.getpid(), signal.SIGTERM)
        raise ConnectionResetError("gone")

    def read_episode(store, index):
        opened.append(index)
        if len(opened) == 12:
            files.cat_file = gone
            for shard in cache.rglob("*.tar"):
                shard.unlink()
        return real(store, index)

    config = make_config(folder="memory://leaving")
    monkeypatch.setattr(EpisodeStore, "fetch_ahead", lambda store: None)
    monkeypatch.setattr(EpisodeStore, "read", read_episode)
    try:
        assert train.main(train_mapping(config, tmp_path / "run", monitor_every=100)) == 128 + signal.SIGTERM
    finally:
        files.__dict__.pop("cat_file", None)
    monkeypatch.undo()
    stopped = read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")["hgn"]["updates"]
    assert asked and 0 < stopped <= 5  # of 2 samples each
    monkeypatch.setenv("HGN_CACHE", str(tmp_path / "cache"))
    assert train.main(train_mapping(config, tmp_path / "run", monitor_every=100)) == 0


def updates(run):
    try:
        return int(metrics(run)[-1]["update"])
    except (FileNotFoundError, IndexError):
        return 0
