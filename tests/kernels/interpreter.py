"""Triton's interpreter nearer to a GPU, and faster; natively this does nothing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np
import triton


@contextmanager
def interpreting() -> Iterator[None]:
    """TF32 products drop the operands' last 13 bits, as the matrix units do: by itself the interpreter keeps them.

    And what a kernel calls does not prepare Triton's language anew in each call: a third of the interpreter's time.
    """
    if not triton.knobs.runtime.interpret:
        yield
        return
    from triton._C.libtriton import ir
    from triton.runtime.interpreter import InterpretedFunction, InterpreterBuilder, TensorHandle

    multiply, launch, call = InterpreterBuilder.create_dot, InterpretedFunction.run, InterpretedFunction.__call__
    prepared: set[str] = set()  # modules, since the launch began

    def create_dot(builder: Any, a: Any, b: Any, total: Any, input_precision: Any, *rest: Any) -> Any:
        if input_precision == ir.INPUT_PRECISION.TF32 and a.data.dtype == np.float32:
            a, b = (TensorHandle((x.data.view(np.int32) & -0x2000).view(np.float32), x.dtype) for x in (a, b))
        return multiply(builder, a, b, total, input_precision, *rest)

    def run(function: Any, *values: Any, **named: Any) -> Any:
        prepared.clear()
        return launch(function, *values, **named)

    def once(function: Any, *values: Any, **named: Any) -> Any:
        module = function.fn.__module__
        if module in prepared:
            return function.rewrite()(*values, **named)
        prepared.add(module)
        return call(function, *values, **named)

    with (
        mock.patch.object(InterpreterBuilder, "create_dot", create_dot),
        mock.patch.object(InterpretedFunction, "run", run),
        mock.patch.object(InterpretedFunction, "__call__", once),
    ):
        yield
