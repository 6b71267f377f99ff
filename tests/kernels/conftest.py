"""Sizes of programs for Triton's interpreter, whose time goes by operations and hardly by their size."""

from dataclasses import replace

import pytest
from kernels.engines import device

from hgn.kernels.tuning import Tuning

NATIVE = device().type == "cuda"


def in_large_tiles(tuning):
    return replace(
        tuning, cell_block=16, few_cell_block=16, few_cells=0, row_block=64, small_block=64, pair_particles=8
    )


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    """Of the weights' products: the interpreter takes as long for rows that are not there."""
    if not NATIVE:
        monkeypatch.setattr("hgn.kernels.backward.CHUNK_ROWS", (64, 128))


@pytest.fixture
def large_tiles(monkeypatch):
    """For tests of what is around the kernels; the kernels' own sizes are those of test_network."""
    of = Tuning.of
    if not NATIVE:
        monkeypatch.setattr(Tuning, "of", staticmethod(lambda precision: in_large_tiles(of(precision))))
