"""A folder with a data set, a run and a scene for commands, and checks of how they end."""

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from network.states import network_of, silent
from processes import exit_code
from training.runs import train_arguments

import datagen.__main__
import datagen.service.__main__
import tools.bench.command
import tools.error_vs_time.command
import tools.scaling.command
from datagen import solve, upload
from hgn import evaluate, export, play, rollout, train
from hgn.command import EXIT_INPUT
from hgn.config import DatagenConfig
from hgn.runtime.weights import WeightsInfo, load_weights, save_weights
from tools import curves, render
from tools.stability import network, solver

ROOT = Path(__file__).resolve().parents[2]
COMMANDS: dict[str, Callable[[dict[str, Any]], int]] = {
    "datagen": datagen.__main__.main,
    "service": datagen.service.__main__.main,
    "solve": solve.main,
    "upload": upload.main,
    "train": train.main,
    "export": export.main,
    "rollout": rollout.main,
    "evaluate": evaluate.main,
    "render": render.main,
    "play": play.main,
    "bench": tools.bench.command.main,
    "curves": curves.main,
    "error_vs_time": tools.error_vs_time.command.main,
    "scaling": tools.scaling.command.main,
    "stability_network": network.main,
    "stability_solver": solver.main,
}
SCENE = """
obstacles:
  - {shape: cone, size: 0.3, position: [0.5, 0.4, 0.5]}
groups:
  - {shape: cube, size: 0.05, position: [0.5, 0.8, 0.5], material: water}
"""


@dataclass
class Place:
    """A folder with a data set, a finished run, its weights and a scene file; all paths are relative to it."""

    folder: Path
    config: DatagenConfig

    def path(self, name):
        return self.folder / name

    def edit_scene(self, old, new):
        self.path("scene.yaml").write_text(SCENE.replace(old, new))

    def damage(self, split, how):
        for shard in self.path("data").glob(f"{split}-*.tar"):
            how(shard)

    def damage_run(self, how):
        for path in self.path("run/checkpoints").iterdir():
            how(path)

    def weights(self, materials=None, **changes):
        """Weights of another kind in the place of the run's."""
        path = self.path("weights.safetensors")
        network, info = load_weights(path)
        if materials is not None:
            network = network_of(torch.float32, materials=materials)
        save_weights(path, network, replace(info, network=network.config, **changes))

    def checkpoint(self, change, part="hgn"):
        """A file of torch.save beside the run's checkpoint, of which a part is another."""
        checkpoint = torch.load(self.path("run/checkpoints/last.ckpt"), weights_only=True)
        change(checkpoint[part])
        torch.save(checkpoint if checkpoint["hgn"] else {"state_dict": {}}, self.path("foreign.ckpt"))

    def network(self, **changes):
        self.checkpoint(lambda ours: ours["network"].update(changes))

    def accelerate(self, by):
        """Puts weights in the place of those that throw all particles out of the domain."""
        network = silent(network_of(torch.float32))
        network.normaliser.set("acceleration", torch.full((3,), by), torch.ones(3), 0.0)
        save_weights(self.path("weights.safetensors"), network, WeightsInfo(network.config, 60.0, 1 / 64))

    def train(self, *arguments, run="run"):
        return ["+experiment=obstacles", *train_arguments(self.config, self.path(run)), *arguments]


def content(folder):
    """Every file below a folder, by size and time."""
    files = ((path, path.stat()) for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): (status.st_size, status.st_mtime_ns) for path, status in files}


def truncate(path):
    path.write_bytes(path.read_bytes()[:-700])


def alter(path):
    data = bytearray(path.read_bytes())
    data[700] ^= 1
    path.write_bytes(data)


def refused(command, arguments, capsys, monkeypatch):
    """Runs a command as its module would; returns the exit code and the one error line."""
    capsys.readouterr()
    code = exit_code(COMMANDS[command], command, arguments, monkeypatch)
    lines = capsys.readouterr().err.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    # a progress bar may have begun; after the error there is nothing
    assert errors == lines[-1:] and "Traceback" not in "".join(lines), lines
    assert sys.argv == [command, *arguments] and "HYDRA_FULL_ERROR" not in os.environ
    return code, errors[0]


def check(place, command, arguments, message, capsys, patch):
    """The command is refused with that message, changes no file and leaves no half-written one."""
    before = content(place.folder)
    code, line = refused(command, arguments, capsys, patch)
    assert code == EXIT_INPUT and message in line, line
    after = content(place.folder)
    assert {name: after.get(name) for name in before} == before
    assert not [name for name in after if name.endswith(".partial") or name.startswith(("made", "other/checkpoints"))]


ROLLOUT = ["weights=weights.safetensors", "scene=scene.yaml", "out=made/rollout.vtkhdf", "frames=3"]
EPISODE = [*ROLLOUT, "scene=null", "data=data", "episode=validation-000000"]
EVALUATE = ["weights=weights.safetensors", "data=data", "rollout_frames=3", "json=made/errors.json"]
EXPORT = ["checkpoint=foreign.ckpt", "out=weights.safetensors"]
FRESH = ["out=made", "frozen=[weights.safetensors]"]
OF_THE_RUN = "checkpoint=run/checkpoints/last.ckpt"
