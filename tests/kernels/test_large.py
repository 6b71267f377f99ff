"""Scenes beyond int32, tensors of more than 2^31 elements, and room and sums of a simulation's start."""

import math
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
import triton
import triton.language as tl

from hgn.config import NetworkConfig
from hgn.kernels import forward
from hgn.kernels.blocks import elements
from hgn.network.features import ParticleState
from hgn.runtime.parity import ParityError, relative_error
from hgn.runtime.triton_backend import TritonBackend
from hgn.runtime.triton_stepper import TritonStepper, first_capacities
from hgn.schema import ConfigError
from tools.bench.contenders import BOUNDS, bench_network
from tools.bench.states import Workload, state_of

CPU = torch.device("cpu")
NETWORK = NetworkConfig(width=16, levels=2, message_passing_steps=2)
BLOCK, BLOCKS = 6, 4  # particles, and copies of them
GAP_CELLS = 4  # of the coarsest level between two blocks, and around all
interpreted = pytest.mark.skipif(
    torch.cuda.is_available(), reason="the interpreter, which takes tensors of the CPU, is off here"
)


def states():
    """One block alone, and copies of it that are whole coarse cells apart and do not interact."""
    block = state_of(Workload(BLOCK, 1), NETWORK, CPU)
    coarsest = NETWORK.cell_size * 2 ** (NETWORK.levels - 1)
    gap = GAP_CELLS * coarsest
    pitch = coarsest * math.ceil((float(block.domain_S3[0, 0]) + gap) / coarsest)
    place_B3 = torch.cartesian_prod(*[torch.arange(2)] * 3)[:BLOCKS]
    position_N3 = block.position_N3 + gap
    everywhere_N3 = (position_N3[None] + (pitch * place_B3.double()).float()[:, None]).view(-1, 3)
    one_S3, all_S3 = (torch.full_like(block.domain_S3, blocks * pitch + gap) for blocks in (1, 2))
    scene = ParticleState(
        everywhere_N3, block.velocity_NM3.repeat(BLOCKS, 1, 1), block.material_N.repeat(BLOCKS),
        block.scene_N.repeat(BLOCKS), all_S3, block.gravity_S3, None,
    )  # fmt: skip
    return replace(block, position_N3=position_N3, domain_S3=one_S3), scene


@interpreted
@pytest.mark.usefixtures("large_tiles")
def test_blocks_are_alike(monkeypatch):
    """Each block gets the accelerations of a single one, with the 64-bit addresses that 10 million particles need."""
    monkeypatch.setattr(forward, "ADDRESSED", 4000)
    network, (block, scene) = bench_network(NETWORK, CPU), states()
    rollout = TritonStepper(network, scene, "fp32")
    rollout._network_pass()
    with torch.no_grad():
        expected_N3 = network.normalised_acceleration(block)
    for found_N3 in rollout.fused.output[:, :3].view(-1, BLOCK, 3)[:BLOCKS]:
        assert relative_error(found_N3, expected_N3) < BOUNDS["fp32"]


@pytest.mark.parametrize(("scene", "message"), [(0, "cells .* at most 23, got 48"), (1, "particles .* 23, got 24")])
def test_too_many_are_refused(scene, message, monkeypatch):
    """A scene with more cells or particles than int32 can address is refused before anything is computed."""
    monkeypatch.setattr(forward, "ADDRESSED", 16 * 24)
    with pytest.raises(ConfigError, match=message + "; use fewer together"):
        TritonStepper(bench_network(NETWORK, CPU), states()[scene], "fp32")


def test_first_room():
    """The first buffers have capacity for falling groups that spread, at most for the cells that their particles can
    fill. With many cells the capacity is twice their number. With even more, where memory is limited, it is 1.25
    times."""
    assert first_capacities((246, 53, 18, 5), 2_763) == (1_657, 276, 96, 40)
    assert first_capacities((1_398, 214, 56, 8), 4_296)[:2] == (2_796, 429)
    assert first_capacities((128_529, 23_263, 4_373, 612), 400_000) == (160_661, 32_768, 8_192, 1_224)
    assert first_capacities((65_536, 16_385), 400_000) == (131_072, 32_768)
    assert first_capacities((8,) * 5, 1) == (256, 128, 64, 32, 16)


def let_half_sums_fail(monkeypatch, float_fails=False):
    """Replaces the check of steppers. Returns the list of what it will have checked: whether sums are in float16."""
    checked = []

    def check(stepper, *_):
        checked.append(stepper.half_sums)
        if stepper.half_sums or float_fails:
            raise ParityError("precision must be tf32")

    monkeypatch.setattr(TritonStepper, "_require_parity", check)
    return checked


@pytest.mark.parametrize("fails", [False, True])
def test_sums_are_in_float32_where_half_fails(monkeypatch, fails):
    """Where float16 sums alone fail the check of fp16, the backend takes float32 sums; where these fail too, it refuses
    the state."""
    checked = let_half_sums_fail(monkeypatch, fails)
    backend = TritonBackend(bench_network(NETWORK, CPU), "fp16")
    for state in states():
        with pytest.raises(ParityError) if fails else nullcontext(), backend.stepper(state):
            pass
    assert checked == [True, False] * 2 and backend.precision == "fp16"


@triton.jit
def _write(into, row_at, WIDTH: tl.constexpr, WIDE: tl.constexpr):
    tl.store(into + elements(tl.load(row_at + tl.arange(0, 2)), WIDTH, WIDE), 1.0)


@interpreted
def test_rows_beyond_int32():
    """Rows whose elements int32 cannot count are written at the right address."""
    rows, width = 2**31 // 16 + 2, 16
    into = torch.empty(rows, width, dtype=torch.int8)  # untouched pages take no memory
    _write[(1,)](into, torch.tensor([3, rows - 1], dtype=torch.int32), WIDTH=width, WIDE=True)
    assert bool((into[[3, rows - 1]] == 1).all())
