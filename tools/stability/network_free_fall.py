"""Free fall, where the right answer is known: what a network makes of it, and of an error of its own there.

A cube of one material falls in the middle of the domain. Its acceleration must be gravity's; and where its last
velocity is another than it should be, the network must take that back. A network that goes on with it instead repeats
each of its own errors, frame by frame, and bodies drift. Independent noise in training teaches it that for single
particles alone: over a body it averages out.
Shape legend: N particles, M velocities of the history.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from hgn.config import SceneConfig
from hgn.network.features import ParticleState
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.material import MATERIALS
from hgn.scene.scene import Scene
from tools.stability.row import Row

FRAMES = (0, 2, 5, 8)  # of the fall, that the network is asked at
ERROR_AT_MOST = 0.02  # of gravity
SPEED_SHARE = 0.1  # of gravity's gain a frame: what is added to velocities


def free_fall_rows(simulator: Simulator, config: SceneConfig, material: str) -> list[Row]:
    """Two rows: the largest error of a falling body's mean acceleration, in gravities; and how much of a wrong last
    velocity the network adds to the next one: -1 takes it back, 1 repeats it.
    """
    gravity_3 = torch.tensor(config.gravity, dtype=torch.float32) / simulator.frame_rate_hz**2
    pull = float(gravity_3.norm())
    errors, body, constant, particle = [], [], [], []
    for frame in FRAMES:
        state, true_3 = falling(simulator, config, material, frame), gravity_3.to(simulator.device)
        mean_3 = _acceleration(simulator, state).mean(0)
        errors.append(float((mean_3 - true_3).norm()) / pull)
        added_NM = torch.zeros_like(state.velocity_NM3[..., 0])
        added_NM[:, 0] = SPEED_SHARE * pull
        body.append(_answer(simulator, state, added_NM))
        constant.append(_answer(simulator, state, torch.full_like(added_NM, SPEED_SHARE * pull)))
        draw_N = torch.randn(len(added_NM), generator=torch.Generator().manual_seed(frame)).to(added_NM)
        added_NM[:, 0] = SPEED_SHARE * pull * draw_N
        particle.append(_answer(simulator, state, added_NM))
    error, worst = max(errors), max(body)
    more = {"of_a_constant_velocity": float(np.mean(constant)), "of_a_particle": float(np.mean(particle))}
    return [
        Row(
            f"free fall, {material}",
            ERROR_AT_MOST,
            error,
            error <= ERROR_AT_MOST,
            "gravities, the error of a falling body's acceleration",
        ),
        Row(
            f"a body's velocity error, {material}",
            "below 0",
            worst,
            worst < 0,
            f"of it added in the next frame; of one particle's {more['of_a_particle']:.2f}",
            more,
        ),
    ]


def falling(simulator: Simulator, config: SceneConfig, material: str, frame: int) -> ParticleState:
    """A cube that has fallen freely from rest in the middle of the domain for `frame` frames."""
    x, y, z = config.domain_size
    count = int(config.particles_per_cell * (config.group_size / config.cell_size) ** 3) + 1
    draw_N3 = np.random.default_rng(0).random((count, 3)) - 0.5
    scene = Scene(
        position_N3=(np.array([0.5 * x, 0.5 * y, 0.5 * z]) + config.group_size * draw_N3).astype(np.float32),
        velocity_N3=np.zeros((count, 3), np.float32),
        material_N=np.full(count, MATERIALS.index(material), np.uint8),
        domain_size=config.domain_size,
        cell_size=config.cell_size,
        gravity=config.gravity,
    )
    start = simulator.start([InitialState.of_scene(scene)])
    gravity_3 = torch.tensor(config.gravity, dtype=torch.float64) / simulator.frame_rate_hz**2
    ages_M = frame - torch.arange(start.velocity_NM3.shape[1], dtype=torch.float64)
    velocity_M3 = ((ages_M - 0.5)[:, None] * gravity_3).to(start.velocity_NM3)
    return replace(start, velocity_NM3=velocity_M3.expand_as(start.velocity_NM3).contiguous())


def _answer(simulator: Simulator, state: ParticleState, added_NM: torch.Tensor) -> float:
    """What velocities added along x change in the acceleration along x, in shares of the last one's."""
    velocity_NM3 = state.velocity_NM3.clone()
    velocity_NM3[..., 0] += added_NM
    changed = _acceleration(simulator, replace(state, velocity_NM3=velocity_NM3)) - _acceleration(simulator, state)
    last_N = added_NM[:, 0]
    return float((changed[:, 0] * last_N).sum() / last_N.square().sum())


@torch.inference_mode()
def _acceleration(simulator: Simulator, state: ParticleState) -> torch.Tensor:
    return simulator.backend.predict(state)
