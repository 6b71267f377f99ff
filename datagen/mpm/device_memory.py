"""Floats in a device's memory at an address, which Taichi's kernels take as a number (see device_memory.ll).

The team's kernel alone needs it, so GPUs, and CPUs in tests. Taichi reads the bitcode of LLVM 14 beside this file as it
compiles; after a change of the source `llvmlite.binding.parse_assembly(source).as_bitcode()` of llvmlite 0.43 makes it.
`base` is a variable of the kernel that holds the address: copies of it cost a third of the time to compile.
"""

from pathlib import Path

import taichi as ti
from taichi.lang.source_builder import SourceBuilder

ALIGNMENT = 16  # bytes, of an address that four floats are read from
# as SourceBuilder.from_file, which asks for a device that is started
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
    """An atomic sum, whose result nobody waits for."""
    _functions.memory_add(base, entry, value)


@ti.func
def load4(base: ti.template(), entry: ti.i32):
    """Four floats from an entry that four divides."""
    x = 0.0
    y = 0.0
    z = 0.0
    w = 0.0
    _functions.memory_load4(base, entry, x, y, z, w)
    return ti.Vector([x, y, z, w])


@ti.func
def store4(base: ti.template(), entry: ti.i32, x: ti.f32, y: ti.f32, z: ti.f32, w: ti.f32):
    _functions.memory_store4(base, entry, x, y, z, w)
