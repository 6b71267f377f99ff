"""One rank of a distributed training, started by torchrun: python ddp_program.py FOLDER.

Trains as FOLDER/mapping.json says and keeps what this rank saw: FOLDER/gradients_RANK.pt of the first update,
FOLDER/end_RANK.pt with the weights, the update and the exit code. Where FOLDER/signal.json holds
[rank, update], that rank alone gets SIGTERM at that update.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import torch

from hgn import train
from hgn.training.module import TrainingModule


def main(folder: Path) -> int:
    mapping: dict[str, Any] = json.loads((folder / "mapping.json").read_text())
    signalled = json.loads((folder / "signal.json").read_text()) if (folder / "signal.json").exists() else None
    rank = int(os.environ["RANK"])
    end: dict[str, Any] = {}

    def before_step(module: TrainingModule, optimizer: torch.optim.Optimizer) -> None:
        if module.global_step == 0:
            gradients = {name: parameter.grad.clone() for name, parameter in module.named_parameters()}
            torch.save(gradients, folder / f"gradients_{rank}.pt")
        if signalled == [rank, module.global_step]:
            os.kill(os.getpid(), signal.SIGTERM)

    def at_end(module: TrainingModule) -> None:
        end.update(weights=module.state_dict(), update=module.global_step)

    TrainingModule.on_before_optimizer_step = before_step
    TrainingModule.on_train_end = at_end
    end["exit_code"] = train.main(mapping)
    torch.save(end, folder / f"end_{rank}.pt")
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
