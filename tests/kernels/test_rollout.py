"""The simulation loop on the device against the plain one."""

import gc
import itertools
import weakref
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from kernels.engines import device
from kernels.memory import living_tensors
from network.barrier_scenes import crossings, square
from network.states import network_of, on_device, random_state
from runtime.scenes import random_scene

from hgn.config import NetworkConfig
from hgn.kernels.grid.op import DeviceGrid, Window
from hgn.kernels.scene_tables import SceneTable
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime import triton_stepper
from hgn.runtime.divergence import DivergedError
from hgn.runtime.live import LiveSimulation
from hgn.runtime.parity import relative_error
from hgn.runtime.rollouts import simulate_scenes
from hgn.runtime.simulation import Simulation, on_host
from hgn.runtime.simulator import Simulator
from hgn.runtime.triton_stepper import TritonStepper, first_capacities
from hgn.runtime.weights import find_weights, load_weights
from hgn.schema import ConfigError

pytestmark = pytest.mark.usefixtures("large_tiles")


def scene(particles, seed=0, **changes):
    return random_scene(particles, seed, **({"domain_size": (0.4, 0.4, 0.4)} | changes))


def network(levels=1, **changes):
    return network_of(torch.float32, width=16, levels=levels, message_passing_steps=1, **changes).to(device())


def path_of(stepper, frames):
    """Positions [T, N, 3] of the next frames."""
    return np.concatenate([on_host(block_TN3) for block_TN3, _ in stepper.blocks(frames)])


def spreading():
    """A network whose particles need more cells from frame to frame, and five of them."""
    fast = network()
    fast.normaliser.acceleration_std.fill_(0.03)
    return fast, Simulator(fast, 60.0, "torch").start([scene(5)])


@pytest.mark.parametrize("changes", [{}, {"inputs": "relative", "rest_threshold": 2.0}])
def test_frames_are_those_of_the_plain_loop(changes):
    """Two scenes at once, of different gravity, move as in the plain simulator, frame by frame, and each frame is
    announced once."""
    scenes, seen = [scene(5), scene(3, 1, gravity=(3.0, -1.0, 2.0))], []
    expected = Simulator(network(2, **changes), 60.0, "torch").rollout(scenes, 3)
    found = Simulator(network(2, **changes), 60.0, "triton", "fp32").rollout(scenes, 3, seen.append)
    assert seen == [1, 2]
    for path_TN3, expected_TN3 in zip(found, expected, strict=True):
        assert path_TN3.shape == expected_TN3.shape and path_TN3.dtype == np.float32
        np.testing.assert_allclose(path_TN3, expected_TN3, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "changes", [{"wall_clearance": (0.06, 0.26)}, {"wall_clearance": (0.06, 0.2), "dimensions": 2}]
)
def test_walls_hold(changes):
    """Particles that are thrown about stay between the walls, as in the plain simulator, whose histories they have too;
    in two dimensions z has no walls. Some begin beyond them, and come no nearer."""
    scenes = [replace(scene(6, seed), dimensions=changes.get("dimensions", 3)) for seed in (0, 1)]
    near, far = changes["wall_clearance"]
    motions = []
    for backend in ("torch", "triton"):
        walled = network(**changes)
        walled.normaliser.acceleration_std.fill_(0.02)
        simulator = Simulator(walled, 60.0, backend, "fp32")
        state = simulator.start(scenes)
        with simulator.simulation(state) as simulation:
            path_TN3, last = simulation.run(3), simulation.state
            motions.append((path_TN3, *(x.numpy(force=True) for x in (last.position_N3, last.velocity_NM3))))
        begin_N3 = state.position_N3.numpy(force=True)
        walls = slice(changes.get("dimensions", 3))
        assert (path_TN3[..., walls] >= np.minimum(begin_N3, near)[..., walls] - 1e-7).all()
        assert (path_TN3[..., walls] <= np.maximum(begin_N3, 0.4 - far)[..., walls] + 1e-7).all()
        assert ("dimensions" in changes) == bool((path_TN3[..., 2] < np.minimum(begin_N3, near)[:, 2] - 1e-3).any())
    held_N3 = motions[0][2][:, 0] == 0
    assert held_N3.any() and not held_N3.all()
    for expected, found in zip(*motions, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6)


def crossed(*places):
    """Corners of two sheets that cross at each place."""
    return np.concatenate([square(at, axis, 0.3) for at in places for axis in (0, 1)])


def thrown(backend, **changes):
    """A simulator of a network that throws particles about."""
    wild = network(**changes)
    wild.normaliser.acceleration_std.fill_(0.02)
    return Simulator(wild, 60.0, backend, "fp32")


@pytest.mark.parametrize("walls", [None, (0.06, 0.2)])
def test_obstacles_hold(walls):
    """Particles that are thrown about pass no obstacle, as in the plain simulator, whose histories they have too. In
    the scene beside them, which has none, particles pass there."""
    scenes = [scene(12, seed) for seed in (0, 1, 2)]
    corner_F33 = crossed((0.1, 0.1, 0.1))
    held_scenes = [replace(scenes[i], corners=lambda: corner_F33) if i != 1 else scenes[i] for i in range(3)]
    motions = []
    for backend, clearance in (("torch", None), ("torch", 2e-3), ("triton", 2e-3)):
        simulator = thrown(backend, wall_clearance=walls, obstacle_clearance=clearance)
        state = simulator.start(held_scenes)
        with simulator.simulation(state) as simulation:
            path_TN3, last = simulation.run(3), simulation.state
            motions.append((path_TN3, *(x.numpy(force=True) for x in (last.position_N3, last.velocity_NM3))))
        whole_TN3 = np.concatenate([state.position_N3.numpy(force=True)[None], path_TN3]).astype(np.float64)
        passed_S = [
            sum(crossings(*ways, corner_F33) for ways in itertools.pairwise(whole_TN3[:, 12 * i : 12 * i + 12]))
            for i in range(3)
        ]
        assert passed_S[1] > 0 and (passed_S[0] + passed_S[2] > 4 if clearance is None else passed_S[::2] == [0, 0])
    free, *both = motions
    changed_N = (free[0] != both[0][0]).any((0, 2))
    assert 4 < changed_N.sum() < 36
    for expected, found in zip(*both, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6)


def test_obstacles_that_hold_change():
    """A simulation that began among no obstacles goes on with others, captured once, and with none again; what is
    given it replaces those of the state. The frames are those of new simulations, to the rounding of a GPU's sums."""
    changes = {"obstacle_clearance": 2e-3}
    places = ((0.1, 0.1, 0.1), (0.08, 0.12, 0.1))
    scenes = [scene(12), *(replace(scene(12), corners=partial(crossed, at)) for at in places)]
    simulator = thrown("triton", **changes)
    states = [simulator.start([each]) for each in scenes]
    paths = [thrown("triton", **changes).rollout([each], 3)[0][1:] for each in scenes]
    assert all(abs(paths[i] - paths[i + 1]).max() > 1e-3 for i in (0, 1))
    same = partial(np.testing.assert_allclose, rtol=0, atol=1e-7)
    rollout = TritonStepper(simulator.network, states[0], "fp32")
    for index in (0, 1, 2, 0):
        assert rollout.take(states[index])
        same(path_of(rollout, 2), paths[index])
    given = SceneTable.of_barriers(states[2].barriers, 1, device())
    rollout = TritonStepper(simulator.network, states[1], "fp32", barriers=given)
    same(path_of(rollout, 2), paths[2])
    rollout.begin(states[1])
    same(path_of(rollout, 2), paths[2])


def test_obstacles_that_hold_stay(monkeypatch):
    """A simulation that goes on among the same barriers makes no other table of them, with others it does once."""
    simulator = thrown("triton", obstacle_clearance=2e-3)
    state, other = (
        simulator.start([replace(scene(12), corners=partial(crossed, at))])
        for at in ((0.1, 0.1, 0.1), (0.08, 0.12, 0.1))
    )
    hashed, real = [], SceneTable.of_barriers
    monkeypatch.setattr(
        SceneTable, "of_barriers", lambda barriers, *rest: hashed.append(barriers) or real(barriers, *rest)
    )
    rollout = TritonStepper(simulator.network, state, "fp32")
    for next_state in (state, replace(state, gravity_S3=2 * state.gravity_S3), other, other, state):
        assert rollout.take(next_state)
    assert [barriers is state.barriers for barriers in hashed] == [True, False, True]


def test_divergence_is_seen_through_walls():
    """What is no number, or would come farther from the domain than its own size, ends the simulation at the frame and
    with the message of backend torch without walls."""
    for value in (float("nan"), 0.9):
        messages = []
        for backend, walls in (("torch", None), ("torch", (0.01, 0.01)), ("triton", (0.01, 0.01))):
            wild = network(wall_clearance=walls)
            wild.normaliser.acceleration_mean.fill_(value)
            wild.normaliser.acceleration_std.fill_(0.0)
            with pytest.raises(DivergedError) as caught:
                Simulator(wild, 60.0, backend).rollout([scene(4)], 4)
            messages.append(str(caught.value))
        assert len(set(messages)) == 1 and "diverged at frame 1: 4 of 4 particles" in messages[0]


def test_free_flight_is_not_refused():
    """What relative inputs put out in free flight is rounding alone, which differs as a whole; both loops fall with
    gravity to 1e-3 of it. A network whose weights differ is still refused where something happens."""
    thrown = scene(40, low=0.45, gravity=(0.0, -5.0, 0.0), domain_size=(1.0, 1.0, 1.0))
    thrown = replace(thrown, velocity_N3=np.full((40, 3), 1.7, np.float32))
    paths = [
        Simulator(network(2, inputs="relative"), 60.0, name, "fp16").rollout([thrown], 4)[0].astype(np.float64)
        for name in ("torch", "triton")
    ]
    for path_TN3 in paths:
        falls_T3 = np.diff(path_TN3, 2, axis=0).mean(axis=1) * 3600
        np.testing.assert_allclose(falls_T3, np.broadcast_to(thrown.gravity, falls_T3.shape), rtol=0, atol=5e-3)
    stirred = Simulator(network(2, inputs="relative"), 60.0, "torch").start([scene(40)])
    rollout = TritonStepper(network(2, inputs="relative"), stirred, "fp16", (512, 64))
    rollout.require_parity(network(2, inputs="relative"), stirred)
    other = network(2, inputs="relative")
    with torch.no_grad():
        other.decode.second.weight.mul_(1.5)
    with pytest.raises(ConfigError, match="its outputs differ by"):
        rollout.require_parity(other, stirred)


def test_overflow_loses_nothing():
    """A rollout whose cells outgrow its buffers grows them, and its frames equal those of one that had room."""
    roomy, tight = (TritonStepper(*spreading(), "fp32", (room,)) for room in (64, 16))
    expected = path_of(roomy, 3)
    found = np.concatenate([path_of(tight, 1), path_of(tight, 2)])
    assert tight.growths > 0 and roomy.growths == 0
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_later_simulations_begin_anew():
    """What a simulator has captured it uses again, for a scene of fewer particles, other obstacles and other gravity
    too; the frames are bitwise those of a new simulator, after one that diverged as well."""
    first, second = scene(3), scene(2, 1, gravity=(0.0, 2.0, 0.0))
    again, *others = (Simulator(network(inputs="relative"), 60.0, "triton", "fp32") for _ in range(3))
    again.rollout([first], 2)
    kept = again.backend.idle[1]
    for one, other in zip((second, first), others, strict=True):
        (expected,) = other.rollout([one], 2)
        (found,) = again.rollout([one], 2)
        assert again.backend.idle[1] is kept
        np.testing.assert_array_equal(found, expected)
    away = replace(first, velocity_N3=np.full_like(first.velocity_N3, 60.0))
    with pytest.raises(DivergedError):
        again.rollout([away], 2)
    np.testing.assert_array_equal(again.rollout([first], 2)[0], expected)
    again.rollout([scene(1)], 2)  # too few for so much room
    assert again.backend.idle[1] is not kept
    again.backend.release()
    assert not again.backend.idle


def test_scenes_that_change():
    """Particles that enter, other obstacles, other gravity and an earlier frame are those of the plain loop; what was
    captured is used for all of them while there is room, and captured anew where there is not."""
    paths, growing = [], []
    for backend, precision in (("torch", "fp32"), ("triton", "fp32")):
        simulator = Simulator(network(2, inputs="relative"), 60.0, backend, precision)
        live = LiveSimulation(simulator, scene(4), capacity=6)
        first = live.simulation.stepper
        path = [live.step()]
        state = live.state
        for count, seed in ((2, 1), (3, 2)):
            new = scene(count, seed)
            live.add_particles(new.position_N3, new.velocity_N3, new.material_N)
            live.replace_obstacles(new)
            live.set_gravity((0.0, float(seed), 1.0))
            path += [live.step() for _ in range(2)]
            growing.append(live.simulation.stepper is not first)
        live.restore(state.position_N3.cpu().numpy(), state.velocity_NM3.cpu().numpy(), 1)
        paths.append([*path, live.step()])
        live.close()
    assert growing == [False, False, False, True]
    for expected_N3, found_N3 in zip(*paths, strict=True):
        np.testing.assert_allclose(found_N3, expected_N3, rtol=0, atol=1e-6)


def test_frame_by_frame(monkeypatch):
    """Frames that are asked for one by one are bitwise those of a rollout, beside another simulation of the same
    simulator; the one that ends last is kept. What diverges gives its good frames first."""
    monkeypatch.setattr(triton_stepper, "LOOK_FRAMES", 2)
    first, second = scene(3), scene(2, 1)
    simulator = Simulator(network(), 60.0, "triton", "fp32")
    (expected,) = simulator.rollout([first], 4)
    one, other = simulator.frames(first), simulator.frames(second)
    found = [(next(one), next(other))[0] for _ in range(4)]
    np.testing.assert_array_equal(np.stack(found), expected)
    assert not simulator.backend.idle
    one.close()
    other.close()
    assert simulator.backend.idle[1].live == 2
    away, frames = replace(first, velocity_N3=np.full_like(first.velocity_N3, 12.0)), []
    with pytest.raises(DivergedError) as raised:
        for position_N3 in simulator.frames(away):
            frames.append(position_N3)
    assert len(frames) == raised.value.frame > 1 and all(np.isfinite(frame).all() for frame in frames)


def test_first_room():
    """Groups that fall have room to spread at once, up to what their particles can fill; where cells are many already
    there is twice the room, and where they are so many that memory counts, a quarter more."""
    assert first_capacities((246, 53, 18, 5), 2_763) == (1_657, 276, 96, 40)
    assert first_capacities((1_398, 214, 56, 8), 4_296)[:2] == (2_796, 429)
    assert first_capacities((128_529, 23_263, 4_373, 612), 400_000) == (160_661, 32_768, 8_192, 1_224)
    assert first_capacities((65_536, 16_385), 400_000) == (131_072, 32_768)
    assert first_capacities((8,) * 5, 1) == (256, 128, 64, 32, 16)


@pytest.mark.parametrize(("particles", "side", "most"), [(1_000_000, 128, 2.35e9), (4_296, 48, 0.055e9)])
def test_memory_of_a_simulation(particles, side, most, monkeypatch):
    """In fp16 the network of the paper's size simulates a million particles, of which a cell has three as on
    the bench, within 2.35 KB each, and 4,296 within 0.055 GB; what is asked are 3 KB and 0.1 GB. Counted over all
    tensors of a simulation without memory: weights, state and positions on their way to the host too."""
    monkeypatch.setattr(TritonStepper, "_window", lambda _: Window((0, 0, 0), (side, side, side)))
    cells = tuple(round(share * particles) for share in (0.32, 0.0569, 0.0107, 0.0015))
    before = set(on_meta())
    with torch.device("meta"):
        whole = HierarchicalGraphNetwork(NetworkConfig())
        position_N3, velocity_NM3 = torch.zeros(particles, 3), torch.zeros(particles, 5, 3)
        index_N = torch.zeros(particles, dtype=torch.int64)
        state = ParticleState(position_N3, velocity_NM3, index_N, index_N, torch.zeros(1, 3), torch.zeros(1, 3), None)
    rollout = TritonStepper(whole, state, "fp16", first_capacities(cells, particles))
    gc.collect()
    held = sum(size for storage, size in on_meta().items() if storage not in before)
    assert 0.8 * most < held <= most
    assert rollout.fused.precision == "fp16"


def on_meta():
    """Bytes of each storage without memory that is alive."""
    found = [thing.untyped_storage() for thing in living_tensors() if thing.device.type == "meta"]
    return {storage._cdata: storage.nbytes() for storage in found}


def test_growing_gives_back_first(monkeypatch):
    """While buffers grow the old ones are gone; where there is no memory for larger ones, the simulation has its old
    ones again and stands where it stood: with memory it goes on as if nothing had been."""
    expected = path_of(TritonStepper(*spreading(), "fp32", (64,)), 3)
    tight = TritonStepper(*spreading(), "fp32", (16,))
    old = [weakref.ref(tight.grid), weakref.ref(tight.fused)]
    build, asked = DeviceGrid.__init__, []

    def refuse(grid, config, window, capacities, **rest):
        gc.collect()
        asked.append((capacities, [one() for one in old]))
        if len(asked) == 1:
            raise torch.OutOfMemoryError("no room")
        build(grid, config, window, capacities, **rest)

    monkeypatch.setattr(DeviceGrid, "__init__", refuse)
    done = []
    with pytest.raises(torch.OutOfMemoryError, match="no room"):
        done.extend(on_host(block_TN3) for block_TN3, _ in tight.blocks(3))
    assert asked[0][0] > asked[1][0] == (16,) and all(one is None for _, alive in asked for one in alive)
    rest = path_of(tight, 3 - sum(map(len, done)))
    np.testing.assert_allclose(np.concatenate([*done, rest]), expected, rtol=0, atol=1e-6)


def test_frames_taken_away_beside_the_next(monkeypatch):
    """Frames that are started before those before them are looked at are the same bitwise, where buffers grow too: what
    was started in vain moves nothing; and the frame of a divergence is the same."""
    monkeypatch.setattr(triton_stepper, "LOOK_FRAMES", 1)
    paths, growths, lost = [], [], []
    for overlap in (False, True):
        fast, state = spreading()
        tight = TritonStepper(fast, state, "fp32", (16,))
        tight.overlap = overlap
        seen: list[int] = []
        simulation = Simulation(lambda _, stepper=tight: nullcontext(stepper), state)
        paths.append(simulation.run(3, seen.append))
        growths.append(tight.growths)
        assert seen == [1, 2, 3]
        simulation.continue_from(state)
        tight.buffers.velocity_NV[0] = 1.0
        with pytest.raises(DivergedError) as caught:
            simulation.run(2)
        lost.append(str(caught.value))
    np.testing.assert_array_equal(paths[0], paths[1])
    assert growths[0] == growths[1] > 0 and lost[0] == lost[1]


def test_a_scene_that_diverges_ends_alone():
    """The scene between two others ends at the frame of backend torch with its message; the others go on in the same
    buffers, and each frame is computed once."""
    scenes = [scene(3), scene(2, 1), scene(4, 2)]
    scenes[1] = replace(scenes[1], velocity_N3=np.full_like(scenes[1].velocity_N3, 12.0))
    simulators = [Simulator(network(2), 60.0, backend, "fp32") for backend in ("torch", "triton")]
    results = [simulate_scenes(simulator, scenes, 6) for simulator in simulators]
    for expected, found in zip(*results, strict=True):
        assert found.cause == expected.cause
        np.testing.assert_allclose(found.position_TN3, expected.position_TN3, rtol=0, atol=1e-6)
    assert [result.cause is None for result in results[1]] == [True, False, True]
    assert 1 < results[1][1].frame_count < 6 and "2 of 2 particles" in results[1][1].cause
    assert simulators[1].backend.idle[3].live == 7


def test_wrong_kernels_are_refused():
    """A rollout whose first output is not the reference network's is refused before it moves anything."""
    plain = network()
    state = Simulator(plain, 60.0, "torch").start([scene(5)])
    rollout = TritonStepper(plain, state, "fp32")
    rollout.require_parity(plain, state)
    other = network()
    with torch.no_grad():
        next(other.decode.parameters()).mul_(1.5)
    with pytest.raises(ConfigError, match="backend must be torch on this machine"):
        rollout.require_parity(other, state)


def block(density, cell_size, cells):
    """Water at rest in a cube of so many cells, so many times as dense as the data's: 90 particles in a cell."""
    count = round(90 * density * cells**3)
    state = random_state((count,), obstacles=False, dtype=torch.float32)
    unit_N3 = torch.rand(count, 3, generator=torch.Generator().manual_seed(1))
    position_N3 = cell_size * (8 + 0.01 + (cells - 0.02) * unit_N3)
    material_N = torch.zeros_like(state.material_N)
    return replace(state, position_N3=position_N3, velocity_NM3=0 * state.velocity_NM3, material_N=material_N)


@pytest.mark.skipif(device().type != "cpu", reason="the interpreter's; the next one is a GPU's")
def test_crowds_are_added_in_float32(monkeypatch):
    """Where particles lie twice as densely as in the data, sums of them in float16 would be further off."""
    network = network_of(width=16, levels=1, message_passing_steps=1, cell_size=0.0625).float()
    with torch.no_grad():
        network.particle_to_cell.norm.bias.fill_(3.0)  # sums are large beside what is added

    def error(density, careful):
        state = block(density, 0.0625, 1)
        rollout = TritonStepper(network, state, "fp16", (64,))
        assert rollout._careful is careful
        rollout._network_pass()
        expected = network.normalised_acceleration(state).detach()
        return relative_error(rollout.fused.output[: len(expected), :3], expected)

    assert error(1, False) < 1e-2
    crowded = error(2, True)
    roomy = TritonStepper(network, block(1, 0.0625, 1), "fp16", (64,), capacity=200)
    assert roomy.fits(block(1, 0.0625, 1)) and not roomy.fits(block(2, 0.0625, 1))
    monkeypatch.setattr(triton_stepper, "CROWDED", 10**9)
    assert crowded < 1e-2 and crowded < 0.8 * error(2, False)


@pytest.mark.gpu
@pytest.mark.skipif(device().type != "cuda", reason="needs a CUDA device")
@pytest.mark.parametrize("density", [1, 2, 4, 10])
def test_density(density):
    """Accelerations of the shipped network in half precision are within 1 % of TF32's, up to ten times the data's
    density."""
    network, _ = load_weights(find_weights("obstacles"))
    network = network.to(device())
    assert isinstance(network, HierarchicalGraphNetwork)
    state = on_device(block(density, network.config.cell_size, 4), device())
    output = []
    for precision in ("fp16", "tf32"):
        rollout = TritonStepper(network, state, precision)
        rollout._network_pass()
        output.append(rollout.fused.output[: len(state.position_N3), :3].clone())
    error = relative_error(*output)
    assert error < 1e-2
