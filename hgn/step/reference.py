"""The constraints of a frame in PyTorch: rest, walls and obstacles; the reference of the backend triton.

Each stage takes the result of the stage before:

    Prediction --rested--> accelerations --moved--> FreeMotion --constrained--> Motion --next_state--> ParticleState

docs/concepts/constraints.md derives the constraints. `Deformation` computes the operator P of the **rest** constraint:

    (P u)_p = sum_K w_pK min(1, 2 q_K) (u_p - mean_K - Omega_K x y_pK),    accelerations become a - P (phi P (v + a))

    K        centre of a coarsest cell; its mean, rotation and centre of mass use the weights w_pK
    w_pK     trilinear weight of centre K at particle p, times the particle's gate sum_C w_pC t_C (t = contact)
    mean_K   mean of u; Omega_K is the rate of rotation of u; y_pK is the place of p relative to the centre of mass
    q_K      1 where the rotation is determined by the particles, 0 where it is not (`rotation`)
    phi      2 - |d|^2 / (threshold |g|)^2, clamped to 0 to 1, for d = P (v + a)

The remaining deformation is reduced in the same way on cells four times as large, except for FRICTIONLESS materials.
**Obstacles** stop particles on both sides of a triangle. A particle exactly on a plane counts as on the normal's side.
Suffixes of names: N particles, C coarsest cells, K centres of cells, F triangles, P pairs of particles and triangles,
L lists of triangles near a particle.
"""

from dataclasses import dataclass, replace

import torch
from torch import nn
from torch.compiler import is_exporting

from hgn.network.barriers import Barriers
from hgn.network.base import ParticleNetwork, Prediction
from hgn.network.cell_keys import COORDINATE_LIMIT, LARGEST_EXPORTED, find, pack, unique, unpack
from hgn.network.centres import Centres, Groups
from hgn.network.features import ParticleState
from hgn.network.grid import CORNER_83, GridHierarchy, trilinear
from hgn.step_config import StepConfig

SURE = 0.5  # smallest q at which rotation is removed in full
LEAST = 1e-30  # lower bound of a squared limit; avoids a division by zero
REST_SIZES, LEVEL_SHIFT = 2, 2  # number of cell sizes; each size is 2^LEVEL_SHIFT times the size before
FRICTIONLESS = ("water",)  # materials without rest on the larger cells
# Contact is tested at (1 - SLACK) clearance. End points lie at the clearance, so rounding triggers no second contact.
# A particle that starts nearer than this and approaches ends SLACK * clearance farther away than it started.
SLACK = 0.02
SURFACES = 3  # largest number of triangles that shift the end of one path; at the next triangle the path ends
PAIRS_AT_ONCE = 1 << 20  # largest number of pairs of particles and triangles; a pair takes 500 bytes
LEAST_CREASE = 1e-4  # squared sine of the angle between two planes; planes at a smaller angle count as one


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """Positions and velocities [N, 3] after a frame without walls and obstacles."""

    position_N3: torch.Tensor
    velocity_N3: torch.Tensor


@dataclass(frozen=True, eq=False)
class Motion:
    """Positions and velocities [N, 3] after a frame."""

    position_N3: torch.Tensor
    velocity_N3: torch.Tensor


def accelerations(
    network: ParticleNetwork, state: ParticleState, prediction: Prediction, step: StepConfig | None = None
) -> torch.Tensor:
    """Returns accelerations [N, 3] in frame units after the rest constraint of `step` (default: `network.step`)."""
    return network.restored_acceleration(rested(network, state, prediction, step), state)


class Accelerations(nn.Module):
    """Computes `accelerations` of a state as a module, for CUDA graphs and gradients."""

    def __init__(self, network: ParticleNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, state: ParticleState) -> torch.Tensor:
        return accelerations(self.network, state, self.network.prediction(state))


def rested(
    network: ParticleNetwork, state: ParticleState, prediction: Prediction, step: StepConfig | None = None
) -> torch.Tensor:
    """Returns the normalised accelerations [N, 3] after the rest constraint of `step` (default: `network.step`)."""
    step = network.step if step is None else step
    if not step.rests:
        return prediction.acceleration_N3
    assert prediction.contacts is not None and prediction.grid is not None
    scale = network.normaliser.acceleration_std[0]
    widely_M = torch.tensor(rests_widely(network.config.materials), dtype=scale.dtype, device=scale.device)
    contact_C = prediction.contacts.contact_C
    return rest(prediction.acceleration_N3, state, contact_C, prediction.grid, step.rest_threshold, scale, widely_M)


def advanced(state: ParticleState, acceleration_N3: torch.Tensor, step: StepConfig, dimensions: int) -> ParticleState:
    """Returns the state after a frame with these accelerations [N, 3] in frame units."""
    return next_state(state, constrained(state, moved(state, acceleration_N3), step, dimensions))


def moved(state: ParticleState, acceleration_N3: torch.Tensor) -> FreeMotion:
    """Integrates a frame: v += a, x += v."""
    velocity_N3 = state.velocity_NM3[:, 0] + acceleration_N3
    return FreeMotion(state.position_N3 + velocity_N3, velocity_N3)


def constrained(state: ParticleState, motion: FreeMotion, step: StepConfig, dimensions: int) -> Motion:
    """Applies moving obstacles, walls, then obstacles at rest. `state` is the state before the frame.

    A shifted end changes the velocity. Particles that are not `within_range` keep their positions, so that divergence
    stays visible.
    """
    position_N3 = motion.position_N3
    if step.wall_clearance is None and step.obstacle_clearance is None:
        return Motion(position_N3, motion.velocity_N3)
    if state.moving is not None and state.moving.barriers is not None:
        position_N3 = _outside_moving(state, position_N3, step, dimensions, state.moving.barriers)
    if step.wall_clearance is not None:
        position_N3 = _walled(state, position_N3, step.wall_clearance, dimensions)
    if step.obstacle_clearance is not None and state.barriers is not None:
        position_N3 = _outside_obstacles(state, position_N3, step, dimensions, state.barriers)
    changed_N3 = position_N3 != motion.position_N3
    return Motion(position_N3, torch.where(changed_N3, position_N3 - state.position_N3, motion.velocity_N3))


def next_state(state: ParticleState, motion: Motion) -> ParticleState:
    """Returns the state after a motion. It stores the velocity itself, not a difference of positions."""
    history_NM3 = torch.cat([motion.velocity_N3[:, None], state.velocity_NM3[:, :-1]], dim=1)
    moving = state.moving and state.moving.later()
    state = replace(state, moving=moving, frame_S=state.frame_S + 1)
    return replace(state, position_N3=motion.position_N3, velocity_NM3=history_NM3)


def within_range(position_N3: torch.Tensor, domain_N3: torch.Tensor) -> torch.Tensor:
    """Returns whether coordinates are finite and no farther from the domain than its own size, bool [N, 3]."""
    return (position_N3 > -domain_N3) & (position_N3 < 2 * domain_N3)


# rest


class Deformation:
    """The operator P on cells 2^shift times as large as the coarsest cells of a grid.

    Called with a field [N, 3], it returns the deformation part of the field [N, 3].
    Weights are multiplied by `contact_C` of the cells, and by `weight_N` of the particles.
    """

    def __init__(
        self, contact_C: torch.Tensor, grid: GridHierarchy, shift: int = 0, weight_N: torch.Tensor | None = None
    ) -> None:
        coarsest, corner_83 = grid.coarsest, CORNER_83.to(contact_C.device)
        gate_N1 = coarsest.at_particles(contact_C[:, None])
        if weight_N is not None:
            gate_N1 = weight_N[:, None] * gate_N1
        first_G = coarsest.centre_G8[:, 0]
        scene_N, coordinate_N3 = (x[first_G[grid.groups.group_N]] for x in unpack(grid.levels[-1].key_C))
        place_N3 = coarsest.place_N3 + coarsest.offset_G83[:, 0].expand(first_G.shape[0], 3)[grid.groups.group_N]
        low_N3 = torch.floor(place_N3)
        low_N3, place_N3 = coordinate_N3 + low_N3.long(), place_N3 - low_N3
        wide_N3 = low_N3 >> shift
        place_N3 = (low_N3 - (wide_N3 << shift) + place_N3) / 2**shift
        key_G, group_N = unique(pack(scene_N, wide_N3))
        scene_G, wide_G3 = unpack(key_G)
        key_K, centre_G8 = unique(pack(scene_G[:, None], wide_G3[:, None] + corner_83))
        groups = Groups(gate_N1 * trilinear(place_N3), group_N, key_G.shape[0])
        offset_183 = -corner_83.to(place_N3)[None]
        self.centres = Centres(groups, place_N3, centre_G8, offset_183, key_K.shape[0])

    def __call__(self, value_N3: torch.Tensor) -> torch.Tensor:
        mean_K3, known_K, turn_K3 = self.centres.motion(value_N3)
        share_K = 1 / known_K.clamp(min=SURE)
        factor_K = share_K * known_K
        factor_N1, field_N3 = self.centres.field(factor_K, -factor_K[:, None] * mean_K3, share_K[:, None] * turn_K3)
        return factor_N1 * value_N3 + field_N3


def rest(
    acceleration_N3: torch.Tensor,
    state: ParticleState,
    contact_C: torch.Tensor,
    grid: GridHierarchy,
    threshold: float,
    scale: torch.Tensor,
    widely_M: torch.Tensor,
) -> torch.Tensor:
    """Returns normalised accelerations [N, 3] without slow deformation. Input and result do not contain gravity.

    `scale` is the unit of the accelerations. `widely_M` is 1 for materials that also rest on the larger cells.
    """
    widely_N = widely_M[state.material_N]
    limit_N = ((threshold / scale) ** 2 * state.gravity_S3.square().sum(-1))[state.scene_N]
    for level in range(REST_SIZES):
        deformation = Deformation(contact_C, grid, level * LEVEL_SHIFT, widely_N if level else None)
        # gravity is equal for all particles of a scene, so P removes it
        rate_N3 = deformation(acceleration_N3 + state.velocity_NM3[:, 0] / scale)
        acceleration_N3 = acceleration_N3 - deformation(slow(rate_N3, limit_N))
    return acceleration_N3


def rests_widely(materials: tuple[str, ...]) -> list[bool]:
    """Returns for each material whether it rests on the larger cells too."""
    return [name not in FRICTIONLESS for name in materials]


def slow(rate_N3: torch.Tensor, limit_N: torch.Tensor) -> torch.Tensor:
    """Returns phi(d) d of the deformation d [N, 3]. `limit_N` is the squared threshold; 0 disables the constraint."""
    ratio_N = rate_N3.square().sum(-1) / limit_N.clamp(min=LEAST)
    return torch.where(limit_N > 0, (2 - ratio_N).clamp(0, 1), 0)[:, None] * rate_N3


# walls and obstacles


def _walled(
    state: ParticleState, position_N3: torch.Tensor, clearance: tuple[float, float], dimensions: int
) -> torch.Tensor:
    near, far = clearance
    before_N3, domain_N3 = state.position_N3, state.domain_S3[state.scene_N]
    low_N3 = torch.where(before_N3 < near, before_N3, near)
    high_N3 = torch.where(before_N3 > domain_N3 - far, before_N3, domain_N3 - far)
    walled_3 = torch.arange(3, device=position_N3.device) < dimensions
    stopped_N3 = ((position_N3 < low_N3) | (position_N3 > high_N3)) & within_range(position_N3, domain_N3) & walled_3
    limit_N3 = torch.where(position_N3 < low_N3, low_N3, high_N3)
    return torch.where(stopped_N3, limit_N3, position_N3)


def _outside_obstacles(
    state: ParticleState, position_N3: torch.Tensor, step: StepConfig, dimensions: int, barriers: Barriers
) -> torch.Tensor:
    """Stops the straight path of a frame at up to SURFACES triangles in turn, with walls again after each shift.

    Each triangle shifts the end along its normal. If that normal points back across the plane of the previous shift,
    the end moves along that plane instead. Otherwise a path in a groove would alternate between the two planes.
    """
    lost_N1 = ~within_range(position_N3, state.domain_S3[state.scene_N]).all(-1, keepdim=True)
    end_N3 = torch.where(lost_N1, state.position_N3, position_N3)
    row_K, last_K3 = torch.arange(end_N3.shape[0], device=end_N3.device), torch.zeros_like(end_N3)
    for surface in range(SURFACES + 1):
        before_K3, scene_K, end_K3 = state.position_N3[row_K], state.scene_N[row_K], end_N3[row_K]
        hit_K, shift_K1, normal_K3, free_K1 = first_stop(barriers, before_K3, end_K3, scene_K)
        if not is_exporting() and not bool(hit_K.any()):
            break
        if surface == SURFACES:
            moved_K3 = before_K3 + free_K1 * (end_K3 - before_K3)
        else:
            moved_K3 = end_K3 + shift_K1 * _direction(normal_K3, last_K3)
            if step.wall_clearance is not None:
                own = replace(state, position_N3=before_K3, scene_N=scene_K)
                moved_K3 = _walled(own, moved_K3, step.wall_clearance, dimensions)
        end_N3 = end_N3.index_put((row_K,), torch.where(hit_K[:, None], moved_K3, end_K3))
        last_K3 = torch.where(hit_K[:, None], normal_K3, last_K3)
        if not is_exporting():  # only a path that stops can stop again
            row_K, last_K3 = row_K[hit_K], last_K3[hit_K]
    return torch.where(lost_N1, position_N3, end_N3)


def _outside_moving(
    state: ParticleState, position_N3: torch.Tensor, step: StepConfig, dimensions: int, barriers: Barriers
) -> torch.Tensor:
    """Stops the paths of a frame at moving obstacles, in coordinates that move with each between its two poses."""
    assert state.moving is not None
    lost_N1 = ~within_range(position_N3, state.domain_S3[state.scene_N]).all(-1, keepdim=True)
    end_N3, step = torch.where(lost_N1, state.position_N3, position_N3), replace(step, wall_clearance=None)
    endless_V3 = torch.full_like(state.moving.poses.place_V3, torch.inf)
    for row_N, pose in state.moving.rows(state.scene_N, end_N3.dtype):
        own_N3, place_N3 = pose.later.undo(end_N3), pose.undo(state.position_N3)
        own = replace(state, position_N3=place_N3, scene_N=row_N, domain_S3=endless_V3)
        stopped_N3 = _outside_obstacles(own, own_N3, step, dimensions, barriers)
        end_N3 = torch.where((stopped_N3 != own_N3).any(-1, keepdim=True), pose.later.put(stopped_N3), end_N3)
    return torch.where(lost_N1, position_N3, end_N3)


def _direction(normal_N3: torch.Tensor, last_N3: torch.Tensor) -> torch.Tensor:
    """Returns the unit normals, or directions along the previous planes if the normals lead back across these.

    Such a direction has the component 1 along the normal, so that the end moves as far from the new plane as along it.
    """
    cosine_N1 = (normal_N3 * last_N3).sum(-1, keepdim=True)
    along_N3 = normal_N3 - cosine_N1 * last_N3
    square_N1 = (along_N3 * along_N3).sum(-1, keepdim=True)
    crease_N1 = (cosine_N1 < 0) & (square_N1 > LEAST_CREASE)
    return torch.where(crease_N1, along_N3 / square_N1.clamp(min=LEAST_CREASE), normal_N3)


def first_stop(
    barriers: Barriers, before_N3: torch.Tensor, after_N3: torch.Tensor, scene_N: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns the stops of the straight paths [N, 3] from `before_N3` to `after_N3` at their first triangles.

    Results: whether a triangle stops the path, bool [N]; the shift of the end [N, 1]; the unit normal of the shift
    [N, 3]; the fraction of the path before the first triangle [N, 1]. Without a stop, shift and normal are zero.
    Positions must be finite. Another triangle may stop the path to the shifted end.
    """
    candidates = _pairs(barriers, before_N3, after_N3, scene_N)
    if candidates is None:
        halves = zip(before_N3.chunk(2), after_N3.chunk(2), scene_N.chunk(2), strict=True)
        stops = (first_stop(barriers, *half) for half in halves)
        hit_N, shift_N1, normal_N3, free_N1 = map(torch.cat, zip(*stops, strict=True))
        return hit_N, shift_N1, normal_N3, free_N1
    particle_P, triangle_P = candidates
    row_P4, way_N3 = barriers.row_F24[:, :4][triangle_P].to(before_N3.dtype), after_N3 - before_N3
    distance_P = (row_P4[:, :3] * before_N3[particle_P]).sum(-1) - row_P4[:, 3]
    side_P = torch.where(distance_P >= 0, 1.0, -1.0).to(distance_P.dtype)
    distance_P, approach_P = side_P * distance_P, -side_P * (row_P4[:, :3] * way_N3[particle_P]).sum(-1)
    within, slack = (1 - SLACK) * barriers.clearance, SLACK * barriers.clearance
    if not is_exporting():  # most paths do not approach the planes of their triangles
        near_P = (approach_P > 0) & (distance_P - approach_P < within)
        values = particle_P, triangle_P, side_P, distance_P, approach_P
        particle_P, triangle_P, side_P, distance_P, approach_P = (value[near_P] for value in values)
    row_P24 = barriers.row_F24[triangle_P].to(before_N3.dtype)
    before_P3, way_P3, normal_P3 = before_N3[particle_P], way_N3[particle_P], row_P24[:, :3]
    end_P, closing_P = distance_P - approach_P, approach_P.clamp(min=1e-30)
    contact_P = ((distance_P - within) / closing_P).clamp(0, 1)
    crossing_P = (distance_P / closing_P).clamp(0, 1)
    meets_P = _covers(row_P24, before_P3 + contact_P[:, None] * way_P3)
    crosses_P = _covers(row_P24, before_P3 + crossing_P[:, None] * way_P3) & (end_P < 0)
    stops_P = (approach_P > 0) & (end_P < within) & (meets_P | crosses_P)
    time_P = torch.where(stops_P, torch.where(meets_P, contact_P, crossing_P), 2.0)
    least_N = torch.full_like(before_N3[:, 0], 2.0).scatter_reduce(0, particle_P, time_P.detach(), "amin")
    first_P = stops_P & (time_P == least_N[particle_P])
    # if a path meets several triangles at the same time, the one with the lowest number stops it
    count, pairs = barriers.row_F24.shape[0], particle_P.shape[0]
    number_P = torch.where(first_P, triangle_P, count)
    number_N = torch.full_like(scene_N, count).scatter_reduce(0, particle_P, number_P, "amin")
    first_P = first_P & (triangle_P == number_N[particle_P])
    # the index of each particle's pair; without a pair, the index of the zero row that is appended below
    place_P = torch.where(first_P, torch.arange(pairs, device=scene_N.device), pairs)
    pair_N = torch.full_like(scene_N, pairs).scatter_reduce(0, particle_P, place_P, "amin")
    push_P4 = torch.cat([(distance_P.clamp(max=within) + slack - end_P)[:, None], side_P[:, None] * normal_P3], 1)
    push_N4 = torch.cat([push_P4, before_N3.new_zeros(1, 4)])[pair_N]
    free_P = torch.where(stops_P, contact_P, 1.0)
    free_N = torch.ones_like(before_N3[:, 0]).scatter_reduce(0, particle_P, free_P, "amin")
    return pair_N < pairs, push_N4[:, :1], push_N4[:, 1:], free_N[:, None]


def _pairs(
    barriers: Barriers, before_N3: torch.Tensor, after_N3: torch.Tensor, scene_N: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Returns candidate pairs: particles and triangles, int64 [P]. They include every pair that meets.

    Returns None for several particles with more than PAIRS_AT_ONCE pairs.
    """
    if is_exporting():
        return pairs_of_boxes(barriers, before_N3, after_N3, scene_N)
    before_N3, after_N3 = before_N3.detach(), after_N3.detach()
    way_N3 = after_N3 - before_N3
    pieces_N = torch.ceil(torch.linalg.vector_norm(way_N3, dim=-1) / barriers.cell_size).clamp(min=1)
    particles, cells = [scene_N[:0]], [scene_N[:0]]
    for piece in range(int(pieces_N.max()) if len(pieces_N) else 0):
        here_N = torch.nonzero(pieces_N > piece).flatten() if piece else torch.arange(len(way_N3)).to(scene_N)
        share_N1 = ((piece + 0.5) / pieces_N[here_N])[:, None]
        cell_N3 = torch.floor((before_N3[here_N] + share_N1 * way_N3[here_N]) / barriers.cell_size)
        cell_N3 = cell_N3.clamp(-COORDINATE_LIMIT, COORDINATE_LIMIT - 1).long()
        index_N, found_N = find(barriers.key_Q, pack(scene_N[here_N], cell_N3))
        cells.append(index_N[found_N])
        particles.append(here_N[found_N])
    particle_L, cell_L = torch.cat(particles), torch.cat(cells)
    start_L = barriers.start_Q[cell_L]
    count_L = barriers.start_Q[cell_L + 1] - start_L
    count = int(count_L.sum())
    if count > PAIRS_AT_ONCE and len(scene_N) > 1:
        return None
    shift_P = torch.repeat_interleave(start_L - count_L.cumsum(0) + count_L, count_L, output_size=count)
    entry_P = torch.arange(count, device=scene_N.device) + shift_P
    return torch.repeat_interleave(particle_L, count_L, output_size=count), barriers.triangle_E[entry_P]


def pairs_of_boxes(
    barriers: Barriers, before_N3: torch.Tensor, after_N3: torch.Tensor, scene_N: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the pairs of triangles and particles' paths whose boxes meet, without a loop over the pieces of paths.

    Without scenes of the triangles (`scene_F`) all are of one scene.
    """
    low_N3, high_N3 = torch.minimum(before_N3, after_N3), torch.maximum(before_N3, after_N3)
    low_F3, high_F3 = barriers.row_F24[:, 16:19], barriers.row_F24[:, 20:23]
    meets_NF = (low_N3[:, None, 0] <= high_F3[None, :, 0]) & (high_N3[:, None, 0] >= low_F3[None, :, 0])
    for axis in (1, 2):
        meets_NF = meets_NF & (low_N3[:, None, axis] <= high_F3[None, :, axis])
        meets_NF = meets_NF & (high_N3[:, None, axis] >= low_F3[None, :, axis])
    if barriers.scene_F.shape[0] > 0:
        meets_NF = meets_NF & (barriers.scene_F == scene_N[:, None])
    particle_P, triangle_P = torch.nonzero(meets_NF, as_tuple=True)
    if is_exporting():
        torch._check(particle_P.shape[0] <= LARGEST_EXPORTED)
    return particle_P, triangle_P


def _covers(row_P24: torch.Tensor, place_P3: torch.Tensor) -> torch.Tensor:
    """Returns whether a triangle covers a point in its plane, bool [P]."""
    inside_P = ((place_P3 >= row_P24[:, 16:19]) & (place_P3 <= row_P24[:, 20:23])).all(-1)
    for plane in (4, 8, 12):
        inside_P = inside_P & ((row_P24[:, plane : plane + 3] * place_P3).sum(-1) <= row_P24[:, plane + 3])
    return inside_P
