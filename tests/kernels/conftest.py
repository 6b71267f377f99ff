"""Sizes of programs for Triton's interpreter, whose time goes by operations and hardly by their size."""

from dataclasses import replace

import pytest
import triton.language as tl
from kernels.engines import device

from hgn.kernels.tuning import Tuning

NATIVE = device().type == "cuda"


def use_large_tiles(monkeypatch):
    """For tests of what is around the kernels; a GPU's sizes are those of test_network's first case."""

    def in_large_tiles(tuning):
        return replace(
            tuning, cell_block=64, few_cell_block=64, few_cells=0, row_block=256, small_block=256, pair_particles=8
        )

    of = Tuning.of
    if not NATIVE:
        monkeypatch.setattr(Tuning, "of", staticmethod(lambda precision: in_large_tiles(of(precision))))
        for module in ("grid", "step"):
            monkeypatch.setattr(f"hgn.kernels.{module}.op.PARTICLE_BLOCK", 128)


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    """Of the weights' products: the interpreter takes as long for rows that are not there."""
    if not NATIVE:
        monkeypatch.setattr("hgn.kernels.backward.CHUNK_ROWS", (64, 128))


@pytest.fixture(autouse=True)
def constants_are_numbers(monkeypatch):
    """The interpreter makes a constant of what a constant on a tensor's left yields, and in Triton 3.7 and 3.8 not
    every function takes that. With the constant on the right it is a tensor in all versions."""
    initialise = tl.constexpr.__init__

    def checked(constant, value):
        assert not isinstance(value, tl.tensor), "a constant stands on the left of a tensor"
        initialise(constant, value)

    if not NATIVE:
        monkeypatch.setattr(tl.constexpr, "__init__", checked)


@pytest.fixture
def large_tiles(monkeypatch):
    use_large_tiles(monkeypatch)


@pytest.fixture
def half_fails(monkeypatch):
    """Makes fp16 fail the check of kernels in a module, and `auto` try fp16, then fp32, where another one chooses."""

    def fail(checking, choosing):
        check, scale = checking.require_parity, {"fp16": 0.5}
        halved = lambda x, y, quantity, kind, **named: check(scale.get(kind, 1.0) * x, y, quantity, kind, **named)  # noqa: E731
        monkeypatch.setattr(checking, "require_parity", halved)
        monkeypatch.setattr(f"{choosing}.precisions_to_try", lambda p, *_: ("fp16", "fp32") if p == "auto" else (p,))

    return fail
