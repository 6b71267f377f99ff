"""Kernels stay within the memory of living tensors: in buffers that are too small, at raw addresses of tables."""

import gc
from dataclasses import replace

import pytest
import torch
from kernels.engines import device, engine_of, inference_of, run_forward
from kernels.memory import Alive, checked_memory
from kernels.test_pushforward import placed, pools_of, values_of
from kernels.test_update import HISTORY, episode, updates_of
from network.states import network_of, random_state
from training.test_noise import episode as falling_episode
from training.test_pushforward import training_of
from training.test_symmetry import scene_with_obstacles
from triton.runtime.errors import InterpreterError

from hgn.kernels.grid.op import OUT_OF_BOX, OVERFLOW
from hgn.kernels.update.op import DeviceSample

pytestmark = pytest.mark.usefixtures("large_tiles")

cpu_only = pytest.mark.skipif(device().type != "cpu", reason="the checker sees what the interpreter does")


@cpu_only
def test_the_checker_sees_what_has_gone():
    """A window whose episode is no longer alive is noticed before it is read."""
    network = network_of(width=16, levels=1, message_passing_steps=1, cell_size=0.1)
    updates = updates_of(network, 1, capacities=(64,))
    made, _ = episode(1, 5, False)
    gone = replace(made, position_TN3=made.position_TN3.clone())
    updates.particles, updates._corners = 16, (torch.zeros(3), torch.ones(3))
    for sample in (made, gone):
        updates._upload([[(sample, 1, 3)]], [1e-3])
        updates._build()
        if sample is made:
            with checked_memory():
                updates._assemble()
    del gone, sample
    gc.collect()
    with checked_memory(), pytest.raises(InterpreterError, match=r"assemble_batch: load at .* that are no"):
        updates._assemble()


@pytest.mark.parametrize("training", [True, False])
def test_a_pass_without_room_stays_within_memory(training):
    """If only the coarse level has too little capacity, cells of the fine level have no parent. The pass then has no
    effect and reads no other memory. The same holds for particles outside the cell box, or without a position."""
    network = network_of(width=16, levels=2, message_passing_steps=1, cell_size=0.05)
    state = random_state((4, 3), obstacles=False, spread=0.9)
    precision = "fp32"
    engine = engine_of(network, state, precision, capacities=(64, 8))
    state.position_N3[5] = 40.0
    state.position_N3[6] = float("nan")
    with checked_memory() as checked:
        passes = engine if training else inference_of(engine, network)
        run_forward(passes, network, state, torch.zeros(2, 3))
        if training:
            engine.output_gradient.fill_(1.0)
            engine.backward()
    needed, capacities = engine.grid.needed_L.tolist(), engine.grid.capacities
    assert needed[0] <= capacities[0] and needed[1] > capacities[1]
    assert int(engine.grid.status) == OVERFLOW | OUT_OF_BOX
    assert (engine.grid.parent(0)[: needed[0]] < 0).any()
    assert len(checked.launches) > 5 or device().type != "cpu"


@cpu_only
def test_pushforward_stays_within_memory():
    """After simulations of various sizes, some with lost scenes, every address in an update points to a whole window
    (or all materials and obstacles) of an existing tensor. Simulations in the same buffers launch the captured programs
    again, on the same memory."""
    network = network_of(torch.float32, width=16, levels=1, message_passing_steps=1, cell_size=0.1)
    scenes = [scene_with_obstacles(0, 4), falling_episode(3, seed=1), scene_with_obstacles(3, 14)]
    training = training_of(precision="fp32", pushforward_frames=2, pushforward_fraction=0.9)
    own, _ = pools_of(network, training)
    own._scenes.values = values_of(network)
    episodes = [placed(scene, network) for scene in scenes]
    updates = updates_of(network, 4)
    frames: dict[object, set[tuple]] = {}
    for turn, (starts, mean) in enumerate([((0, 1), 0.0), ((1, 1), float("nan")), ((2, 0), 0.0)]):
        network.normaliser.acceleration_mean.fill_(mean)
        with checked_memory() as checked:
            own.refresh([(episodes[i], i) for i in starts])
        last = max(i for i, (name, _) in enumerate(checked.launches) if name == "mark_cells")
        frames.setdefault(own._scenes._stepper, set()).add(tuple(checked.launches[last:]))
        samples = [DeviceSample(episodes[i % 3], i, 7 * i + turn) for i in range(4)]
        mixed = [own.replaced(samples, 5 * turn + i) for i in range(3)]
        pool = {sample.episode for sample, _ in own._samples}
        assert any(sample.episode in pool for update in mixed for sample in update) or not pool
        updates._upload(mixed, [0.0] * 3)
        alive = Alive()
        for row in updates._samples[:3].flatten(0, 1).tolist():
            address, count, _, _, materials, *_, buckets, keys, normals, mask, _ = row
            assert alive.holds(address, (HISTORY + 2) * count * 12) and alive.holds(materials, 4 * count)
            if buckets:
                assert alive.holds(buckets, 4 * (mask + 2)) and alive.holds(keys, 8) and alive.holds(normals, 12)
    assert len(frames) == 2 and all(len(launches) == 1 for launches in frames.values())
