"""Networks and states on which kernels are compared with the reference network in float64."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from kernels.engines import engine_of, gradients, run_forward
from network.barrier_scenes import square
from network.states import near_state, network_of, random_grid, random_state

from hgn.config import NetworkConfig
from hgn.network.elastic import RestShape
from hgn.network.moving import MovingObstacles
from hgn.runtime.parity import relative_error
from hgn.scene.material import INPUT_PARAMETERS, MATERIALS
from hgn.scene.motion import Motion
from hgn.scene.moving import MovingObstacle
from hgn.scene.rest_shape import NEIGHBOURS
from hgn.scene.rotation import euler_rotation

SQUARE_F33 = np.array([[[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[1, 0, 1], [1, 0, 0], [0, 0, 1]]]) * 0.3 + [0, 0.1, 0]
SEVERAL, CROWD = (5, 1, 3), (17, 1, 6)  # particles of three scenes


def float32_state(counts, obstacles=True, spread=0.3, seed=3):
    """A state whose numbers float32 holds exactly, in float64."""
    state = random_state(counts, seed, torch.float32, obstacles, spread)
    doubled = {name: getattr(state, name).double() for name in ("position_N3", "velocity_NM3", "domain_S3")}
    return replace(state, **doubled)


def moving_state(counts, obstacles=True, spread=0.3):
    """Scenes of different gravity, some of whose particles fly through several cells in a frame, out of the domain or
    lie on a cell's corner."""
    state = float32_state(counts, obstacles, spread)
    generator = torch.Generator().manual_seed(2)
    gravity_S3 = torch.randn(len(counts), 3, generator=generator) * 3e-3
    fast_N = torch.rand(len(state.position_N3), generator=generator) < 0.5
    state.velocity_NM3[fast_N] *= 32.0
    state.position_N3[0] = torch.tensor([0.0625, 0.125, -0.0009765625])
    return replace(state, gravity_S3=gravity_S3.double())


def border_state():
    """Particles exactly at cell centres and cell faces of cells of 1/16."""
    state = float32_state((4,), spread=0.2)
    position = torch.tensor([[0.0, 0.0, 0.0], [0.03125, 0.09375, 0.0625], [0.125, 0.125, 0.125], [0.28125, 0.25, 0.0]])
    return replace(state, position_N3=position.double())


def flying_state():
    """Two scenes in free flight, of which one particle of the second is hardly accelerated, and one in motion."""
    state = moving_state((10, 10, 10), obstacles=False, spread=0.15)
    velocity_NH3, gravity_N3 = state.velocity_NM3.clone(), state.gravity_S3[state.scene_N]
    age_1H1 = torch.arange(velocity_NH3.shape[1], dtype=torch.float64)[None, :, None]
    quiet_N = state.scene_N < 2
    velocity_NH3[quiet_N] = (torch.tensor([1e-2, 2e-2, 0.0]) - age_1H1 * gravity_N3[:, None])[quiet_N]
    velocity_NH3[12, 0] += 2e-3 * 1.5e-3
    return replace(state, position_N3=state.position_N3 + 0.4, velocity_NM3=velocity_NH3)


def rough_state(counts, walls=1.0, obstacles=1.0, fastest=1.0):
    """The same with friction, up to these numbers, of walls and obstacle cells, and columns of parameters."""
    state, generator = moving_state(counts, obstacles is not None), torch.Generator().manual_seed(4)
    draw = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    if obstacles is not None:
        cells = state.obstacles
        state = replace(state, obstacles=replace(cells, friction_K=obstacles * draw(len(cells.key_K))))
    columns = {"parameter_NP": draw(len(state.scene_N), len(INPUT_PARAMETERS)).double()}
    velocity_NM3, walls_S3 = state.velocity_NM3.clamp(-fastest, fastest), walls * draw(len(counts), 3).double()
    return replace(state, velocity_NM3=velocity_NM3, wall_friction_S3=walls_S3, **columns)


def elastic_state(counts):
    """The same with deformed and turned elastic bodies, and one particle without neighbours."""
    state, generator = rough_state(counts), torch.Generator().manual_seed(5)
    total, at = len(state.scene_N), torch.arange(len(state.scene_N))
    neighbour_NK = torch.randint(0, total, (total, NEIGHBOURS), generator=generator)
    alike_NK = (state.scene_N[neighbour_NK] == state.scene_N[:, None]) & (neighbour_NK != at[:, None])
    neighbour_NK = torch.where(alike_NK & (at[:, None] > 0), neighbour_NK, -1)
    place_N3 = state.position_N3.float() + 0.02 * torch.rand(total, 3, generator=generator)
    return replace(state, rest=RestShape.of(place_N3, neighbour_NK))


def swept(seed, friction=0.4, cells=4_000):
    """A moving obstacle: cells and a square that move and turn."""
    grid, rng = random_grid(seed, cells), np.random.default_rng(seed)
    rough_K = friction * rng.random(len(grid.cell_K3)) if friction else None
    shift_T3 = np.array([[0.01, 0.02, -0.01], [0.3, -0.2, 0.1 * seed]])
    turn_T33 = np.stack([euler_rotation((5.0 * seed, 20.0, 0.0)), euler_rotation((0.0, 170.0, -90.0))])
    motion = Motion(np.array([0.0, 0.5]), shift_T3, turn_T33, (0.19, 0.19 + 0.002 * seed, 0.18))
    return MovingObstacle(replace(grid, friction_K=rough_K), SQUARE_F33, motion)


def swept_state(counts, friction=0.4, still=True, distance=False):
    """The same with moving obstacles, of which scene s has 2 - s."""
    state = rough_state(counts, friction, friction, 0.02)
    state = near_state(state) if distance else state
    scenes = [
        tuple(swept(7 + 2 * scene + number, friction) for number in range(2 - scene)) for scene in range(len(counts))
    ]
    network = NetworkConfig(inputs="relative", obstacle_distance=distance)
    moving = MovingObstacles.of(scenes, [3, 8, 1][: len(counts)], 1 / 60, network)
    return replace(state, moving=moving, obstacles=state.obstacles if still else None)


def pushing(place, shift, turn=(0.0, 0.0, 0.0), axis=1, size=0.2):
    """A square obstacle whose barrier moves and turns by so much, domain units and degrees, in each of 20 frames."""
    rotation_T33 = np.stack([np.eye(3), euler_rotation(tuple(20 * np.asarray(turn)))])
    motion = Motion(np.array([0.0, 20 / 60]), np.array([np.zeros(3), 20 * np.asarray(shift)]), rotation_T33, place)
    return MovingObstacle(random_grid(5, 4_000), square(place, axis, size), motion)


# Moving obstacles of scenes of one batch, around particles from 0.05 to 0.15
PUSHING = {
    "translating": (pushing((0.1, 0.04, 0.1), (1e-3, 8e-3, -2e-3)),),
    "at rest": (),
    "rotating": (pushing((0.1, 0.1, 0.1), (0.0, 0.0, 0.0), (1.0, 0.0, 7.0)),),
    "two": (
        pushing((0.04, 0.1, 0.1), (6e-3, 1e-3, 0.0), (0.0, 2.0, 1.0), axis=0),
        pushing((0.1, 0.16, 0.1), (0.0, -7e-3, 1e-3), (2.0, 0.0, 0.0)),
    ),
}


def apart_state(counts):
    """In each scene two bodies that share coarser cells, but no finest cell; in the second one far from the walls."""
    state = moving_state(counts, False, 0.08)
    position_N3 = state.position_N3.clone()
    position_N3[::2, 0] += 0.2
    position_N3[state.scene_N == 1] += 0.35
    return replace(state, position_N3=position_N3)


@dataclass(frozen=True)
class Case:
    """A network, a state, and the largest relative error of outputs, of all gradients, and of each gradient."""

    state: Callable[[], Any]
    bound: float
    changes: dict[str, Any] = field(default_factory=dict)  # of the network
    many_rows: bool = False  # every level is one of many rows, and programs take several tiles

    def network(self):
        network = network_of(**{"width": 16, "levels": 2, "message_passing_steps": 1, **self.changes})
        if network.config.relative:
            network.normaliser.velocity_std.fill_(7.0)  # which nothing depends on
        return network


RELATIVE = {"inputs": "relative"}
OWN = {"inputs": "local", "own_physics": ("friction", "parameters")}
ELASTIC = {"own_physics": ("friction", "parameters", "elastic"), "materials": MATERIALS}
MOVING = OWN | {"own_physics": ("friction", "parameters", "moving")}
NEAR = {"obstacle_distance": True}
SHUFFLED = ("water", "snow", "sand")
# Relative inputs: in the weights of normals the rounding of distances counts tenfold (FEW).
CASES = {
    "several scenes": Case(lambda: float32_state(SEVERAL, True, 0.2), 2e-5, {"message_passing_steps": 2}, True),
    "one particle": Case(lambda: float32_state((1,), False), 2e-5, {"levels": 3, "obstacle_features": False}),
    "one level": Case(lambda: float32_state((5,), True, 0.1), 2e-5, {"levels": 1, "materials": SHUFFLED}),
    "borders of cells": Case(border_state, 2e-5, {"cell_size": 0.0625}),
    "relative": Case(lambda: moving_state(CROWD), 4e-5, RELATIVE),
    "relative, one level": Case(
        lambda: moving_state((9, 33), False), 4e-5, RELATIVE | {"levels": 1, "velocity_history": 2}
    ),
    "relative, one particle": Case(lambda: moving_state((1,), False), 4e-5, RELATIVE),
    "relative, four levels": Case(
        lambda: apart_state((40, 25)),
        4e-5,
        {"inputs": "local", "obstacle_features": False, "levels": 4, "materials": SHUFFLED},
    ),
    "relative, free flight": Case(flying_state, 2e-4, RELATIVE),
    "friction and parameters": Case(lambda: rough_state(CROWD), 1e-4, OWN),
    "friction of walls": Case(
        lambda: rough_state((23, 9), 0.5, None), 1e-4, OWN | {"own_physics": ("friction",), "obstacle_features": False}
    ),
    "friction that stops": Case(
        lambda: rough_state((61, 20), 30.0, 30.0, 3e-3), 2e-4, OWN
    ),  # PyTorch in float32: 1.7e-4
    "parameters": Case(lambda: rough_state(SEVERAL), 4e-5, RELATIVE | {"own_physics": ("parameters",)}),
    "moving obstacles": Case(lambda: swept_state(CROWD), 1e-4, MOVING),
    "moving obstacles alone": Case(
        lambda: replace(swept_state(CROWD, 0.0, False), wall_friction_S3=None, parameter_NP=None),
        1e-4,
        MOVING | {"levels": 1},
    ),
    "distances": Case(lambda: near_state(rough_state(CROWD)), 2e-4, OWN | NEAR),  # an H200: 1.6e-4
    "distances without friction": Case(lambda: near_state(moving_state(CROWD)), 4e-5, RELATIVE | NEAR),
    "distances of moving obstacles": Case(lambda: swept_state(CROWD, distance=True), 2e-4, MOVING | NEAR),
    "elastic bodies": Case(lambda: elastic_state((40, 17)), 1e-4, OWN | ELASTIC),
}


def flat(tensors):
    return torch.cat([tensor.double().cpu().flatten() for tensor in tensors])


def drawn(network, state):
    """Origins of the scenes' grids, and weights of the outputs."""
    generator = torch.Generator().manual_seed(1)
    origin_S3 = (-network.config.cell_size * torch.rand(state.scene_count, 3, generator=generator)).double()
    return origin_S3, torch.randn(state.position_N3.shape, generator=generator, dtype=torch.float64)


def reference(network, state, origin_S3, weight_N3):
    """Output and gradients of the sum of outputs times `weight_N3`."""
    output = network.normalised_acceleration(state, origin_S3)
    found = torch.autograd.grad((output * weight_N3).sum(), list(network.parameters()), allow_unused=True)
    pairs = zip(network.parameters(), found, strict=True)
    return output.detach(), [torch.zeros_like(p) if gradient is None else gradient for p, gradient in pairs]


@dataclass(frozen=True)
class Comparison:
    """Relative errors of the output, of all gradients together and of each, and the engine that made them."""

    output: float
    together: float
    each: list[float]
    engine: Any
    origin_S3: torch.Tensor
    output_N3: torch.Tensor


def compare(network, state, precision, loss_scale, room):
    origin_S3, weight_N3 = drawn(network, state)
    output, expected = reference(network, state, origin_S3, weight_N3)
    engine = engine_of(network, state, precision, (room,) * network.config.levels, loss_scale=loss_scale)
    found = run_forward(engine, network, state, origin_S3).clone()
    assert int(engine.grid.status) == 0
    engine.output_gradient[: len(weight_N3), :3] = (loss_scale * weight_N3).float()
    engine.backward()
    each = gradients(engine, network)
    pairs = zip(each, expected, strict=True)
    return Comparison(
        relative_error(found, output),
        relative_error(flat(each), flat(expected)),
        [relative_error(a, b) for a, b in pairs],
        engine,
        origin_S3,
        found,
    )
