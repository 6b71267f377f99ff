"""Runs one rank of a distributed training: python ddp_program.py FOLDER, started by torchrun or Lightning's launcher.

FOLDER/mapping.json contains the settings. FOLDER/faults.json contains rows [restart, rank, update, fault, target]: in
this start the rank sends a signal (its number) at this update to itself (target self) or to torchrun (launcher), raises
an error ("error"), lacks its data ("storage"), or gets other weights ("weights"). FOLDER/stopped_RANK is the process
that SIGSTOP stops. The optional FOLDER/watch.json contains constants of hgn.training.watch. Ranks exchange stop
requests at every tenth update, or as in FOLDER/clock.json, which contains the seconds between two times that a rank's
stopper reads. The program writes FOLDER/gradients_RANK.pt of the first update; FOLDER/end_RANK.pt with the weights, the
update and the exit code; FOLDER/starts_RANK with the update of each start; FOLDER/talk_RANK.json with the updates at
which ranks exchanged anything but gradients; and FOLDER/recorder_RANK.json with the flight recorder's variables when
the ranks met.
"""

import json
import math
import os
import signal
import sys
import time
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

import hgn.training.callbacks
import hgn.training.watch
from hgn import train
from hgn.data.storage import StorageError
from hgn.schema import ConfigError
from hgn.training.module import TrainingModule
from hgn.training.torch_updates import TorchUpdates


def main(folder):
    mapping: dict[str, Any] = json.loads((folder / "mapping.json").read_text())
    rank = int(os.environ.get("RANK", os.environ.get("LOCAL_RANK", "0")))
    restart = int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))
    if (folder / "watch.json").exists():
        for name, seconds in ({"BEAT_S": 0.2} | json.loads((folder / "watch.json").read_text())).items():
            setattr(hgn.training.watch, name, seconds)
    hgn.training.callbacks.Stopper.AGREE_S = math.inf
    if (folder / "clock.json").exists():
        hgn.training.callbacks.Stopper.AGREE_S = 1.0
        times = count(0, json.loads((folder / "clock.json").read_text())[rank])
        clock: Any = SimpleNamespace(monotonic=lambda: next(times), time=time.time)
        hgn.training.callbacks.time = clock
    rows = json.loads((folder / "faults.json").read_text())
    faults = {update: rest for in_start, of_rank, update, *rest in rows if (in_start, of_rank) == (restart, rank)}
    end: dict[str, Any] = {}
    update, talked = 0, set()

    def counted(function):
        def call(*arguments, **options):
            talked.add(update)
            return function(*arguments, **options)

        return call

    for name in ("all_gather", "all_reduce", "barrier", "broadcast", "broadcast_object_list"):
        setattr(torch.distributed, name, counted(getattr(torch.distributed, name)))

    meet = torch.distributed.init_process_group

    def met(*arguments, **options):
        recorder = {name: value for name, value in os.environ.items() if name.startswith(("TORCH_FR", "TORCH_NCCL"))}
        (folder / f"recorder_{rank}.json").write_text(json.dumps(recorder))
        meet(*arguments, **options)

    torch.distributed.init_process_group = met

    step, start = TorchUpdates.step, TrainingModule.on_train_start

    def at_update(module, *_):
        nonlocal update
        update = module.update + 1
        if faults.get(module.update, (None,))[0] == "storage":
            raise StorageError("the data stay away")

    def at_start(module):
        with (folder / f"starts_{rank}").open("a") as file:
            file.write(f"{module.update}\n")
        start(module)

    def before_step(updates, number):
        parameters = dict(updates.trained.network.named_parameters())
        if number == 0:
            gradients = {f"network.{name}": parameter.grad.clone() for name, parameter in parameters.items()}
            torch.save(gradients, folder / f"gradients_{rank}.pt")
        fault, target = faults.get(number, (None, None))
        if fault == "error":
            raise ConfigError("this rank fails")
        if fault == "weights":
            with torch.no_grad():
                next(iter(parameters.values())).view(-1)[0] += 1e-3
        elif fault is not None:
            if fault == signal.SIGSTOP:
                (folder / f"stopped_{rank}").write_text(str(os.getpid()))
            launcher = int(os.environ.get("WARM_PARENT", os.getppid()))
            os.kill(launcher if target == "launcher" else os.getpid(), fault)
        step(updates, number)

    def at_end(module):
        end.update(weights=module.state_dict(), update=module.update)

    TrainingModule.on_train_start = at_start
    TrainingModule.on_train_batch_start = at_update
    TorchUpdates.step = before_step
    TrainingModule.on_train_end = at_end
    try:
        end["exit_code"] = train.main(mapping)
    except (ConfigError, ConnectionAbortedError) as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, ConfigError) else 1
    torch.save(end, folder / f"end_{rank}.pt")
    (folder / f"talk_{rank}.json").write_text(json.dumps(sorted(talked)))
    return end["exit_code"]


if __name__ == "__main__":
    if os.environ.get("PYTHON_EXEC"):
        sys.executable = os.environ["PYTHON_EXEC"]  # which starts the other ranks
    sys.exit(main(Path(sys.argv[1])))
