"""Floats in a device's memory at an address, which Taichi's kernels take as a number (see device_memory.ll).

Only the team's kernel needs it, on GPUs, and on CPUs in tests. During compilation Taichi reads the bitcode of LLVM 14
beside this file. After a change of the source, `llvmlite.binding.parse_assembly(source).as_bitcode()` of llvmlite 0.43
creates it. `base` is a kernel variable that contains the address. Copies of it would take a third of the compile time.
"""

from pathlib import Path

import taichi as ti
from taichi.lang.source_builder import SourceBuilder

ALIGNMENT = 16  # bytes; an address from which four floats are read is a multiple of it
# like SourceBuilder.from_file, which requires a started device
_functions = SourceBuilder()
_functions.bc, _functions.mode = str(Path(__file__).with_suffix(".bc")), "bc"


def address(array: ti.ScalarNdarray) -> int:
    """Returns the address of an array of floats."""
    begin: int = ti.lang.impl.get_runtime().prog.get_ndarray_data_ptr_as_int(array.arr)
    assert begin % ALIGNMENT == 0
    return begin


@ti.func
def load(base: ti.template(), entry: ti.i32):
    value = 0.0
    _functions.memory_load(base, entry, value)
    return value


@ti.func
def store(base: ti.template(), entry: ti.i32, value: ti.f32):
    _functions.memory_store(base, entry, value)


@ti.func
def add(base: ti.template(), entry: ti.i32, value: ti.f32):
    """Adds atomically. No thread waits for the result."""
    _functions.memory_add(base, entry, value)


@ti.func
def load4(base: ti.template(), entry: ti.i32):
    """Returns four floats at an entry that is a multiple of four."""
    x = 0.0
    y = 0.0
    z = 0.0
    w = 0.0
    _functions.memory_load4(base, entry, x, y, z, w)
    return ti.Vector([x, y, z, w])


@ti.func
def store4(base: ti.template(), entry: ti.i32, x: ti.f32, y: ti.f32, z: ti.f32, w: ti.f32):
    _functions.memory_store4(base, entry, x, y, z, w)
