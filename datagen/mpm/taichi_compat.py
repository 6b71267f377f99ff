"""Removes repeated and useless work of Taichi before a kernel runs; pyproject.toml fixes its version.

`tests/datagen/mpm/test_device.py` fails if a new version has changed this work.
"""

import ast
import functools
from typing import Any

from taichi.lang import _ndarray, kernel_impl, matrix
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext


def remove_useless_work() -> None:
    """Makes translation faster, and allocation of arrays, in this process.

    Faults in kernels name file, line and function, without a drawing of the line: Taichi draws it for each expression
    that it translates, which takes half of the time. Functions are read from their files once, not for each call that
    is translated. An array does not keep the stack of the calls that allocated it.
    """
    ASTTransformerContext.get_pos_info = _position
    kernel_impl.getsourcelines = functools.cache(kernel_impl.getsourcelines)
    _ndarray.get_traceback = matrix.get_traceback = _no_stack


def _position(context: Any, node: ast.stmt | ast.expr) -> str:
    return f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {context.func.func.__name__}:\n'


def _no_stack(stacklevel: int = 1) -> str:
    return ""
