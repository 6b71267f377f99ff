"""Moving surfaces: what a network sees and does depends only on velocities relative to them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from network.states import airborne, network_of
from scene.test_episode import members_of
from training.test_symmetry import ALL_48

from hgn.config import NetworkConfig, SceneConfig
from hgn.data.batch import make_batch
from hgn.network.barriers import Barriers
from hgn.network.moving import MovingObstacles
from hgn.network.obstacles import ObstacleCells
from hgn.network.relative import particle_contact
from hgn.runtime.differentiable import Pose
from hgn.runtime.live import LiveSimulation
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.episode import Episode, decode_episode
from hgn.scene.motion import Motion
from hgn.scene.moving import at_rest, moving_obstacles
from hgn.scene.obstacle_grid import build_obstacle_grid
from hgn.scene.random_scene import generate_scene
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene_file import scene_of
from hgn.scene.shapes import shape_obstacle
from hgn.schema import ConfigError
from hgn.step.reference import accelerations, advanced
from hgn.training.symmetry import _points, _vectors, moving_under

OWN = ("friction", "moving")
CELL, FRAME_S, CLEARANCE = 1 / 64, 1 / 60, 0.006
COMMON = (0.035, -0.07, 0.035)  # domain units per frame: whole coarsest cells of a network with one level


def plates(velocities, turns=None, friction=0.4):
    """Two plates about the particles of `struck`, each with its motion; velocity 0 of both: at rest."""
    found = []
    for i, velocity in enumerate(velocities):
        position = (0.9 + 0.05 * i, 0.86 + 0.1 * i, 0.9)
        plate = shape_obstacle("square", 0.2, position, euler_rotation((10.0, 0.0, 20.0 * i)), f"plate_{i}")
        time_T = np.array([0.0, 100 * FRAME_S])
        turn = np.eye(3) if turns is None else euler_rotation(turns[i])
        motion = Motion(
            time_T, np.array([np.zeros(3), 100 * np.array(velocity)]), np.stack([np.eye(3), turn]), position
        )
        found.append(replace(plate, friction=friction, motion=motion))
    return found


def moving_of(obstacles, frame=0):
    return MovingObstacles.of(
        [moving_obstacles(obstacles, CELL)], [frame], FRAME_S, NetworkConfig(), clearance=CLEARANCE
    )


def struck(velocity=(0.0, 0.0, 0.0), count=60):
    """A cloud between the plates, far from walls, that moves at random about a velocity."""
    generator = torch.Generator().manual_seed(3)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    velocity_N3 = torch.tensor(velocity, dtype=torch.float64) + 6e-3 * (draw(count, 3) - 0.5)
    age_H1 = torch.arange(5, dtype=torch.float64)[:, None]
    state = airborne((count,))
    history_NM3 = velocity_N3[:, None] - age_H1 * state.gravity_S3 + 1e-4 * draw(count, 5, 3)
    place_N3 = torch.tensor([0.82, 0.86, 0.82]) + 0.16 * draw(count, 3) * torch.tensor([1.0, 0.6, 1.0])
    return replace(state, position_N3=place_N3, velocity_NM3=history_NM3, domain_S3=torch.full((1, 3), 4.0).double())


def held(state, obstacles):
    """The state with an obstacle at rest as a network without `moving` gets it."""
    (still,) = moving_obstacles(obstacles, CELL)
    cells = ObstacleCells.of([still.grid])
    return replace(state, obstacles=cells, barriers=Barriers.of([still.barrier(CLEARANCE)]))


def network_for(**changes):
    values = {"inputs": "local", "own_physics": OWN, "obstacle_clearance": CLEARANCE, "levels": 1} | changes
    return network_of(**values)


def rolled(network, state, frames):
    """Positions of the next frames, [T, N, 3]."""
    positions = []
    with torch.no_grad():
        for _ in range(frames):
            acceleration_N3 = accelerations(network, state, network.prediction(state))
            state = advanced(state, acceleration_N3, network.step, 3)
            positions.append(state.position_N3)
    return torch.stack(positions)


@pytest.mark.parametrize("frames", [1, 10])
def test_a_common_velocity_changes_nothing(frames):
    """Particles and an obstacle with one velocity move as they do about the obstacle at rest, which is a scene without
    moving obstacles, for ten frames with contacts and friction; and not as without it, or with it at rest."""
    network, obstacles = network_for(), plates([COMMON])
    still = rolled(network, held(struck(), obstacles), frames)
    moved = rolled(network, replace(struck(COMMON), moving=moving_of(obstacles)), frames)
    shift_T13 = torch.arange(1, frames + 1)[:, None, None] * torch.tensor(COMMON, dtype=torch.float64)
    torch.testing.assert_close(moved - shift_T13, still, rtol=0, atol=1e-11)
    assert float((still - rolled(network, struck(), frames)).abs().max()) > 1e-4
    blind = rolled(network, held(struck(COMMON), obstacles), 1)
    assert float((blind - shift_T13[:1] - still[:1]).abs().max()) > 1e-4


def test_several_motions_and_a_boost():
    """Two plates that move and turn: adding one velocity to them and to the particles changes no acceleration. A
    network without moving obstacles has the same bits with `moving` and without."""
    network, turns = network_for(levels=3), [(0.0, 90.0, 30.0), (-60.0, 0.0, 0.0)]
    slow = [(2e-3, 5e-3, 0.0), (0.0, -4e-3, 1e-3)]
    first = network(replace(struck(), moving=moving_of(plates(slow, turns)))).detach()
    fast = plates([tuple(np.add(velocity, COMMON)) for velocity in slow], turns)
    torch.testing.assert_close(
        network(replace(struck(COMMON), moving=moving_of(fast))).detach(), first, rtol=0, atol=1e-13
    )
    still = network(replace(struck(), moving=moving_of(plates([(0.0, 0.0, 0.0)] * 2)))).detach()
    assert float((first - still).abs().max()) > 1e-5
    state, without = held(struck(), plates([COMMON])), network_for(levels=3, own_physics=("friction",))
    assert torch.equal(network(state), without(state)) and network.parameter_count == without.parameter_count


@pytest.mark.parametrize(("distance", "expected"), [(False, [1.0, 1.0, 0.6, 0.0]), (True, [0.2, 1.0, 0.6, 0.0])])
def test_contact_where_normals_almost_cancel(distance, expected):
    """In cells of two obstacles a sum of normals may be short. Only with distances a short normal is far away."""
    wall_N6, normal_N6 = torch.zeros(4, 6), torch.zeros(4, 6)
    normal_N6[0, 1], normal_N6[1, 3], wall_N6[2, 0] = 0.1, -0.8, 0.3
    torch.testing.assert_close(particle_contact(wall_N6, normal_N6, distance), torch.tensor(expected))


def test_symmetries_of_the_cube():
    """Normals and velocities of surfaces that particles meet are images of each other, under all 48 symmetries."""
    moving = moving_of(plates([(2e-3, 5e-3, 1e-3), (0.0, -4e-3, 1e-3)], [(0.0, 90.0, 30.0), (-60.0, 0.0, 0.0)]), 3)
    state = struck(count=400)
    place_N3, velocity_N3, scene_N = state.position_N3, state.velocity_NM3[:, 0], state.scene_N
    seen_N8, surface_N3 = moving.met(None, (place_N3, velocity_N3, scene_N), 4)
    here, ahead = (int(part_N4[:, :3].any(-1).sum()) for part_N4 in seen_N8.chunk(2, dim=1))
    assert 20 < here < ahead < 400
    for symmetry in ALL_48:
        image = lambda vector_N3, own=symmetry: _vectors(vector_N3, scene_N, [own])  # noqa: E731
        placed = _points(place_N3, scene_N, [symmetry]), image(velocity_N3), scene_N
        found_N8, velocity = moving_under(moving, [symmetry]).met(None, placed, 4)
        torch.testing.assert_close(velocity, image(surface_N3), rtol=0, atol=1e-14)
        for part in (slice(0, 3), slice(4, 7)):
            torch.testing.assert_close(found_N8[:, part], image(seen_N8[:, part]), rtol=0, atol=1e-14)


def test_a_smooth_plate_pushes_along_its_normal():
    """The mean force of a plate without friction that moves along and across itself is along its normal, for ten random
    networks, but for the part 0.1 of a contact that `slip` leaves; with friction it is not."""
    plate = replace(plates([(8e-3, 3e-3, -5e-3)])[0], friction=0.0)
    normal_3 = torch.from_numpy(euler_rotation((10.0, 0.0, 0.0))[:, 1])
    state = struck(count=300)
    place_N3 = torch.tensor([0.9, 0.86, 0.9]) + 0.1 * (state.position_N3 - state.position_N3.mean(0)) / 0.16
    for seed in range(10):
        network, along = network_for(levels=3), []
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.add_(0.3 * torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype))
        for friction in (0.0, 2.0):
            moving = moving_of([replace(plate, friction=friction)])
            push_3 = (network(replace(state, position_N3=place_N3, moving=moving)) - state.gravity_S3).detach().mean(0)
            along.append(float((push_3 - (push_3 @ normal_3) * normal_3).norm() / push_3.norm()))
        assert along[0] < 0.01
    assert along[1] > 2 * along[0]


def test_data_have_the_obstacles_of_a_simulation():
    """A sixth of drawn scenes has a moving obstacle. A stored episode has its cells, and its pose and velocity in a
    frame, as a simulation of the scene has them. Batches of other networks have none."""
    kinds, own = {"slope": 1.0}, ("friction", "moving")
    config = SceneConfig(domain_size=(2.0, 1.5, 1.5), kinds=kinds, own_physics=own, particles_per_cell=0.2)
    scenes = [generate_scene(config, seed) for seed in range(40)]
    moving = [scene for scene in scenes if scene.moves]
    assert 2 < len(moving) < 13 and max(o.motion.fastest(o.vertex_V3) for s in moving for o in s.obstacles) <= 1
    network = network_for(dtype=torch.float32)
    for scene in moving[:4]:
        grid = build_obstacle_grid(at_rest(scene.obstacles), scene.cell_size, 0, scene.domain_size)
        path_TN3, solver = np.repeat(scene.position_N3[None], 60, 0), {"settings": {"collider_friction": 0.0}}
        values = (scene.velocity_N3, scene.material_N, grid, scene.domain_size, scene.gravity, 60.0, scene.seed)
        episode = Episode("a", path_TN3, *values, scene.specification, solver)
        batch = make_batch([(decode_episode("a", members_of(episode)), 40)], network.config)
        started = Simulator(network, 60.0, "torch").start([scene]).moving.at([40])
        for mine, other in zip(batch.moving.poses.tensors, started.poses.tensors, strict=True):
            torch.testing.assert_close(mine, other, rtol=0, atol=0)
        assert torch.equal(batch.moving.cells.surface_rows, started.cells.surface_rows)
        assert make_batch([(episode, 40)], replace(network.config, own_physics=())).moving is None


SCENE = """{cell_size: 0.015625, groups: [{shape: cube, size: 0.06, position: [0.5, 0.56, 0.5], material: snow}],
obstacles: [{shape: square, size: 0.2, position: [0.5, 0.5, 0.5], friction: 0.5,
keyframes: [{time: 0.05}, {time: 0.2, translation: [0.05, 0.05, 0], rotation: [0, 20, 0]}]}]}"""


def test_simulations_move_obstacles():
    """A live scene with keyframes is a rollout of it, and again after it was reset and restored. Gradients of positions
    by the plate's turn and velocity are those of differences."""
    scene, network = scene_of(yaml.safe_load(SCENE), "a.yaml"), network_for()
    simulator = Simulator(network_for(dtype=torch.float32), 60.0, "torch")
    path_TN3 = simulator.rollout([scene], 16)[0]
    with LiveSimulation(simulator, replace(InitialState.of(scene), moving=())) as live:
        live.replace_obstacles(scene)
        first, again = [live.step() for _ in range(15)], None
        np.testing.assert_array_equal(np.stack(first), path_TN3[1:])
        live.reset(0, scene)
        again = [live.step() for _ in range(8)]
        state = live.state
        live.step()
        live.restore(state.position_N3.numpy(), state.velocity_NM3.numpy(), live.frame - 1)
        np.testing.assert_array_equal(np.stack([*again, *(live.step() for _ in range(7))]), path_TN3[1:])
    with pytest.raises(ValueError, match="obstacles must be at rest for a network without `moving`"):
        Simulator(network_for(own_physics=()), 60.0, "torch").start([scene])
    drawn, single, simulator = yaml.safe_load(SCENE), simulator, Simulator(network, 60.0, "torch")
    drawn["obstacles"][0]["keyframes"] = [{"time": 0}, {"time": 1, "translation": [0.3, 0.6, 0]}]
    pose = Pose(velocity_3=torch.tensor([0.3, 0.6, 0]))
    even, plate = scene_of(drawn, "a.yaml"), replace(scene.obstacles[0], motion=None)
    posed_TN3 = simulator.differentiable(replace(scene, obstacles=(plate,)), 6, poses={0: pose})
    torch.testing.assert_close(posed_TN3, simulator.differentiable(even, 6), rtol=0, atol=1e-7)
    np.testing.assert_allclose(posed_TN3.detach().numpy(), single.rollout([even], 6)[0], rtol=0, atol=2e-6)

    def total(turn_3, velocity_3):
        poses = {0: Pose(turn_3, velocity_3=velocity_3)}
        return simulator.differentiable(scene, 6, poses=poses)[-1].square().sum()

    inputs = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in ([0.1, 0, 0.1], [0.1, 0.2, 0])]
    gradients = torch.autograd.grad(total(*inputs), inputs)
    for number, gradient in enumerate(gradients):
        way_3, step = torch.tensor([0.4, -0.3, 0.6], dtype=torch.float64), 1e-6
        ends = [[x + s * step * way_3 if i == number else x for i, x in enumerate(inputs)] for s in (1, -1)]
        slope = float((total(*ends[0]) - total(*ends[1])).detach()) / (2 * step)
        assert slope == pytest.approx(float(gradient @ way_3), rel=1e-4) and slope != 0


def test_a_program_moves_obstacles():
    """Moved before each frame, the second obstacle of a scene acts bitwise as with keyframes at all frames, also after
    a reset and if it is placed twice. The first one and the other scene go on as before."""
    drawn, frames = yaml.safe_load(SCENE), 12
    drawn["obstacles"].append(drawn["obstacles"][0] | {"position": [0.5, 0.6, 0.5], "keyframes": [{"time": 0}]})
    begin = scene_of(drawn, "a.yaml")
    places = [((0.002 * t, -0.004 * t, 0.001 * t * t), (0.0, 3.0 * t, 1.0 * t)) for t in range(frames)]
    own = [{"time": t * FRAME_S, "translation": [*p], "rotation": [*r]} for t, (p, r) in enumerate(places)]
    drawn["obstacles"][1]["keyframes"] = own
    simulator = Simulator(network_for(dtype=torch.float32), 60.0, "torch")
    still_TN3, moved_TN3 = simulator.rollout([begin, scene_of(drawn, "a.yaml")], frames)
    assert np.abs(moved_TN3 - still_TN3).max() > 1e-3
    with LiveSimulation(simulator, [begin, begin]) as live:
        for place in places[1:5]:
            live.move_obstacle(1, *place, index=1)
            live.step()
        live.reset(0, begin)
        live.reset(1, begin)
        for frame, place in enumerate(places[1:], 1):
            live.move_obstacle(1, (0.1, 0.1, 0.1), index=1)
            live.move_obstacle(1, *place, index=1)
            np.testing.assert_array_equal(live.step(), np.concatenate([still_TN3[frame], moved_TN3[frame]]))
        for number, place, message in (
            (2, places[1], "number must be 0 to 1, an obstacle with keyframes, got 2"),
            (False, places[1], "number must be 0 to 1, an obstacle with keyframes, got False"),
            (1, ((0.1, 0.1),), r"translation must be three numbers from .*, got \(0.1, 0.1\)"),
            (1, ([[1, 2], [3], 4],), r"translation must be three numbers from .*, got \[\[1, 2\], \[3\], 4\]"),
            (1, (places[1][0], (np.inf, 0, 0)), r"rotation must be three numbers from .*, got \(inf, 0, 0\)"),
        ):
            with pytest.raises(ConfigError, match=message):
                live.move_obstacle(number, *place)
    with (
        LiveSimulation(simulator, replace(InitialState.of(begin), moving=())) as live,
        pytest.raises(ConfigError, match="number must be left out: the scene has no obstacles with keyframes, got 0"),
    ):
        live.move_obstacle(0, (0.1, 0.1, 0.1))


def test_restored_obstacles_are_where_they_were():
    """After `restore` of each scene of a batch the same moves are the same motion bitwise; without them obstacles rest
    at the frame's pose. Keyframes that a move had ended continue. Moves before other obstacles are not restored."""
    drawn, frames = yaml.safe_load(SCENE), 10
    drawn["obstacles"][0]["keyframes"] = [{"time": 0}, {"time": 0.1, "translation": [0.02, -0.02, 0]}]
    begin = scene_of(drawn, "a.yaml")
    simulator = Simulator(network_for(dtype=torch.float32), 60.0, "torch")
    with LiveSimulation(simulator, [begin, begin]) as live:

        def steps(first, moves=True):
            path = []
            for frame in range(first, frames):
                if moves and frame >= 4:  # keyframes before
                    for index in (0, 1):
                        live.move_obstacle(0, (0.003 * frame, 0, -0.01 * index), (0, 4 * frame, 0), index)
                path.append(live.step())
                states.append(live.state)
            return np.stack(path)

        def restore(frame):
            then = states[frame]
            for index, rows in enumerate((then.scene_N == 0, then.scene_N == 1)):
                live.restore(then.position_N3[rows].numpy(), then.velocity_NM3[rows].numpy(), frame, index)

        states = [live.state]
        path_TN3 = steps(0)
        live.move_obstacle(0, (0.1, 0.1, 0.1), index=1)  # does not take effect
        for frame in (8, 6, 2):
            restore(frame)
            np.testing.assert_array_equal(steps(frame), path_TN3[frame:])
        for index in (0, 1):  # a scene restored later than the other one
            then = states[5]
            rows = then.scene_N == index
            live.restore(then.position_N3[rows].numpy(), then.velocity_NM3[rows].numpy(), 5, index)
            again = steps(5)
            np.testing.assert_array_equal(again[:, rows], path_TN3[5:, rows])
        assert live.frames == (15, 10) and live.frame == 10
        with pytest.raises(ConfigError, match="frame must be at most 10, the scene's last frame, got 11"):
            live.restore(then.position_N3[rows].numpy(), then.velocity_NM3[rows].numpy(), 11, 1)
        live.frame = frames
        restore(6)
        place_V3 = states[6].moving.poses.place_V3
        torch.testing.assert_close(live.state.moving.poses.place_V3, place_V3, rtol=0, atol=0)
        steps(6, moves=False)
        torch.testing.assert_close(live.state.moving.poses.place_V3, place_V3, rtol=0, atol=0)
        assert not live.state.moving.poses.shift_V3.any()
        live.replace_obstacles(begin, 0)
        restore(2)
        pivot_V3, place_V3 = states[0].moving.poses.pivot_V3, live.state.moving.poses.place_V3
        torch.testing.assert_close(place_V3[:1], pivot_V3[:1], rtol=0, atol=0)
        torch.testing.assert_close(place_V3[1:], states[2].moving.poses.place_V3[1:], rtol=0, atol=0)


def test_obstacles_move_before_particles_enter():
    """With an emitter only particles move as beside others that are far away; a live scene that is empty, too."""
    drawn = yaml.safe_load(SCENE)
    disc = {"shape": "disc", "size": 0.05, "position": [0.5, 0.56, 0.5], "velocity": [0, -0.5, 0], "material": "snow"}
    drawn |= {"groups": [], "emitters": [disc | {"start": 0.1, "stop": 0.12}]}
    simulator, empty = Simulator(network_for(dtype=torch.float32), 60.0, "torch"), scene_of(drawn, "a.yaml")
    drawn["groups"] = [{"shape": "cube", "size": 0.02, "position": [0.1, 0.9, 0.1], "material": "water"}]
    alone_TN3, beside_TN3 = (simulator.rollout([scene], 16)[0] for scene in (empty, scene_of(drawn, "a.yaml")))
    np.testing.assert_allclose(alone_TN3, beside_TN3[:, -alone_TN3.shape[1] :], rtol=0, atol=1e-6)
    with LiveSimulation(simulator, replace(InitialState.of(empty), emitting=None)) as live:
        for _ in range(8):
            live.step()
        assert live.state.moving.frames == (8,)


def test_obstacles_at_rest_are_sampled_once():
    """Scenes with the same obstacles at rest have the same cells and corners, which live scenes do not prepare again;
    with other obstacles, seeds or cells they have their own."""
    scene, (still,) = scene_of(yaml.safe_load(SCENE), "a.yaml"), plates([(0.0, 0.0, 0.0)])
    scene, plate = replace(scene, obstacles=(replace(still, motion=None),)), scene.obstacles[0]
    first, second = map(InitialState.of, (scene, replace(scene, obstacles=(*scene.obstacles, plate))))
    assert first.obstacle_grid is second.obstacle_grid and first.corners is second.corners and second.moving
    lower = replace(scene, obstacles=(shape_obstacle("square", 0.2, (0.5, 0.4, 0.5)),))
    for other in (lower, replace(scene, seed=1), replace(scene, cell_size=1 / 32)):
        assert InitialState.of(other).obstacle_grid is not first.obstacle_grid
