"""The kinds of scenes that `scene.kinds` draws from; `hgn.scene.world` makes them."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

from hgn.schema import require

SCENE_KINDS = (
    "obstacles", "motion", "collision", "funnel", "pool", "dam", "column", "drop", "slope", "edge", "stack", "apart",
    "bowl", "channel", "stairs", "jet",
)  # fmt: skip
FREE = ("domain_size", "cell_size", "materials", "particles_per_cell", "kinds")  # settings that no kind draws


def require_kinds(scene: Any) -> None:
    """Checks the kinds of a SceneConfig, and that settings which they draw have defaults. Raises: ConfigError."""
    for kind, share in scene.kinds.items():
        require(kind in SCENE_KINDS, "kinds", f"of {', '.join(SCENE_KINDS)}", kind)
        require(0 <= share < math.inf, f"kinds.{kind}", "a finite share >= 0", share)
    if not scene.kinds:
        return
    require(sum(scene.kinds.values()) > 0, "kinds", "shares of which one is above 0", scene.kinds)
    for item in fields(scene):
        value = getattr(scene, item.name)
        rule = f"its default ({item.default}) where kinds are given"
        require(item.name in FREE or value == item.default, item.name, rule, value, "kinds draw it")
