"""Triton's interpreter nearer to a GPU; natively this does nothing."""

from contextlib import contextmanager
from unittest import mock

import numpy as np
import triton


@contextmanager
def dropped_bits():
    """TF32 products drop the operands' last 13 bits, as the matrix units do: by itself the interpreter keeps them."""
    if not triton.knobs.runtime.interpret:
        yield
        return
    from triton._C.libtriton import ir
    from triton.runtime.interpreter import InterpreterBuilder, TensorHandle

    multiply = InterpreterBuilder.create_dot

    def create_dot(builder, a, b, total, input_precision, *rest):
        if input_precision == ir.INPUT_PRECISION.TF32 and a.data.dtype == np.float32:
            a, b = (TensorHandle((x.data.view(np.int32) & -0x2000).view(np.float32), x.dtype) for x in (a, b))
        return multiply(builder, a, b, total, input_precision, *rest)

    with mock.patch.object(InterpreterBuilder, "create_dot", create_dot):
        yield
