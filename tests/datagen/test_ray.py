"""Generation on a Ray cluster. Skipped where the optional extra `ray` is not installed."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import pytest
from processes import BALLISTIC_PATH, PATIENCE_S

from datagen.pool.ray_workers import RayWorker, RayWorkerFactory
from datagen.pool.shard import STAGING_NAME
from datagen.pool.worker import Backend
from datagen.pool.worker_plan import WorkerPlan, plan_cluster, plan_workers
from hgn.config import DatagenConfig, DatasetConfig, MpmConfig
from hgn.schema import ConfigError


def test_lost_node(control, tmp_path):
    """Two nodes generate; one is killed midway; the set completes, bitwise the one that a single process makes, and no
    scene is blamed."""
    pytest.importorskip("ray")
    (control / "slow").touch()
    environment = {"PYTHONPATH": BALLISTIC_PATH, "RAY_USAGE_STATS_ENABLED": "0", "RAY_DEDUP_LOGS": "0"}
    program = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("ray_program.py")), "data"],
        cwd=tmp_path,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert program.returncode == 0, program.stderr
    report = json.loads(program.stdout.splitlines()[-1])
    assert report["finished"] and report["episodes"] == 12
    assert "a worker died" in report["messages"][0] and "on node" in report["messages"][0]
    assert report["differences"] == []


@pytest.mark.parametrize(("fault", "deadline_s", "staged"), [(4, 1e9, [0, 2]), (2, 1e9, [0]), (4, 0.0, [])])
def test_finished_answers_are_kept_at_the_end(tmp_path, fault, deadline_s, staged):
    """A dismissed actor's finished answers are staged, until the deadline or its death. Others are not awaited."""
    answers = [("packed", "train-000000", b"0"), ("failed", "train-000001", "why"), ("packed", "train-000002", b"2")]

    class Ray:
        exceptions = SimpleNamespace(RayError=LookupError)

        def wait(self, given, timeout, fetch_local):
            ready = [number for number in given if number < 3][:1]
            return ready, [number for number in given if number not in ready]

        def get(self, number):
            return answers[number] if number != fault else {}["dead"]

    (tmp_path / STAGING_NAME).mkdir()
    worker = RayWorker(Ray(), mock.Mock(), tmp_path)
    worker.answers = [0, 1, 2, 3]
    worker.dismiss(deadline_s and time.monotonic() + deadline_s)
    assert sorted(path.name for path in (tmp_path / STAGING_NAME).iterdir()) == [f"train-{n:06d}.tar" for n in staged]


def test_no_cluster(make_config, monkeypatch):
    """Without Ray, or without a cluster, the message contains the remedy."""
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"needs Ray, which is not installed; pip install 'hgn\[ray\]'"):
        RayWorkerFactory(make_config(pool="ray"), Backend())


def test_cluster_plans():
    """A solver for two cores of a node, or for a GPU; settings win."""
    default = DatagenConfig()
    assert plan_cluster(default, [{"CPU": 4.0}, {"CPU": 3.0}, {}]) == WorkerPlan(3, 2, 3, 1, 1)
    assert plan_cluster(default, [{"CPU": 1.0}, {"CPU": 8.0}]) == WorkerPlan(9, 1, 9, 1, 1)
    assert plan_cluster(default, [{"CPU": 8.0, "GPU": 2.0}] * 2) == WorkerPlan(4, None, 4, 416, 416)
    long = DatagenConfig(dataset=DatasetConfig(frames=3000))  # a node's solvers share its memory, as on one machine
    node = {"CPU": 16.0, "GPU": 8.0, "memory": 64e9}
    alone = plan_workers(long, tuple("01234567"), 16, 64e9)
    assert plan_cluster(long, [{"CPU": 4.0, "memory": 4e9}, node]).scenes_per_launch == alone.scenes_per_launch < 416
    few = DatagenConfig(dataset=DatasetConfig(workers=1), mpm=MpmConfig(device="cpu"))
    assert plan_cluster(few, [{"CPU": 8.0, "GPU": 2.0}]) == WorkerPlan(1, 2, 1, 1, 1)
