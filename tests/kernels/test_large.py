"""python -m tools.studies.large: many blocks of particles move like one alone; tensors of more than 2^31 elements."""

from typing import Any

import pytest
import torch
import triton
import triton.language as tl

from hgn.kernels import forward
from hgn.kernels.blocks import elements
from hgn.schema import ConfigError
from tools.studies.large import main

SMALL: dict[str, Any] = {
    "particles": 24,
    "block": 6,
    "precision": "fp32",
    "network": {"width": 16, "levels": 2, "message_passing_steps": 2},
}


@pytest.mark.usefixtures("large_tiles")
@pytest.mark.skipif(torch.cuda.is_available(), reason="the interpreter, which takes tensors of the CPU, is off here")
@pytest.mark.parametrize("addressed", [2**31, 4000])
def test_blocks_are_alike(addressed, monkeypatch):
    """The check passes; also where edges are addressed in 64 bits, as with 10 million particles."""
    monkeypatch.setattr(forward, "ADDRESSED", addressed)
    assert main(SMALL) == 0


def test_too_many_are_refused(monkeypatch):
    """What int32 cannot address is refused by name and number, before anything is computed."""
    monkeypatch.setattr(forward, "ADDRESSED", 16 * 24)
    with pytest.raises(ConfigError, match=r"cells of a simulation .* at most 23, got 48; take fewer at once"):
        main(SMALL)


@triton.jit
def _write(into, row_at, WIDTH: tl.constexpr, WIDE: tl.constexpr):
    tl.store(into + elements(tl.load(row_at + tl.arange(0, 2)), WIDTH, WIDE), 1.0)


@pytest.mark.skipif(torch.cuda.is_available(), reason="the interpreter, which takes tensors of the CPU, is off here")
def test_rows_beyond_int32():
    """Rows whose elements int32 cannot count are written where they are; nothing else of the tensor is touched."""
    rows, width = 2**31 // 16 + 2, 16
    into = torch.empty(rows, width, dtype=torch.int8)  # pages that nobody touches take no memory
    _write[(1,)](into, torch.tensor([3, rows - 1], dtype=torch.int32), WIDTH=width, WIDE=True)
    assert bool((into[[3, rows - 1]] == 1).all())
