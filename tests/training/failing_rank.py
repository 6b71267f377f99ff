"""A training by Lightning's own launcher in which one rank fails: python failing_rank.py FOLDER FAULT RANK.

Trains as FOLDER/mapping.json says. At update 3 that rank meets an error of its own (FAULT error), or gets other weights
(FAULT weights).
"""

import json
import os
import sys
from pathlib import Path

import torch

from hgn import train
from hgn.schema import ConfigError
from hgn.training.module import TrainingModule


def main(folder, fault, failing):
    def fail(module, *_):
        if module.update == 3 and os.environ.get("LOCAL_RANK", "0") == failing:
            if fault == "error":
                raise ConfigError("this rank fails")
            with torch.no_grad():
                next(module.parameters()).view(-1)[0] += 1e-3

    TrainingModule.on_train_batch_start = fail
    try:
        return train.main(json.loads((folder / "mapping.json").read_text()))
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2


if __name__ == "__main__":
    if os.environ.get("PYTHON_EXEC"):
        sys.executable = os.environ["PYTHON_EXEC"]  # which starts the other ranks
    sys.exit(main(Path(sys.argv[1]), *sys.argv[2:]))
