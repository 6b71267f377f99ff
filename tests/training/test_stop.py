"""The end of a training on several processes after a signal to one of them."""

import json
import os
import signal
import subprocess
from typing import Any

from training.runs import train_mapping
from training.test_ddp import LAUNCHER_VARIABLES, PROGRAM, ROOT, load, output


def test_ranks_with_slow_updates_stop_at_the_next_one(data, monkeypatch, warm_python, tmp_path):
    """Ranks exchange stop requests by the time of the slowest one's updates. Their clocks may differ: one advances by
    1 ms here and the other one by 10 s at each look."""
    for name in LAUNCHER_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    options: dict[str, Any] = {"backend": "torch", "devices": 2, "maximum_updates": 40, "batch_scenes": 1}
    options |= {"monitor_rollout_frames": 0, "monitor_every": 1000}
    (tmp_path / "mapping.json").write_text(json.dumps(train_mapping(data, tmp_path / "run", **options)))
    (tmp_path / "faults.json").write_text(json.dumps([(0, 1, 12, signal.SIGTERM, "self")]))
    (tmp_path / "clock.json").write_text("[0.001, 10]")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PYTHON_EXEC": str(warm_python)}
    command = [str(warm_python), str(PROGRAM), str(tmp_path)]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert "trained 13 of 40 updates" in output(process)
    ends = [load(tmp_path / f"end_{rank}.pt") for rank in (0, 1)]
    assert [(end["update"], end["exit_code"]) for end in ends] == [(13, 128 + signal.SIGTERM)] * 2
