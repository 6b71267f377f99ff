"""How Sphinx builds the site: `make docs`, warnings as errors, every reference checked."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

project = "HGN"
author = "the HGN maintainers"
copyright = "the HGN maintainers, MIT licence"

extensions = ["myst_parser", "sphinx.ext.autodoc", "reference_pages"]
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
# types of other packages, whose documentation is not read while this one is built
nitpick_ignore_regex = [(r"py:.*", r"(np|numpy|torch|Path|pathlib|collections|Iterator|Sequence|Callable)(\..*)?")]
autodoc_member_order = "bysource"
autodoc_typehints = "none"
