"""Removes repeated and useless work of Taichi during the translation of a kernel; pyproject.toml fixes its version.

`tests/datagen/mpm/test_device.py` fails if a new version has changed this work.
"""

from __future__ import annotations

import ast
from typing import Any

from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext


def name_lines_alone() -> None:
    """Makes faults in kernels name file, line and function, without a drawing of the line, in this process.

    Taichi draws it for each expression that it translates, which takes half of the time that the translation takes.
    """
    ASTTransformerContext.get_pos_info = _position


def _position(context: Any, node: ast.stmt | ast.expr) -> str:
    return f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {context.func.func.__name__}:\n'
