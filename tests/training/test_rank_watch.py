"""A rank that is stopped: the others end, and name it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from processes import completed
from training.runs import train_mapping

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("fault", "code", "message"),
    [("stop", 1, "ranks [1] must answer within 3 s"), ("term", 143, "the other ranks must answer after SIGTERM")],
)
def test_a_stopped_rank(data, tmp_path, fault, code, message):
    """Rank 0 waits for gradients of rank 1, which got SIGSTOP: it ends with a line after a while, or after SIGTERM."""
    options = {"devices": 2, "maximum_updates": 10**6}
    (tmp_path / "mapping.json").write_text(json.dumps(train_mapping(data, tmp_path / "run", **options)))
    launched = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "NODE_RANK", "SLURM_PROCID", "SLURM_NTASKS")
    environment = {key: value for key, value in os.environ.items() if key not in launched}
    process = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("stopped_rank.py")), str(tmp_path), fault],
        env=environment | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    run = completed(process)
    assert message in run.stdout, run.stdout[-4000:]
    assert run.returncode == code
