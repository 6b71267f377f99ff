"""The simulation loop on the device against the plain one."""

import gc
import itertools
import weakref
from contextlib import nullcontext
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import torch
from kernels.engines import device
from kernels.memory import living_tensors
from network.barrier_scenes import crossings, square
from network.states import network_of, on_device, random_state
from runtime.scenes import random_scene, rough

from hgn.config import NetworkConfig
from hgn.kernels.grid.op import CellBox, DeviceGrid
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
from hgn.scene.material import ELASTIC, MATERIALS
from hgn.schema import ConfigError

pytestmark = pytest.mark.usefixtures("large_tiles")


@pytest.fixture(autouse=True)
def unchecked(request, monkeypatch):
    """Leaves out the check of a simulation's first output, which takes as long as a frame: frames are compared here."""
    if device().type == "cpu" and "refused" not in request.node.name:
        monkeypatch.setattr(TritonStepper, "require_parity", lambda *_: None)


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


@cache
def roomy_path():
    """The frames of that where there is room for all cells from the start."""
    roomy = TritonStepper(*spreading(), "fp32", (64,))
    path_TN3 = path_of(roomy, 3)
    assert roomy.growths == 0
    return path_TN3


def crossed(*places):
    """Corners of two sheets that cross at each place."""
    return np.concatenate([square(at, axis, 0.3) for at in places for axis in (0, 1)])


def thrown(backend, levels=1, deviation=0.02, **changes):
    """A simulator of a network that throws particles about, in units of this deviation."""
    wild = network(levels, **changes)
    wild.normaliser.acceleration_std.fill_(deviation)
    return Simulator(wild, 60.0, backend, "fp32")


SHEETS = crossed((0.1, 0.1, 0.1))
FRAMES = {  # of the network
    "absolute": {"levels": 2},
    "relative, resting": {"levels": 3, "inputs": "relative", "rest_threshold": 2.0},
    "friction and parameters": {"levels": 2, "inputs": "local", "own_physics": ("friction", "parameters")},
    "elastic bodies": {"levels": 2, "inputs": "local", "own_physics": ("friction", "parameters", "elastic")},
    "walls of a plane": {"wall_clearance": (0.06, 0.2), "dimensions": 2},
    "obstacles and walls": {"obstacle_clearance": 2e-3, "wall_clearance": (0.06, 0.2)},
}


def motion(simulator, scenes, frames):
    """Positions [T + 1, N, 3] from the start on, and the histories of velocities at the end."""
    state = simulator.start(scenes)
    with simulator.simulation(state) as simulation:
        path_TN3, last = simulation.run(frames), simulation.state
    begin_1N3, end_N3, velocity_NM3 = (
        x.numpy(force=True) for x in (state.position_N3[None], last.position_N3, last.velocity_NM3)
    )
    np.testing.assert_array_equal(path_TN3[-1], end_N3)
    return np.concatenate([begin_1N3, path_TN3]), velocity_NM3


@pytest.mark.parametrize("name", FRAMES)
def test_frames_are_those_of_the_plain_loop(name):
    """For a batch of scenes with different gravity, one without obstacles, positions and histories of backends cpu and
    triton equal those of backend torch, frame by frame. Particles stay between the walls (in two dimensions z has
    none), do not come closer if they start beyond, and never pass an obstacle of their scene."""
    changes = FRAMES[name]
    held, walls = "obstacle_clearance" in changes, changes.get("wall_clearance")
    elastic = "elastic" in changes.get("own_physics", ())
    counts = (9, 6) if elastic else (12, 12, 6) if held else (5, 3) if walls else (4, 2)
    simulator = partial(thrown, deviation=0.02 if held or walls else 1e-3)
    scenes = [scene(count, seed, gravity=(3.0 * seed, -9.8, 2.0 * seed)) for seed, count in enumerate(counts)]
    scenes = [replace(each, dimensions=changes.get("dimensions", 3)) for each in scenes]
    if "own_physics" in changes:
        scenes = [scenes[0], rough(scenes[1])]
    if elastic:
        changes = changes | {"materials": MATERIALS}
        scenes = [replace(each, material_N=np.full_like(each.material_N, ELASTIC)) for each in scenes]
    if held:
        scenes = [each if i == 1 else replace(each, corners=lambda: SHEETS) for i, each in enumerate(scenes)]
    frames = 3 if held or walls else 2
    expected_TN3, expected_NM3 = motion(simulator("torch", **changes), scenes, frames)
    for backend in ("cpu", "triton") if device().type == "cpu" else ("triton",):
        found_TN3, found_NM3 = motion(simulator(backend, **changes), scenes, frames)
        np.testing.assert_allclose(found_TN3, expected_TN3, rtol=0, atol=2e-6 if walls or held else 1e-6)
        np.testing.assert_allclose(found_NM3, expected_NM3, rtol=0, atol=2e-6)
    free = {key: value for key, value in changes.items() if "clearance" not in key}
    free_TN3, _ = motion(simulator("torch", **free), scenes, frames)
    if free != changes or device().type == "cpu":  # sums of a GPU have no fixed order
        assert np.array_equal(free_TN3, expected_TN3) == (free == changes)
    if walls is not None:
        axes = slice(changes.get("dimensions", 3))
        low_N3, high_N3 = np.minimum(expected_TN3[0], walls[0]), np.maximum(expected_TN3[0], 0.4 - walls[1])
        assert (expected_TN3 >= low_N3 - 1e-7)[..., axes].all() and (expected_TN3 <= high_N3 + 1e-7)[..., axes].all()
        assert ("dimensions" in changes) == bool((expected_TN3 < low_N3 - 1e-3).any())
        stopped_N = expected_NM3[:, 0, 0] == 0
        assert held or (stopped_N.any() and not stopped_N.all())
    if held:
        passed = [
            [
                sum(crossings(*ways, SHEETS) for ways in itertools.pairwise(path_TN3[:, begin:end].astype(np.float64)))
                for begin, end in ((0, 12), (12, 24), (24, 30))
            ]
            for path_TN3 in (expected_TN3, free_TN3)
        ]
        assert passed[0][::2] == [0, 0] and passed[0][1] > 0 and passed[1][0] + passed[1][2] > 2


def test_obstacles_that_hold_change(monkeypatch):
    """A simulation that starts without obstacles continues with others, captured once, and without them again.
    Obstacles that are given replace those of the state. Frames equal those of new simulations, to the rounding of a
    GPU's sums. With the same barriers no new table is made."""
    changes = {"obstacle_clearance": 2e-3}
    places = ((0.1, 0.1, 0.1), (0.08, 0.12, 0.1))
    scenes = [scene(12), *(replace(scene(12), corners=partial(crossed, at)) for at in places)]
    simulator = thrown("triton", deviation=0.05, **changes)
    states = [simulator.start([each]) for each in scenes]
    paths = [thrown("triton", deviation=0.05, **changes).rollout([each], 2)[0][1:] for each in scenes]
    assert all(abs(paths[i] - paths[i + 1]).max() > 1e-3 for i in (0, 1))
    same = partial(np.testing.assert_allclose, rtol=0, atol=1e-7)
    rollout = TritonStepper(simulator.network, states[0], "fp32")
    for index in (1, 2, 0):
        assert rollout.take(states[index])
        same(path_of(rollout, 1), paths[index])
    given = SceneTable.of_barriers(states[2].barriers, 1, device())
    rollout = TritonStepper(simulator.network, states[1], "fp32", barriers=given)
    same(path_of(rollout, 1), paths[2])
    hashed, real = [], SceneTable.of_barriers
    noted = lambda barriers, *rest: hashed.append(barriers) or real(barriers, *rest)  # noqa: E731
    monkeypatch.setattr(SceneTable, "of_barriers", noted)
    rollout = TritonStepper(simulator.network, states[1], "fp32")
    heavier = replace(states[1], gravity_S3=2 * states[1].gravity_S3)
    for next_state in (states[1], heavier, states[2], states[2], states[1]):
        assert rollout.take(next_state)
    assert [barriers is states[1].barriers for barriers in hashed] == [True, False, True]


@pytest.mark.parametrize("value", [float("nan"), 0.9])
def test_divergence_is_seen_through_walls(value):
    """What is no number, or would come farther from the domain than its own size, ends the simulation at the frame and
    with the message of backend torch without walls."""
    messages = []
    for backend, walls in (("torch", None), ("triton", (0.01, 0.01))):
        wild = network(wall_clearance=walls)
        wild.normaliser.acceleration_mean.fill_(value)
        wild.normaliser.acceleration_std.fill_(0.0)
        with pytest.raises(DivergedError) as caught:
            Simulator(wild, 60.0, backend).rollout([scene(4)], 4)
        messages.append(str(caught.value))
    assert len(set(messages)) == 1 and "diverged at frame 1: 4 of 4 particles" in messages[0]


def test_free_flight_is_not_refused():
    """In free flight relative inputs give outputs of rounding only, which differ completely between backends. Both
    loops fall with gravity to 1e-3 of it. A network with other weights is still refused for other motion."""
    thrown = scene(12, low=0.45, gravity=(0.0, -5.0, 0.0), domain_size=(1.0, 1.0, 1.0))
    thrown = replace(thrown, velocity_N3=np.full((12, 3), 1.7, np.float32))
    paths = [
        Simulator(network(inputs="relative"), 60.0, name, "fp16").rollout([thrown], 3)[0].astype(np.float64)
        for name in ("torch", "triton")
    ]
    for path_TN3 in paths:
        falls_T3 = np.diff(path_TN3, 2, axis=0).mean(axis=1) * 3600
        np.testing.assert_allclose(falls_T3, np.broadcast_to(thrown.gravity, falls_T3.shape), rtol=0, atol=5e-3)
    right, other = network(inputs="relative"), network(inputs="relative")
    stirred = Simulator(right, 60.0, "torch").start([scene(12)])
    rollout = TritonStepper(right, stirred, "fp16", (512,))
    rollout.require_parity(right, stirred)
    with torch.no_grad():
        other.decode.second.weight.mul_(1.5)
    with pytest.raises(ConfigError, match=r"precision must be tf32 on this machine.*its outputs differ by"):
        rollout.require_parity(other, stirred)


def test_automatic_precision_is_lowered_where_refused(half_fails):
    """With precision auto a backend whose fp16 fails the check warns once and simulates in the next precision; a named
    precision is refused."""
    half_fails(triton_stepper, "hgn.runtime.torch_backend")
    (expected,) = Simulator(network(), 60.0, "triton", "fp32").rollout([scene(3)], 2)
    simulator = Simulator(network(), 60.0, "triton")
    with pytest.warns(UserWarning, match="got fp16: its outputs differ.*precision=auto computes in fp32 from here on"):
        (lowered,) = simulator.rollout([scene(3)], 2)
    np.testing.assert_array_equal(lowered, expected)
    simulator.backend.release()
    np.testing.assert_array_equal(simulator.rollout([scene(3)], 2)[0], expected)
    with pytest.raises(ConfigError, match="precision must be tf32 on this machine, got fp16"):
        Simulator(network(), 60.0, "triton", "fp16").rollout([scene(3)], 2)


def test_later_simulations_begin_anew(monkeypatch):
    """A simulator uses its captured graphs again, also for fewer particles, other obstacles and other gravity. The
    frames are bitwise those of a new simulator, also after a divergence, before which the good frames are returned.
    This holds for single frames during another simulation too; the buffers of the one that ends last are kept."""
    monkeypatch.setattr(triton_stepper, "BLOCK_FRAMES", 2)
    first, second = scene(3), scene(2, 1, gravity=(0.0, 2.0, 0.0))
    again, other = (Simulator(network(inputs="relative"), 60.0, "triton", "fp32") for _ in range(2))
    (expected,) = again.rollout([first], 3)
    kept = again.backend.idle[1]
    (of_second,) = again.rollout([second], 2)
    assert again.backend.idle[1] is kept
    np.testing.assert_array_equal(other.rollout([second], 2)[0], of_second)
    again.rollout([scene(1)], 2)  # too few for so much room
    assert again.backend.idle[1] is not kept
    away, frames = replace(first, velocity_N3=np.full_like(first.velocity_N3, 12.0)), []
    with pytest.raises(DivergedError) as raised:
        for position_N3 in again.frames(away):
            frames.append(position_N3)
    assert len(frames) == raised.value.frame > 1 and all(np.isfinite(frame).all() for frame in frames)
    one, beside = again.frames(first), again.frames(second)
    np.testing.assert_array_equal(np.stack([(next(one), next(beside))[0] for _ in range(3)]), expected)
    assert not again.backend.idle
    one.close()
    beside.close()
    assert again.backend.idle[1].live == 2
    again.backend.release()
    assert not again.backend.idle


def test_scenes_that_change():
    """With entering particles, other obstacles, other gravity and an earlier frame the frames equal those of the plain
    loop. The captured graph is used for all changes while capacities suffice, and is captured again if not."""
    paths, growing = [], []
    for backend, precision in (("torch", "fp32"), ("triton", "fp32")):
        simulator = Simulator(network(inputs="relative"), 60.0, backend, precision)
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


def test_scenes_that_are_reset():
    """Scenes that diverge and begin anew are the plain loop's, in one capture; kept obstacles are hashed once."""
    paths, away = [], scene(2, 1, velocity_N3=np.full((2, 3), 60.0, np.float32))
    for backend in ("torch", "triton"):
        simulator = Simulator(network(2, inputs="relative"), 60.0, backend, "fp32")
        with LiveSimulation(simulator, [scene(3), away], capacity=9) as live:
            path, first, ended = [live.advance()], live.simulation.stepper, list(live.ended)
            live.reset(1, scene(1, 4, gravity=(1.0, 0.0, 0.0)))
            path.append(live.advance())
            table = backend == "triton" and first.obstacles.row_SC.tolist()
            live.reset(0, replace(scene(2), obstacle_grid=live.scenes[0].obstacle_grid))
            paths.append([each.position_N3 for each in (*path, live.advance())])
            assert live.simulation.stepper is first and (not table or first.obstacles.row_SC.tolist() == table)
    assert ended == [1]
    torch.testing.assert_close(paths[1], paths[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize(("particles", "side", "most"), [(1_000_000, 128, 2.35e9), (4_296, 48, 0.055e9)])
def test_memory_of_a_simulation(particles, side, most, monkeypatch):
    """In fp16 the network of the paper's size simulates a million particles, of which a cell has three as on
    the bench, within 2.35 KB each, and 4,296 within 0.055 GB; what is asked are 3 KB and 0.1 GB. Counted over all
    tensors of a simulation without memory: weights, state and positions on their way to the host too."""
    monkeypatch.setattr(TritonStepper, "_cell_box", lambda _: CellBox((0, 0, 0), (side, side, side)))
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
    """Old buffers are freed before larger ones are allocated. Without memory for these, the simulation allocates the
    old ones again and keeps its state. With memory it later continues as if nothing had happened."""
    expected = roomy_path()
    tight = TritonStepper(*spreading(), "fp32", (16,))
    old = [weakref.ref(tight.grid), weakref.ref(tight.fused)]
    build, asked = DeviceGrid.__init__, []

    def refuse(grid, config, box, capacities, **rest):
        gc.collect()
        asked.append((capacities, [one() for one in old]))
        if len(asked) == 1:
            raise torch.OutOfMemoryError("no room")
        build(grid, config, box, capacities, **rest)

    monkeypatch.setattr(DeviceGrid, "__init__", refuse)
    done = []
    with pytest.raises(torch.OutOfMemoryError, match="no room"):
        done.extend(on_host(block_TN3) for block_TN3, _ in tight.blocks(3))
    assert asked[0][0] > asked[1][0] == (16,) and all(one is None for _, alive in asked for one in alive)
    rest = path_of(tight, 3 - sum(map(len, done)))
    np.testing.assert_allclose(np.concatenate([*done, rest]), expected, rtol=0, atol=1e-6)


def test_frames_taken_away_beside_the_next(monkeypatch):
    """Frames that start before earlier ones are read are bitwise the same, also while buffers grow, and equal those of
    a simulation with enough capacity. Frames started in vain change nothing. The frame of a divergence is the same."""
    monkeypatch.setattr(triton_stepper, "BLOCK_FRAMES", 1)
    expected_TN3 = roomy_path()
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
    np.testing.assert_allclose(paths[0], expected_TN3, rtol=0, atol=1e-6)
    assert growths[0] == growths[1] > 0 and lost[0] == lost[1]


def test_a_scene_that_diverges_ends_alone():
    """The scene between two others ends at the frame of backend torch with its message; the others go on in the same
    buffers, and each frame is computed once."""
    scenes = [scene(3), scene(2, 1), scene(4, 2)]
    scenes[1] = replace(scenes[1], velocity_N3=np.full_like(scenes[1].velocity_N3, 16.0))
    simulators = [Simulator(network(), 60.0, backend, "fp32") for backend in ("torch", "triton")]
    results = [simulate_scenes(simulator, scenes, 5) for simulator in simulators]
    for expected, found in zip(*results, strict=True):
        assert found.cause == expected.cause
        np.testing.assert_allclose(found.position_TN3, expected.position_TN3, rtol=0, atol=1e-6)
    assert [result.cause is None for result in results[1]] == [True, False, True]
    assert 1 < results[1][1].frame_count < 5 and "2 of 2 particles" in results[1][1].cause
    assert simulators[1].backend.idle[3].live == 7


def block(density, cell_size, cells):
    """Returns water at rest in a cube of this number of cells. A density of 1 is that of the data: 90 particles in a
    cell."""
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
        assert rollout.half_sums is not careful
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
    """Accelerations of a shipped network of absolute inputs in half precision are within 1 % of TF32's, up to ten times
    the data's density."""
    network, _ = load_weights(find_weights("obstacles_small"))
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
