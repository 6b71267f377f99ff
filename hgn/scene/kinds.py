"""The kinds of scenes for `scene.kinds`. `hgn.scene.world` makes the scenes."""

import math
from dataclasses import fields
from typing import Any

from hgn.schema import Vector, require

FUNNEL_SQUARES = (0.5, 0.8)  # smallest and largest side of a funnel's squares, relative to the largest obstacle
FUNNEL_HEIGHT = (2.0, 5.0)  # free height below and above a funnel's hole, in group sizes
MAXIMUM_PARTICLES = 16_000  # largest number in a scene; larger scenes are drawn again
MOST_CELLS = 2**31 - 1  # of a domain: the solver numbers them by int32

# Smallest and largest value of each number that a kind draws.
RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "obstacles": {"obstacles": (0, 8), "groups": (1, 6), "size": (0.04, 0.16)},
    "motion": {"obstacles": (0, 6), "groups": (1, 6), "size": (0.04, 0.14), "speed": (0.5, 4.0)},
    "collision": {"groups": (2, 6), "size": (0.05, 0.14), "speed": (0.5, 5.0)},
    "funnel": {"groups": (1, 5), "size": (0.06, 0.13), "hole": (0.035, 0.2)},
    "pool": {"depth": (0.03, 0.16), "tilt": (0.0, 0.42), "size": (0.04, 0.09), "height": (0.02, 0.2)},
    "dam": {"length": (0.06, 0.3), "height": (0.08, 0.35), "wet": (0.02, 0.05)},
    "column": {"width": (0.06, 0.18), "depth": (0.06, 0.18), "height": (0.05, 0.4)},
    "drop": {"size": (0.04, 0.25), "height": (0.0, 0.8), "speed": (0.0, 5.0)},
    "slope": {"plate": (0.45, 0.75), "tilt": (0.03, 0.36), "size": (0.05, 0.12)},
    "edge": {
        "plate": (0.2, 0.45), "height": (0.1, 0.35), "beyond": (-0.04, 0.06), "size": (0.05, 0.12),
        "drop": (0.016, 0.2),
    },
    "stack": {"bodies": (2, 4), "size": (0.06, 0.12), "shift": (-0.03, 0.03)},
    "apart": {"bodies": (2, 4), "size": (0.05, 0.12), "speed": (0.01, 2.0), "tilt": (0.0, 0.1)},
    "bowl": {"bowl": (0.25, 0.5), "size": (0.06, 0.14), "height": (0.05, 0.4)},
    "channel": {"width": (0.16, 0.36), "plate": (0.3, 0.5), "length": (0.08, 0.2), "height": (0.1, 0.3)},
    "stairs": {"steps": (3, 4), "plate": (0.2, 0.3), "rise": (0.06, 0.11), "size": (0.08, 0.14)},
    "jet": {"length": (0.08, 0.3), "width": (0.05, 0.12), "speed": (1.5, 6.0)},
}  # fmt: skip
SCENE_KINDS = tuple(RANGES)
# Kinds with a moving obstacle. With `moving` in scene.own_physics a fraction of the scenes is of one of them.
MOVING_FRACTION = 1 / 6
FASTEST = 1.0  # largest speed of their obstacles, domain units per second
MOVING_RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "paddle": {"gap": (0.02, 0.1), "depth": (0.03, 0.12), "length": (0.2, 0.7), "speed": (0.1, FASTEST)},
    "piston": {"size": (0.08, 0.2), "gap": (0.01, 0.1), "way": (0.2, 0.9), "speed": (0.05, FASTEST)},
    "conveyor": {"size": (0.06, 0.12), "plate": (0.35, 0.6), "height": (0.06, 0.2), "speed": (0.1, FASTEST)},
    "falling": {"size": (0.08, 0.2), "height": (0.1, 0.4), "speed": (0.3, FASTEST)},
}
# Kinds of scenes with elastic bodies. The others are for material that flows: pools, columns, funnels and paddles.
ELASTIC_KINDS = (
    "obstacles", "motion", "collision", "drop", "slope", "edge", "stack", "apart", "bowl", "stairs", "jet",
    "piston", "conveyor", "falling",
)  # fmt: skip
FREE = (
    "domain_size",
    "cell_size",
    "materials",
    "particles_per_cell",
    "kinds",
    "own_physics",
)  # settings that kinds do not draw


def fastest(scene: Any) -> float:
    """Returns the largest initial speed that a SceneConfig draws, in domain units per second."""
    drawn = (RANGES[kind].get("speed", (0.0, 0.0))[1] for kind, share in scene.kinds.items() if share > 0)
    return max((scene.maximum_initial_speed, *drawn))


def require_kinds(scene: Any) -> None:
    """Checks the kinds of a SceneConfig, and that the settings which kinds draw are defaults. Raises: ConfigError."""
    for kind, share in scene.kinds.items():
        require(kind in SCENE_KINDS, "kinds", f"among {', '.join(SCENE_KINDS)}", kind)
        require(0 <= share < math.inf, f"kinds.{kind}", "a finite number >= 0", share)
    if not scene.kinds:
        return
    require(sum(scene.kinds.values()) > 0, "kinds", "numbers with at least one above 0", scene.kinds)
    for item in fields(scene):
        value = getattr(scene, item.name)
        rule = f"its default ({item.default}) if kinds are given"
        require(item.name in FREE or value == item.default, item.name, rule, value, "kinds draw it")


def require_funnel(scene: Any) -> None:
    """Checks that funnels of a SceneConfig fit into its domain. Raises: ConfigError."""
    if scene.funnel_scene_fraction > 0:
        remedy, where = "or set funnel_scene_fraction=0", "if funnel_scene_fraction is above 0"
        require(scene.obstacle_count >= 4, "obstacle_count", f"at least 4 {where}", scene.obstacle_count, remedy)
        widest, height = FUNNEL_SQUARES[0] * scene.obstacle_size[1], min(scene.domain_size) / sum(FUNNEL_HEIGHT)
        rule = f"at most {FUNNEL_SQUARES[0]:g} of the largest obstacle_size ({widest:g}) {where}"
        require(scene.funnel_hole[1] <= widest, "funnel_hole", rule, list(scene.funnel_hole), remedy)
        rule = f"at most {1 / sum(FUNNEL_HEIGHT):.3g} of the domain's smallest side ({height:.3g}) {where}"
        require(scene.group_size <= height, "group_size", rule, scene.group_size, remedy)


def require_few_cells(domain_size: Vector, cell_size: float) -> None:
    """Raises ConfigError for a domain of more cells than the solver can number."""
    few = math.prod(length / cell_size for length in domain_size) <= MOST_CELLS
    rule, remedy = f"at most {MOST_CELLS} cells of {cell_size:.6g}", "lower it or raise cell_size"
    require(few, "domain_size", rule, list(domain_size), remedy)
