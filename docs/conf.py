"""How Sphinx builds the site: `make docs`, warnings as errors, every reference checked."""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

project = "HGN"
author = "the HGN maintainers"
copyright = "the HGN maintainers, MIT licence"

extensions = ["myst_parser", "sphinx.ext.autodoc", "reference_pages", "repository_pages"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build", "_generated", "_ext"]
suppress_warnings = ["epub.unknown_project_files"]

myst_enable_extensions = ["colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = "HGN"
html_css_files = ["custom.css"]
html_static_path = ["_static"]
html_show_sourcelink = False

nitpicky = True
# types of other packages, whose documentation is not read while this one is built, and how autodoc names parts of types
nitpick_ignore_regex = [(r"py:.*", r"(np|numpy|torch|pathlib|collections|dict\[|tuple\[).*")]
# settings have a page of their own; the others are for those who read the code
_INTERNAL = (
    "config.NetworkConfig",
    "config.SceneConfig",
    "network.base.ParticleNetwork",
    "network.features.ParticleState",
)
_INTERNAL += (
    "step_config.StepConfig",
    "runtime.torch_backend.Backend",
    "scene.mesh.Surfaces",
    "scene.moving.MovingObstacle",
    "scene.obstacle_grid.ObstacleGrid",
    "scene.episode.Episode",
)
nitpick_ignore = [("py:class", f"hgn.{name}") for name in _INTERNAL]
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
# three floats, with a bound that only settings need
autodoc_type_aliases = {"Vector": "Vector"}
nitpick_ignore.append(("py:class", "Vector"))
autodoc_typehints_format = "short"
