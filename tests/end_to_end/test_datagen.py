"""`python -m datagen` as a person runs it: real scenes, the real solver, Ctrl-C, and the same command again."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from processes import PATIENCE_S

from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [
    *(sys.executable, "-m", "datagen", "+experiment=obstacles", "out=made", "scenes=2", "mpm.device=cpu"),
    *("dataset.validation_scenes=1", "dataset.test_scenes=0", "dataset.frames=8", "dataset.workers=1"),
    *("scene.obstacle_count=2", "scene.obstacle_shapes=[cone,pyramid]", "scene.group_count=2"),
    "scene.materials=[water]",
]


def start(folder):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        COMMAND, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def test_interrupted_dataset_is_completed(tmp_path):
    """Ctrl-C after the first shard keeps it, bitwise; the same command makes the rest; a third run changes nothing."""
    process = start(tmp_path)
    folder = tmp_path / "made"
    deadline = time.monotonic() + PATIENCE_S
    while not (folder / "manifest.json").exists() or Manifest.load(folder).revision == 0:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130 and "run the same command to resume" in errors, errors
    first = (folder / "train-000000-000001.tar").read_bytes()

    for _ in range(2):
        process = start(tmp_path)
        _, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, errors
        assert errors.splitlines()[-1] == "made is complete: 2 train, 1 validation, 0 test episodes"
    assert errors.count("\n") == 1
    assert (folder / "train-000000-000001.tar").read_bytes() == first
    assert not list(folder.rglob("*.partial")) and not (folder / ".staging").exists()

    episodes = EpisodeStore(folder, "train").episodes
    assert len(episodes) == 2 and len({episode.seed for episode in episodes}) == 2
    for episode in episodes:
        assert episode.frame_count == 8 and episode.solver["counters"]["substeps"] > 0
        # at rest at first, then all of it falls freely: no obstacle or wall is near enough to touch most of it
        fall_N = (episode.position_TN3[3] - episode.position_TN3[0])[:, 1]
        assert np.isclose(np.median(fall_N), -0.5 * 9.8 * (3 / 60) ** 2, rtol=0.05)
        assert len(episode.obstacle_grid.cell_K3) > 0
