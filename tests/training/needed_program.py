"""Launches of an update and of a pushforward simulation on small episodes, under a driver that needs no GPU.

Prints for each choice of own physics, and episodes without and with a moving obstacle, a line with the numbers of
kernels of both and the names of those that were not compiled ahead, of the update before a bar."""

from dataclasses import replace

import torch
from kernels.cases import swept
from no_gpu import use_h100

from hgn.config import NetworkConfig, SceneConfig, TrainConfig, TrainingConfig
from hgn.kernels.moving import NONE_MOVES, EpisodeMoving
from hgn.kernels.triton_compat import noted_launches
from hgn.kernels.update.op import DeviceEpisode, DeviceSample, Updates
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime import triton_stepper
from hgn.scene.material import MATERIALS
from hgn.scene.symmetry import Symmetry
from hgn.step_config import StepConfig
from hgn.training.precompile import launches_of
from hgn.training.triton_pushforward import TritonScenes

OWN = ("friction", "parameters", "elastic", "moving")
CPU = torch.device("cpu")


def launches_of_training(config, moves):
    """The launches of an update, and with those of a simulation, on tensors that exist."""
    network = HierarchicalGraphNetwork(config.network)
    network.step = config.step
    training, cell_size = config.training, config.scene.cell_size
    own = EpisodeMoving.of((swept(8, cells=20_000),), 1 / 60, config.network, CPU) if moves else NONE_MOVES
    position_TN3, material_N = torch.rand(20, 40, 3), torch.zeros(40, dtype=torch.int32)
    episode = DeviceEpisode(position_TN3, material_N, None, (1.0, 1.0, 1.0), symmetries=(Symmetry(),), moving=own)
    with noted_launches() as launches:
        updates = Updates(network, training, cell_size, "fp16", loss_sum=torch.zeros(2), counters=torch.zeros(5))
        updates.average = torch.zeros_like(updates.values)
        updates._prepare([[DeviceSample(episode, 3, seed) for seed in range(training.batch_scenes)]], [1e-3])
        updates.launches()
        update = dict(launches)
        scenes = TritonScenes(network, training, cell_size, "fp16")
        scenes.values = updates.values
        state = scenes._state([(episode, 3)])
        scenes._begun([episode], state).frame_launches()
    return update, launches


use_h100()
triton_stepper.TritonStepper.require_parity = lambda *_: None  # no launch is made
training = TrainingConfig(batch_scenes=2, precision="fp16", symmetry="gravity", ema_decay=0.9)
training = replace(training, pushforward_fraction=0.5, pushforward_scenes=3)
for own in (OWN[:0], OWN[:1], OWN[:2], OWN[:3], OWN):
    network = NetworkConfig("hgn", inputs="local", obstacle_distance=True, own_physics=own, materials=MATERIALS)
    network = replace(network, width=16, levels=2, message_passing_steps=1)
    step = StepConfig(0.0 if own else 0.3, (0.02, 0.04), 1e-3)
    config = TrainConfig(SceneConfig(own_physics=own), network=network, training=training, step=step)
    ahead = launches_of(config, False, (80, (400, 200)))
    for moves in (False, True)[: 1 + ("moving" in own)]:
        update, both = launches_of_training(config, moves)
        missing = [[f.__name__ for key, (f, _) in part.items() if key not in ahead] for part in (update, both)]
        print(*own, f"moves={moves}:", len(update), len(both), *missing[0], "|", *missing[1], flush=True)
