"""Relative inputs: features that do not change with a motion common to all particles (`network.inputs: relative`).

The paper (sec. 3.1) has absolute velocities and wall distances instead. Away from surfaces relative inputs do not
depend on a common velocity. In free flight they do not depend on gravity either. The acceleration is g + output.
f(x) = asinh(x / s_a), where s_a is the normaliser's scale. f is odd, so features transform with the symmetries of the
cube. The columns are, in this order:

| columns | value |
|---|---|
| 3 (H - 1) | f(v^{n-k} - v^{n-k-1} - g), k = 0 … H - 2: zero in free flight |
| 3 L | f(v^n - U_l) on each level, finest first; U_l is the mean velocity of the cells around (`surroundings`) |
| 3 | G f(v^n - V): the velocity relative to surfaces, if one is near; V as in hgn.network.moving |
| 6 | `wall_nearness`, lower x, y, z, then upper |
| 3 + 3 | obstacle normals at the particle and ahead of it; only with obstacle_features |

G = sum_C w_pC t_C, with t_C = `contact` of `disturbance`, is at least the particle's own `particle_contact`. G is above
0 if a surface is within reach of some particle in the same coarsest cells, or in their face neighbours, as in a pile.

The decoder returns an acceleration r and a stress sigma for each particle. `balanced` computes the acceleration from
them. These properties hold for any parameters:
- Without relative motion the output is 0: a free body that neither rotates nor deforms has exactly acceleration g.
- Without a surface within reach momentum is conserved. The mean of r over a coarsest cell is subtracted, and cells
  exchange only antisymmetric impulses across their faces.
- Angular momentum is then conserved too. The rotation of a cell, and of each pair of neighbours, is subtracted.
- Surfaces without friction push along their normals only, and surfaces with friction as in hgn.network.own_physics.
Shape legend: N particles, H velocities, L levels, C cells of a level, E directed edges, S scenes.
"""

from dataclasses import dataclass

import torch

from hgn.config import NetworkConfig
from hgn.network.centres import SMALLEST_MASS, adjugate, inertia, rotation, trace
from hgn.network.features import ParticleState
from hgn.network.grid import DIRECTION_63, GridHierarchy
from hgn.network.moving import surface_velocity
from hgn.network.obstacles import ObstacleCells, first_surface
from hgn.network.own_physics import SurfaceFriction, friction_fraction, has_friction, surface_friction, wall_contact

CONTACT_REACH_CELLS = 3.0  # distance from a wall within which the network sees it, in finest cells
WALL_LIMIT = 2.0  # largest wall_nearness, reached one `reach` behind the plane
STEPS_AHEAD = 4  # number of positions on the path of the next frame that are searched for an obstacle
QUIET = 0.01  # the disturbance is 1 at this difference of velocities, in units of s_a; rounding gives 1e-5 to 1e-4
OUTPUTS = 9  # numbers of the decoder per particle: an acceleration, and a stress xx, yy, zz, yz, xz, xy
STRESS_33 = ((3, 8, 7), (8, 4, 6), (7, 6, 5))  # columns of the stress in the decoder's output
# A surface's effect on a cell fades if its weight in P (see `slip`) is less than FEW, or than RARE times P's trace.
FEW, RARE = 0.1, 1e-3


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of the coarsest cells: the two results of `disturbance` [C], 0 to 1, and `contact_normals` [C, 3, 3]."""

    disturbed_C: torch.Tensor
    contact_C: torch.Tensor
    normal_C33: torch.Tensor
    friction: SurfaceFriction | None = None  # None: no surface has friction


def relative_features(
    state: ParticleState, grid: GridHierarchy, config: NetworkConfig, scale: torch.Tensor
) -> tuple[torch.Tensor, Contacts]:
    """Returns all columns except the embedding, [N, feature_width - 16], and the contacts of the coarsest cells.

    `scale` is s_a in frame units.
    """
    velocity_N3 = state.velocity_NM3[:, 0]
    wall_N6 = wall_nearness(
        state.position_N3, velocity_N3, state.domain_S3[state.scene_N], CONTACT_REACH_CELLS * config.cell_size
    )
    normal_N6 = cell_N8 = surface_N3 = None
    if config.obstacle_features:
        place = state.position_N3, velocity_N3, state.scene_N
        if state.moving is None:
            cell_N8 = obstacle_surfaces(*place, state.obstacles)
        else:
            cell_N8, surface_N3 = state.moving.met(state.obstacles, place, STEPS_AHEAD)
        normal_N6 = cell_N8 if cell_N8.shape[1] == 6 else torch.cat([cell_N8[:, :3], cell_N8[:, 4:7]], dim=-1)
    motion_NK = torch.cat(
        [
            torch.asinh(history(state.velocity_NM3, state.gravity_S3[state.scene_N]) / scale),
            torch.asinh(surroundings(velocity_N3, grid) / scale),
        ],
        dim=-1,
    )
    local, contact_N = config.body_cells, particle_contact(wall_N6, normal_N6, config.obstacle_distance)
    normal_C33 = contact_normals(surface_normals(wall_N6, normal_N6, local), grid)
    disturbed_C, contact_C = disturbance(motion_NK, contact_N, grid)
    if surface_N3 is not None:
        velocity_N3 = velocity_N3 - surface_velocity(contact_N, surface_N3, contact_C, grid)
    friction = None
    if has_friction(state) and "friction" in config.own_physics:
        friction = surface_friction(state, grid, wall_N6, cell_N8, velocity_N3=velocity_N3, scale=scale, local=local)
    contacts = Contacts(disturbed_C, contact_C, normal_C33, friction)
    gate_N1 = grid.coarsest.at_particles(contact_C[:, None])
    parts = [motion_NK, gate_N1 * torch.asinh(velocity_N3 / scale), wall_N6]
    return torch.cat(parts if normal_N6 is None else [*parts, normal_N6], dim=-1), contacts


def history(velocity_NH3: torch.Tensor, gravity_N3: torch.Tensor) -> torch.Tensor:
    """Returns the accelerations of the past frames minus gravity, newest first, [N, 3 (H - 1)]."""
    return (velocity_NH3[:, :-1] - velocity_NH3[:, 1:] - gravity_N3[:, None]).flatten(1)


def surroundings(velocity_N3: torch.Tensor, grid: GridHierarchy) -> torch.Tensor:
    """Returns velocities minus the mean velocities of the surrounding cells on each level, [N, 3 L].

    A cell's velocity is sum(w v) / sum(w) with the trilinear weights w of its particles; coarser levels add the sums of
    the children. A particle's mean on a level is that of the ancestors of its eight finest cells, with the same w.
    """
    momentum_C4 = grid.finest.sums(torch.cat([velocity_N3, torch.ones_like(velocity_N3[:, :1])], -1))
    ancestor_C, columns = torch.arange(momentum_C4.shape[0], device=velocity_N3.device), []
    for i, level in enumerate(grid.levels):
        columns.append((momentum_C4[:, :3] / momentum_C4[:, 3:].clamp(min=SMALLEST_MASS))[ancestor_C])
        if level.parent_C is not None:
            coarse_C4 = momentum_C4.new_zeros(grid.levels[i + 1].cell_count, 4)
            momentum_C4 = coarse_C4.index_add_(0, level.parent_C, momentum_C4)
            ancestor_C = level.parent_C[ancestor_C]
    return velocity_N3.repeat(1, len(columns)) - grid.finest.at_particles(torch.cat(columns, dim=-1))


def wall_nearness(
    position_N3: torch.Tensor, velocity_N3: torch.Tensor, domain_N3: torch.Tensor, reach: float
) -> torch.Tensor:
    """Returns the nearness of the domain's six planes, lower planes first, [N, 6].

    It is 0 at distances of `reach` and more, 1 at the plane, and at most 2. For a particle that approaches a plane, the
    distance one frame later is used, at the present velocity.
    """
    distance_N6 = torch.cat([position_N3, domain_N3 - position_N3], dim=-1)
    away_N6 = torch.cat([velocity_N3, -velocity_N3], dim=-1)
    return (1 - (distance_N6 + away_N6.clamp(max=0)) / reach).clamp(0.0, WALL_LIMIT)


def obstacle_surfaces(
    position_N3: torch.Tensor, velocity_N3: torch.Tensor, scene_N: torch.Tensor, obstacles: ObstacleCells | None
) -> torch.Tensor:
    """Returns `ObstacleCells.surfaces` at the particle, and those first met on its path to the next frame, [N, 6 or 8].

    STEPS_AHEAD evenly spaced positions on the path are tested. Without an obstacle a normal is 0.
    """
    if obstacles is None:
        return torch.zeros_like(position_N3).repeat(1, 2)
    part_K11 = torch.arange(STEPS_AHEAD + 1, device=scene_N.device)[:, None, None] / STEPS_AHEAD
    position_KN3 = position_N3 + velocity_N3 * part_K11.to(velocity_N3)
    row_XV = obstacles.surfaces(position_KN3.flatten(0, 1), scene_N.repeat(STEPS_AHEAD + 1))
    here_NV, *ahead = row_XV.unflatten(0, position_KN3.shape[:2]).unbind(0)
    return torch.cat([here_NV, first_surface(ahead)], dim=-1)


def particle_contact(wall_N6: torch.Tensor, normal_N6: torch.Tensor | None, distance: bool) -> torch.Tensor:
    """Returns contacts of particles [N]: 1 with an obstacle normal, else twice the largest wall nearness, at most 1.

    With `distance` (network.obstacle_distance) the length of a normal is its nearness, and counts as that of a wall.
    """
    near_N = wall_N6.amax(-1)
    if normal_N6 is None:
        return (2 * near_N).clamp(max=1)
    if distance:
        near_N = torch.maximum(near_N, normal_N6.unflatten(1, (2, 3)).norm(dim=-1).amax(-1))
        return (2 * near_N).clamp(max=1)
    return torch.where(normal_N6.any(-1), 1, (2 * near_N).clamp(max=1))


def surface_normals(wall_N6: torch.Tensor, normal_N6: torch.Tensor | None, local: bool) -> torch.Tensor:
    """Returns the sum of n n^T of the surfaces that can push a particle, [N, 3, 3].

    n n^T of a wall is multiplied by its `wall_contact`. The obstacle's normal at the particle is used; if it
    is 0, the one ahead. n and -n give the same n n^T, so two surfaces that face each other do not cancel.
    """
    near_N6 = wall_contact(wall_N6, local)
    normal_N33 = torch.diag_embed(near_N6[:, :3] + near_N6[:, 3:])
    if normal_N6 is None:
        return normal_N33
    first_N3 = first_surface(normal_N6.split(3, dim=1))
    return normal_N33 + first_N3[:, :, None] * first_N3[:, None, :]


def contact_normals(normal_N33: torch.Tensor, grid: GridHierarchy) -> torch.Tensor:
    """Returns P [C, 3, 3]: sums of w_pC times `surface_normals` in a coarsest cell."""
    return grid.coarsest.sums(normal_N33.flatten(1)).unflatten(1, (3, 3))


def slip(normal_C33: torch.Tensor) -> torch.Tensor:
    """Returns Q = (1 + P / (FEW + RARE tr P))^-1 [C, 3, 3] of the `contact_normals` P.

    Q projects on directions that surfaces leave free. Away from surfaces it is 1. Near a plane it is 1 along the plane
    and almost 0 along its normal. Between two planes it is 1 only along their common edge.
    """
    ratio_C33 = normal_C33 / (FEW + RARE * trace(normal_C33))[:, None, None]
    determinant_C, adjugate_C33 = adjugate(ratio_C33 + torch.eye(3, dtype=ratio_C33.dtype, device=ratio_C33.device))
    return adjugate_C33 / determinant_C[:, None, None]


def disturbance(
    motion_NK: torch.Tensor, contact_N: torch.Tensor, grid: GridHierarchy
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns `disturbed` and `contact` of each coarsest cell, [C] each, from 0 to 1.

    `disturbed` is 0 if all particles around fly freely with one velocity. A particle is disturbed by a surface within
    reach (`particle_contact`), or if a column of history or surroundings is not small compared with QUIET. A coarsest
    cell is as disturbed as the most disturbed particle in it and in its face neighbours. These cells count because an
    impact crosses a body within one frame. `contact` is computed in the same way, from surfaces only.
    """
    own_N = (contact_N + (motion_NK / QUIET).square().sum(-1)).clamp(max=1)
    groups, cell_G8, coarsest = grid.groups, grid.coarsest.centre_G8, grid.levels[-1]

    def spread(value_N: torch.Tensor) -> torch.Tensor:
        own_G = value_N.new_zeros(groups.count).scatter_reduce(0, groups.group_N, value_N, "amax")
        own_C, own_G8 = value_N.new_zeros(coarsest.cell_count), own_G[:, None].expand(-1, 8)
        own_C = own_C.scatter_reduce(0, cell_G8.flatten(), own_G8.flatten(), "amax")
        return own_C.scatter_reduce(0, coarsest.receiver_E, own_C[coarsest.sender_E], "amax")

    return spread(own_N), spread(contact_N)


def balanced(output_N9: torch.Tensor, contacts: Contacts, grid: GridHierarchy) -> torch.Tensor:
    """Returns normalised accelerations without gravity, [N, 3], from the decoder's output and the contacts.

        a_p = sum_C w_pC d_C (r_p - (1 - t_C) R_C + A_C),    A_C = sum_C' d_C' f' T,    T = (sigma_C + sigma_C') e / 2

        w_pC               weight of particle p in coarsest cell C
        M_C, R_C, sigma_C  mass of the cell, its mean acceleration and its mean stress, with these weights
        d_C, t_C           disturbance and contact (see `disturbance`)
        e                  unit vector from the cell to its neighbour C'
        f, f'              M_C / (M_C + M_C') and 1 - f

    Each term of M_C d_C A_C is antisymmetric in C and C', as in finite volumes, and no term is divided by a small mass.
    So sum_p a_p is sum_C d_C t_C M_C R_C, which is 0 without a surface within reach.

    Rotation is subtracted in two places, so that sum_p x_p x a_p is 0 too without a surface within reach. Both are
    projections times a factor q from 0 to 1, so they never enlarge mean squares. X is a cell's centre of mass, and
    y_p = x_p - X. (q, W) = rotation(I, J) is computed from an inertia I and an angular momentum J.
    - In a cell r_p - R becomes q (r_p - R) - W x y_p. I and J are the cell's means of inertia and of y x r.
    - A pair's forces T and -T have a torque, because they do not act along D = X' - X. Their field is f' T in the cell
      and -f T in C'. It is multiplied by q, and the rotation W about the pair's centre is subtracted. In the cell this
      gives f' (q T + W x D) - W x y_p. Here I = I_C f + I_C' f' + f f' (D^2 - D D^T) and J = -f f' D x T.

    t_C Q_C R_C is subtracted too, where Q is `slip` of the `contact_normals`. Then the mean force of surfaces on a cell
    is along their normals, for any parameters. Friction keeps a part of Q_C R_C (`own_physics.friction_fraction`).
    """
    disturbed_C, contact_C = contacts.disturbed_C, contacts.contact_C
    level, coarsest = grid.levels[-1], grid.coarsest
    mass_C1, centre_C3, inertia_C33 = coarsest.bodies
    mean_C3, known_C, turn_C3 = coarsest.motion(output_N9[:, :3])
    stress_C6, mass_C = coarsest.sums(output_N9[:, 3:]) / mass_C1, mass_C1[:, 0]
    stress_C33 = stress_C6[:, torch.tensor(STRESS_33, device=stress_C6.device) - 3]
    sender_E, receiver_E = level.sender_E, level.receiver_E
    towards_E3 = DIRECTION_63.to(mean_C3)[level.direction_E]
    traction_E3 = ((stress_C33[receiver_E] + stress_C33[sender_E]) @ towards_E3[..., None]).squeeze(-1)
    share_E = 0.5 * disturbed_C[sender_E] * mass_C[sender_E] / (mass_C[sender_E] + mass_C[receiver_E])
    free_C = 1 - contact_C
    own_C = disturbed_C * (contact_C + free_C * known_C)
    apart_E3 = towards_E3 + centre_C3[sender_E] - centre_C3[receiver_E]
    part_E = mass_C[receiver_E] / (mass_C[sender_E] + mass_C[receiver_E])
    both_E = part_E * (1 - part_E)
    inertia_E33 = both_E[:, None, None] * inertia(apart_E3[:, :, None] * apart_E3[:, None, :])
    inertia_E33 = inertia_E33 + part_E[:, None, None] * inertia_C33[receiver_E]
    inertia_E33 = inertia_E33 + (1 - part_E)[:, None, None] * inertia_C33[sender_E]
    known_E, turn_E3 = rotation(inertia_E33, -both_E[:, None] * torch.linalg.cross(apart_E3, traction_E3))
    push_E3 = known_E[:, None] * traction_E3 + torch.linalg.cross(turn_E3, apart_E3)
    change_C3 = (free_C * known_C)[:, None] * -mean_C3
    slip_C33 = slip(contacts.normal_C33)
    along_C3 = (slip_C33 @ mean_C3[..., None]).squeeze(-1)
    if contacts.friction is not None:
        pushed_C3 = torch.zeros_like(along_C3).index_add(0, receiver_E, share_E[:, None] * push_E3)
        free_C3 = (slip_C33 @ (contacts.friction.velocity_C3 + disturbed_C[:, None] * pushed_C3)[..., None]).squeeze(-1)
        force_C3 = (disturbed_C * contact_C)[:, None] * along_C3
        push_C3 = force_C3 / (FEW + RARE * trace(contacts.normal_C33))[:, None]
        part_C = friction_fraction(contacts.friction, force_C3, push_C3, free_C3, slip_C33)
        along_C3 = along_C3 - part_C[:, None] * along_C3
    change_C3 = change_C3 - contact_C[:, None] * along_C3
    change_C3 = disturbed_C[:, None] * change_C3.index_add(0, receiver_E, share_E[:, None] * push_E3)
    half_E = 0.5 * disturbed_C[sender_E]
    turn_C3 = (free_C[:, None] * turn_C3).index_add(0, receiver_E, half_E[:, None] * turn_E3)
    turn_C3 = disturbed_C[:, None] * turn_C3
    own_N1, change_N3 = coarsest.field(own_C, change_C3, turn_C3)
    return own_N1 * output_N9[:, :3] + change_N3
