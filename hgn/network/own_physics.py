"""Friction of surfaces, parameters and elastic bodies as inputs of a network with relative inputs.

`network.own_physics` names them. They are the last columns of the encoder, and 0 without friction and for the solver's
default parameters. If all are 0, they are not computed; the result is the same. See docs/concepts/method.md.

| columns | value | only with |
|---|---|---|
| 2 | friction of the obstacle cell with the particle, and of the first one on its path | friction, obstacle_features |
| 3 | for each axis: common friction of the two walls normal to it, times nearness of the nearer wall | friction |
| 1 for each of INPUT_PARAMETERS | `scaled_parameters`, 0 for parameters of other materials | parameters |
| 9 | deformation of elastic bodies (hgn.network.elastic) | elastic |

A cell's matrix P (`relative.contact_normals`) is the sum of a_s n_s n_s^T over surfaces s with normals n_s and weights
a_s. With Q = (1 + P / e)^-1, e = FEW + RARE tr P, surfaces without friction remove T = Q R from the mean acceleration R
(`relative.balanced`). R - T = P y with y = T / e, so surface s pushes with a_s (n_s . y) n_s. Friction mu_s keeps k T:

    k = min(1, |B| / |T|, b),    B = sum_s mu_s a_s (n_s . y) n_s

b is the largest number for which f = b c Q T, with c = d_C t_C, satisfies f . (Q u + f) <= D / 4. u is the velocity
along surfaces after a frame without friction, Q (v + g + d_C A_C), and D the variance of v in the cell, in units of
s_a. Reason: friction changes the velocity of each particle by -l u_p, 0 <= l <= 1, so by a vector in the ball around
-u_p / 2 with the radius |u_p| / 2. So the mean change f satisfies |f + u / 2|^2 <= (|u|^2 + D) / 4, which is the rule.
With `moving` v is the velocity relative to the surfaces, v - V of hgn.network.moving. It adds no columns.
Shape legend: N particles, C coarsest cells, S scenes, P parameters (in names of tensors only), K columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch.nn.functional import pad

from hgn.config import NetworkConfig
from hgn.network import elastic
from hgn.network.features import ParticleState
from hgn.network.grid import GridHierarchy
from hgn.network.obstacles import first_surface
from hgn.scene.material import INPUT_PARAMETERS, LOGARITHMIC, acts_on
from hgn.scene.own_physics import NOMINAL_P

TINY = 1e-30  # lower bound of squares and divisors; avoids a division by zero
# With local inputs `wall_contact` is 0 up to the first nearness, 1.8 R (0.063) from the plane, and 1 from the second,
# 1.5 R (0.0525). The solver's walls act on particles up to about 4 cells of 1/64 (0.0625) from the plane.
FREE_NEARNESS, FULL_NEARNESS = 0.4, 0.5
VISCOSITY_PA_S = 1.0  # unit of the viscosity input log(1 + viscosity / unit)


@dataclass(frozen=True, eq=False)
class SurfaceFriction:
    """The friction of surfaces within reach: columns of the encoder, and sums over coarsest cells."""

    column_NK: torch.Tensor
    obstacle_C33: torch.Tensor  # sum of w_pC mu n n^T over obstacles
    wall_C6: torch.Tensor  # sum of w_pC mu min(1, 2 nearness) for each wall: lower x, y, z, then upper
    velocity_C3: torch.Tensor  # mean of v - V + g in units of s_a
    variance_C: torch.Tensor  # mean square of the differences of v - V from its mean, in these units


def physics_widths(config: NetworkConfig) -> tuple[int, int, int]:
    """Returns the numbers of columns for friction, for parameters and for elastic bodies."""
    widths = {"friction": 3 + 2 * config.obstacle_features, "parameters": len(INPUT_PARAMETERS)}
    widths["elastic"] = elastic.COLUMNS
    friction, parameters, deformation = (n * (name in config.own_physics) for name, n in widths.items())
    return friction, parameters, deformation


def physics_columns(
    state: ParticleState, config: NetworkConfig, friction: SurfaceFriction | None, scale: torch.Tensor
) -> list[torch.Tensor]:
    """Returns the columns in a list: one tensor [N, K], or no tensor if all columns are 0. `scale` is s_a."""
    parameter_NP = state.parameter_NP if "parameters" in config.own_physics else None
    deformation_NK = None
    if state.rest is not None and "elastic" in config.own_physics:
        deformation_NK = elastic.elastic_columns(state.position_N3, state.rest, scale)
    parts = (None if friction is None else friction.column_NK, parameter_NP, deformation_NK)
    zero_N1 = torch.zeros_like(state.position_N3[:, :1])
    whole = (zero_N1.expand(-1, n) if p is None else p for p, n in zip(parts, physics_widths(config), strict=True))
    return [torch.cat([*whole], -1)] if any(part is not None for part in parts) else []


def scaled_parameters(value_NP: torch.Tensor, material_N: torch.Tensor, materials: Sequence[str]) -> torch.Tensor:
    """Returns the columns of parameters in their units: log(p / default) for LOGARITHMIC, p / default - 1 for others.

    Viscosity, which is 0 by default, is log(1 + p / VISCOSITY_PA_S). Parameters of other materials are 0.
    """
    columns = []
    for value_N, name, nominal in zip(value_NP.unbind(-1), INPUT_PARAMETERS, NOMINAL_P, strict=True):
        change_N = (value_N - nominal) / (nominal or VISCOSITY_PA_S)  # exactly 0 for the default
        columns.append(torch.log1p(change_N) if name in LOGARITHMIC else change_N)
    acts_MP = torch.tensor([[acts_on(name, material) for name in INPUT_PARAMETERS] for material in materials])
    return torch.stack(columns, -1) * acts_MP.to(value_NP)[material_N]


def joined_parameters(parameters: Sequence[torch.Tensor | None], positions: Sequence[torch.Tensor]) -> torch.Tensor:
    """Returns the columns of several states or episodes one after another, 0 for those with the defaults (None)."""
    pairs = zip(parameters, positions, strict=True)
    return torch.cat([x.new_zeros(len(x), len(INPUT_PARAMETERS)) if own is None else own for own, x in pairs])


def physics_fields(config: NetworkConfig, scenes: Sequence[Any], material_N: torch.Tensor) -> dict[str, Any]:
    """Returns the fields of a ParticleState for episodes or initial states. Fields that would be 0 are left out."""
    fields: dict[str, Any] = {}
    frictions = [scene.wall_friction for scene in scenes]
    if "friction" in config.own_physics and any(map(any, frictions)):
        fields["wall_friction_S3"] = torch.tensor(frictions, dtype=torch.float32)
    own = [scene.parameters for scene in scenes] if "parameters" in config.own_physics else []
    if any(value_NP is not None for value_NP in own):
        default_1P, counts = np.array([NOMINAL_P], np.float32), (len(scene.material_N) for scene in scenes)
        whole = [default_1P.repeat(n, 0) if value is None else value for value, n in zip(own, counts, strict=True)]
        column_NP = scaled_parameters(torch.from_numpy(np.concatenate(whole)), material_N, config.materials)
        fields |= {"parameter_NP": column_NP} if bool(column_NP.any()) else {}
    rest = elastic.rest_shape(scenes) if "elastic" in config.own_physics else None
    return fields if rest is None else fields | {"rest": rest}


def wall_contact(wall_N6: torch.Tensor, local: bool) -> torch.Tensor:
    """Returns from `relative.wall_nearness` how much walls can push particles, 0 to 1, [N, 6].

    A network sees walls before they can push. With `local` inputs only walls that can push constrain a body, so a
    ceiling does not stop bodies that slide down a slope below it. Otherwise all visible walls can push.
    """
    first = FREE_NEARNESS if local else 0.0
    return ((wall_N6 - first) / (FULL_NEARNESS - first)).clamp(0, 1)


def has_friction(state: ParticleState) -> bool:
    """Returns whether any surface of a state has friction."""
    cells = (state.obstacles, state.moving and state.moving.cells)
    return state.wall_friction_S3 is not None or any(own and own.friction_K is not None for own in cells)


def surface_friction(
    state: ParticleState,
    grid: GridHierarchy,
    wall_N6: torch.Tensor,
    cell_N8: torch.Tensor | None,
    *,
    velocity_N3: torch.Tensor,
    scale: torch.Tensor,
    local: bool,
) -> SurfaceFriction:
    """Returns the friction within reach, from `relative.wall_nearness`, `relative.obstacle_surfaces`, v - V and s_a.

    `local`: whether inputs are local.
    """
    wall_N3 = torch.zeros_like(state.position_N3)
    if state.wall_friction_S3 is not None:
        wall_N3 = state.wall_friction_S3[state.scene_N]
    columns, rough_N33 = [], wall_N6.new_zeros(wall_N6.shape[0], 3, 3)
    if cell_N8 is not None:
        here_N4, ahead_N4 = (pad(surface, (0, 4 - surface.shape[1])) for surface in cell_N8.chunk(2, dim=1))
        first_N4 = first_surface([here_N4, ahead_N4])
        rough_N33 = first_N4[:, 3, None, None] * first_N4[:, :3, None] * first_N4[:, None, :3]
        columns = [here_N4[:, 3:], ahead_N4[:, 3:]]
    columns.append(torch.maximum(wall_N6[:, :3], wall_N6[:, 3:]) * wall_N3)
    near_N6 = wall_contact(wall_N6, local) * torch.cat([wall_N3, wall_N3], -1)
    next_N3 = (velocity_N3 + state.gravity_S3[state.scene_N]) / scale
    square_N1 = next_N3.square().sum(-1, keepdim=True)
    value_NK = torch.cat([rough_N33.flatten(1), near_N6, next_N3, square_N1, torch.ones_like(square_N1)], dim=-1)
    sum_CK = grid.coarsest.sums(value_NK)
    mean_C4 = sum_CK[:, 15:19] / sum_CK[:, 19:].clamp(min=TINY)
    variance_C = (mean_C4[:, 3] - mean_C4[:, :3].square().sum(-1)).clamp(min=0)
    obstacle_C33, wall_C6 = sum_CK[:, :9].unflatten(1, (3, 3)), sum_CK[:, 9:15]
    return SurfaceFriction(torch.cat(columns, -1), obstacle_C33, wall_C6, mean_C4[:, :3], variance_C)


def friction_fraction(
    friction: SurfaceFriction,
    force_C3: torch.Tensor,
    push_C3: torch.Tensor,
    free_C3: torch.Tensor,
    slip_C33: torch.Tensor,
) -> torch.Tensor:
    """Returns k [C], the fraction of T that friction leaves. Arguments, in the module's symbols: c T, c y, u and Q."""
    lower_C3, upper_C3 = friction.wall_C6[:, :3], friction.wall_C6[:, 3:]
    bound_C3 = lower_C3 * push_C3.clamp(min=0) + upper_C3 * push_C3.clamp(max=0)
    bound_C3 = bound_C3 + (friction.obstacle_C33 @ push_C3[..., None]).squeeze(-1)
    limit_C, length_C = _length(bound_C3), _length(force_C3)
    cone_C = limit_C / torch.maximum(limit_C, length_C).clamp(min=TINY)
    # b solves square b^2 + slope b = variance / 4; the two forms of the solution avoid cancellation
    force_C3, free_C3 = ((slip_C33 @ vector_C3[..., None]).squeeze(-1) for vector_C3 in (force_C3, free_C3))
    square_C, slope_C = force_C3.square().sum(-1), (force_C3 * free_C3).sum(-1)
    root_C = (slope_C.square() + square_C * friction.variance_C).clamp(min=TINY).sqrt()
    slowed_C = 0.5 * (root_C - slope_C) / square_C.clamp(min=TINY)
    turned_C = 0.5 * friction.variance_C / torch.where(slope_C > 0, root_C + slope_C, 1)
    return torch.minimum(cone_C, torch.where(slope_C > 0, turned_C, slowed_C))


def _length(vector_C3: torch.Tensor) -> torch.Tensor:
    """Returns lengths [C]. The gradient at 0 is 0."""
    square_C = vector_C3.square().sum(-1)
    return torch.where(square_C > 0, square_C.clamp(min=TINY).sqrt(), 0)
