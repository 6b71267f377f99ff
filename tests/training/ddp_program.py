"""One rank of a distributed training, started by torchrun: python ddp_program.py FOLDER.

Trains as FOLDER/mapping.json says and keeps what this rank saw: FOLDER/gradients_RANK.pt of the first update,
FOLDER/end_RANK.pt with the weights, the update and the exit code, FOLDER/starts_RANK with the update of each start,
FOLDER/talk_RANK.json with the updates at which ranks talked of anything but gradients.
FOLDER/signals.json holds [restart, rank, update, signal, target] rows: in that start, that rank sends the signal at
that update, to itself (target self) or to torchrun (launcher).
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

import torch

from hgn import train
from hgn.training.module import TrainingModule
from hgn.training.torch_updates import TorchUpdates


def main(folder):
    mapping: dict[str, Any] = json.loads((folder / "mapping.json").read_text())
    rank, restart = int(os.environ["RANK"]), int(os.environ["TORCHELASTIC_RESTART_COUNT"])
    signals = {
        update: (int(os.environ.get("WARM_PARENT", os.getppid())) if target == "launcher" else os.getpid(), number)
        for in_start, of_rank, update, number, target in json.loads((folder / "signals.json").read_text())
        if (in_start, of_rank) == (restart, rank)
    }
    end: dict[str, Any] = {}
    update, talked = 0, set()

    def counted(function):
        def call(*arguments, **options):
            talked.add(update)
            return function(*arguments, **options)

        return call

    for name in ("all_gather", "all_reduce", "barrier", "broadcast", "broadcast_object_list"):
        setattr(torch.distributed, name, counted(getattr(torch.distributed, name)))

    step, start = TorchUpdates.step, TrainingModule.on_train_start

    def at_update(module, *_):
        nonlocal update
        update = module.update + 1

    def at_start(module):
        with (folder / f"starts_{rank}").open("a") as file:
            file.write(f"{module.update}\n")
        start(module)

    def before_step(updates, number):
        if number == 0:
            named = updates.trained.network.named_parameters()
            gradients = {f"network.{name}": parameter.grad.clone() for name, parameter in named}
            torch.save(gradients, folder / f"gradients_{rank}.pt")
        if number in signals:
            os.kill(*signals[number])
        step(updates, number)

    def at_end(module):
        end.update(weights=module.state_dict(), update=module.update)

    TrainingModule.on_train_start = at_start
    TrainingModule.on_train_batch_start = at_update
    TorchUpdates.step = before_step
    TrainingModule.on_train_end = at_end
    end["exit_code"] = train.main(mapping)
    torch.save(end, folder / f"end_{rank}.pt")
    (folder / f"talk_{rank}.json").write_text(json.dumps(sorted(talked)))
    return end["exit_code"]


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
