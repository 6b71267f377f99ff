"""Floats at an address: Taichi's kernels read and write what numpy sees."""

from pathlib import Path

import llvmlite.binding as llvm
import numpy as np
import taichi as ti

from datagen.mpm import device_memory
from datagen.mpm.device_memory import add, address, load, load4, store, store4


@ti.kernel
def _exercise(memory: ti.u64, out: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    for n in range(4):
        begin = memory
        four = load4(begin, 8 * n)
        store4(begin, 8 * n + 4, four[3], four[2], four[1], four[0])
        store(begin, 8 * n, load(begin, 8 * n + 1) + 0.5)
        for _ in range(3):
            add(begin, 32, 2.0)
        out[n] = four[0]


def test_reads_writes_and_sums_are_those_of_the_array():
    """Four at once as one by one, at the entries that are named; sums of several threads are whole."""
    values = np.arange(36, dtype=np.float32)
    array, out = ti.ndarray(ti.f32, 36), ti.ndarray(ti.f32, 4)
    array.from_numpy(values)
    _exercise(address(array), out)
    expected = values.copy()
    for n in range(0, 32, 8):
        expected[n + 4 : n + 8] = values[n : n + 4][::-1]
        expected[n] = values[n + 1] + 0.5
    expected[32] += 24
    assert np.array_equal(array.to_numpy(), expected) and np.array_equal(out.to_numpy(), values[:32:8])


def test_the_bitcode_is_that_of_the_source():
    """LLVM 14 assembles device_memory.ll into device_memory.bc, byte by byte."""
    source = Path(device_memory.__file__).with_suffix(".ll")
    llvm.initialize()
    module = llvm.parse_assembly(source.read_text())
    module.verify()
    assert module.as_bitcode() == source.with_suffix(".bc").read_bytes()
