"""A training by Lightning's own launcher whose rank 1 is stopped: python stopped_rank.py FOLDER FAULT.

Trains as FOLDER/mapping.json says. At update 3 rank 1 stops itself, with FAULT term after a SIGTERM to rank 0.
"""

import json
import os
import signal
import sys
from pathlib import Path

import hgn.training.watch
from hgn import train
from hgn.training.module import TrainingModule


def main(folder, fault):
    def stop(module, *_):
        if module.update == 3 and os.environ.get("LOCAL_RANK", "0") == "1":
            if fault == "term":
                os.kill(os.getppid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGSTOP)

    TrainingModule.on_train_batch_start = stop
    hgn.training.watch.BEAT_S = 0.2
    setattr(hgn.training.watch, "GRACE_S" if fault == "term" else "SILENCE_S", 3.0)
    return train.main(json.loads((folder / "mapping.json").read_text()))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2]))
