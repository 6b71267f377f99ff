"""Floats at an address, as teams read and write them (test_team)."""

from pathlib import Path

import llvmlite.binding as llvm

from datagen.mpm import device_memory


def test_the_bitcode_is_that_of_the_source():
    """LLVM 14 assembles device_memory.ll into device_memory.bc, byte by byte."""
    source = Path(device_memory.__file__).with_suffix(".ll")
    llvm.initialize()
    module = llvm.parse_assembly(source.read_text())
    module.verify()
    assert module.as_bitcode() == source.with_suffix(".bc").read_bytes()
