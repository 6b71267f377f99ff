"""Targets of simulated frames: how the data move at the simulated positions.

A simulated particle is at x, the same particle in the data at a, and both have a next frame. The target is

    x + v(x) + PULL * (a - x)

v(x) is the velocity of the data at x, not at a: v(x) = v + G (x - a), where G is the local velocity gradient of the
data. If a tumbling body has turned less than in the data, the velocities of its particles in the data make it
contract (by 3 % a frame for snow in `scene=world`); v(x) only turns it.

An elastic body returns to its shape faster than to its position, because its sound crosses it in less than a frame.
The data, moved and turned as one rigid body onto the simulated body, give its shape. The target removes SHAPE_PULL of
the difference from it, and PULL of the rigid motion.

G is a least-squares fit with the weights 1 - r^2 / R^2 within the finest cell size R, to the same material only.
Shape legend: H velocity history, F simulated frames, T = H + F + 2 frames of the data, W = H + 2 frames of a window,
N particles, V values.
"""

from collections.abc import Sequence

import torch

PULL = 0.1  # fraction of the position error that a target removes
SHAPE_PULL = 0.5  # fraction of an elastic body's deformation that a target removes
LIMIT = 0.5  # position errors are clamped to this on each axis, in finest cells
SMALLEST = 1e-4  # least mean square offset of neighbours in a gradient, in finest cells squared
TOGETHER = 2**18  # particles of all frames of which moments are in memory at a time
ROWS, ENTRIES = 512, 2**25  # particles, and pairs of particles, that are computed together


def pushforward_windows(
    true_TN3: torch.Tensor,
    simulated_FN3: torch.Tensor,
    cell_size: float,
    material_N: torch.Tensor,
    bodies: Sequence[torch.Tensor] = (),
) -> torch.Tensor:
    """Returns the windows of one scene's simulation, [F, W, N, 3].

    true_TN3 contains the frames of the data from H before the simulation's start to F + 1 after it, simulated_FN3 the F
    frames after the start. A window ends with a simulated frame and its target. `bodies` are the particles of each
    elastic body, as int64. Walls are ignored.
    """
    history = len(true_TN3) - len(simulated_FN3) - 2
    positions_TN3 = torch.cat([true_TN3[: history + 1], simulated_FN3])
    inputs = positions_TN3.unfold(0, history + 1, 1)[1:].permute(0, 3, 1, 2)  # [F, H + 1, N, 3]
    true_FN3, velocity_FN3 = true_TN3[history + 1 : -1].double(), true_TN3[history + 1 :].double().diff(dim=0)
    limit = LIMIT * cell_size
    near_FN3 = (true_FN3 - simulated_FN3).clamp(-limit, limit)
    blocks = [x_FN3.split(max(1, TOGETHER // len(material_N))) for x_FN3 in (true_FN3, velocity_FN3, -near_FN3)]
    step_FN3 = torch.cat(
        [moved_velocities(x, v, offset, material_N, cell_size=cell_size) for x, v, offset in zip(*blocks, strict=True)]
    )
    pull_FN3 = PULL * near_FN3
    for body_B in bodies:
        rigid_FB3 = rigidly_moved(true_FN3[:, body_B], simulated_FN3[:, body_B].double())
        position_FB3 = (true_FN3[:, body_B] - rigid_FB3).clamp(-limit, limit)
        pull_FN3[:, body_B] = PULL * position_FB3 + SHAPE_PULL * (rigid_FB3 - simulated_FN3[:, body_B])
    target_FN3 = (simulated_FN3 + step_FN3 + pull_FN3).to(simulated_FN3.dtype)
    return torch.cat([inputs, target_FN3[:, None]], dim=1)


def moved_velocities(
    position_FN3: torch.Tensor,
    velocity_FN3: torch.Tensor,
    offset_FN3: torch.Tensor,
    material_N: torch.Tensor,
    cell_size: float,
) -> torch.Tensor:
    """Returns the velocities at `position_FN3` + `offset_FN3`, by local least-squares gradients, [F, N, 3]."""
    moments_FN33 = position_FN3[..., :, None] * position_FN3[..., None, :]
    products_FN33 = velocity_FN3[..., :, None] * position_FN3[..., None, :]
    values_FNV = torch.cat([position_FN3, velocity_FN3, moments_FN33.flatten(2), products_FN33.flatten(2)], -1)
    means_FNV = neighbour_means(position_FN3, values_FNV, material_N, cell_size)
    mean_FN3, mean_velocity_FN3, moments_FN9, products_FN9 = means_FNV.split([3, 3, 9, 9], -1)
    moments_FN33 = moments_FN9.unflatten(-1, (3, 3)) - mean_FN3[..., :, None] * mean_FN3[..., None, :]
    products_FN33 = products_FN9.unflatten(-1, (3, 3)) - mean_velocity_FN3[..., :, None] * mean_FN3[..., None, :]
    floor_33 = SMALLEST * cell_size**2 * torch.eye(3, dtype=moments_FN33.dtype, device=moments_FN33.device)
    weighted_FN3 = torch.linalg.solve(moments_FN33 + floor_33, offset_FN3)
    return velocity_FN3 + (products_FN33 @ weighted_FN3[..., None]).squeeze(-1)


def neighbour_means(
    position_FN3: torch.Tensor, value_FNV: torch.Tensor, material_N: torch.Tensor, cell_size: float
) -> torch.Tensor:
    """Returns the weighted means of values over each particle's neighbours and itself, [F, N, V].

    Particles are sorted along the longest axis, so that groups of ROWS are compared with the near ones only.
    """
    frames, count, _ = position_FN3.shape
    axis = int((position_FN3.amax((0, 1)) - position_FN3.amin((0, 1))).argmax())
    key_FN, order_FN = position_FN3[..., axis].sort(dim=1)
    frame_F1 = torch.arange(frames, device=key_FN.device)[:, None]
    # materials are a fourth coordinate, farther apart than neighbours
    apart_FN1 = (2.0 * material_N.to(position_FN3)).expand(frames, -1)[..., None]
    place_FN4 = torch.cat([(position_FN3 - position_FN3.mean((0, 1))) / cell_size, apart_FN1], -1)[frame_F1, order_FN]
    square_FN1, one_FN1 = place_FN4.square().sum(-1, keepdim=True), torch.ones_like(apart_FN1)
    row_FN6 = torch.cat([2 * place_FN4, 1 - square_FN1, one_FN1], -1)  # row . column = 1 - r^2 / R^2
    column_F6N = torch.cat([place_FN4, one_FN1, -square_FN1], -1).transpose(1, 2)
    values_FNV = torch.cat([value_FNV, one_FN1], -1)[frame_F1, order_FN]
    first_C = torch.arange(0, count, ROWS, device=key_FN.device)
    last_C = (first_C + ROWS).clamp(max=count)
    low_C = torch.searchsorted(key_FN, key_FN[:, first_C] - cell_size).amin(0)
    high_C = torch.searchsorted(key_FN, key_FN[:, last_C - 1] + cell_size, right=True).amax(0)
    sums_FNV = torch.empty_like(values_FNV)
    for first, last, low, high in torch.stack([first_C, last_C, low_C, high_C], 1).tolist():
        together = max(1, ENTRIES // ((last - first) * (high - low)))
        for frame in range(0, frames, together):
            block = slice(frame, frame + together)
            weight_FRC = (row_FN6[block, first:last] @ column_F6N[block, :, low:high]).clamp_(min=0)
            sums_FNV[block, first:last] = weight_FRC @ values_FNV[block, low:high]
    means_FNV = torch.empty_like(value_FNV)
    means_FNV[frame_F1, order_FN] = sums_FNV[..., :-1] / sums_FNV[..., -1:]
    return means_FNV


def rigidly_moved(shape_FB3: torch.Tensor, onto_FB3: torch.Tensor) -> torch.Tensor:
    """Returns the shapes moved and turned by least squares onto the others (Kabsch 1976), [F, B, 3]."""
    centre_F13, onto_centre_F13 = shape_FB3.mean(1, keepdim=True), onto_FB3.mean(1, keepdim=True)
    offset_FB3 = shape_FB3 - centre_F13
    left_F33, _, right_F33 = torch.linalg.svd(offset_FB3.transpose(1, 2) @ (onto_FB3 - onto_centre_F13))
    sign_F = torch.linalg.det(left_F33 @ right_F33).sign()
    left_F33 = torch.cat([left_F33[..., :2], left_F33[..., 2:] * sign_F[:, None, None]], -1)
    return onto_centre_F13 + offset_FB3 @ left_F33 @ right_F33
