"""Triton beyond its documented interface: the versions that are taken, and what this one makes of the kernels."""

import re
from pathlib import Path

import pytest
from kernels.ptx import hazards
from processes import run_compiled

from hgn.kernels.triton_compat import TESTED_VERSIONS, unsupported_reason

CHECKOUT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def lines(warm_python, tmp_path_factory):
    """Of compiled_program.py, by words."""
    text = run_compiled(warm_python, tmp_path_factory.mktemp("triton"), "kernels/compiled_program.py")
    return [line.split() for line in text.splitlines()]


def test_versions_that_were_not_read_are_refused():
    """The installed Triton is taken; older and newer ones, and AMD's GPUs, are named as the reason; the ceiling in
    pyproject.toml is the list's."""
    assert unsupported_reason() is None and unsupported_reason("3.6.0") is None
    assert unsupported_reason("3.10.0") == "Triton must be 3.6 to 3.9 for it, not 3.10.0"
    assert "not 3.5.1" in str(unsupported_reason("3.5.1")) and "NVIDIA" in str(unsupported_reason(hip="6.2"))
    (ceiling,) = re.findall(r'"triton>=3\.(\d+),<3\.(\d+);', (CHECKOUT / "pyproject.toml").read_text())
    assert [f"3.{minor}" for minor in range(int(ceiling[0]), int(ceiling[1]))] == list(TESTED_VERSIONS)


@pytest.mark.slow
def test_the_interface_is_as_it_was(lines):
    """Launches can be noted without being made, compiled by what was noted, and the compilation is told of."""
    assert ["CANARY", "_copy"] in lines


@pytest.mark.slow
def test_what_the_interpreter_forgives(lines):
    """All kernels of grids and relative inputs, of an update, and of a frame with and without walls and obstacles
    compile. The interpreter accepts code that Triton refuses, for example a constant that is defined twice."""
    compiled = [line[1] for line in lines if line[0] == "COMPILED"]
    names = {"sum_motion", "prepare_relative_features", "sum_coarsest", "balance", "balance_backward", "add_coarsest"}
    assert set(compiled) > names and len(compiled) > len(set(compiled)), compiled
    assert compiled.count("integrate") == 4  # free, between obstacles, and between walls, at rest and in motion, too


@pytest.mark.slow
def test_who_starts_early_waits(lines):
    """Every kernel that may start before the end of the previous one waits for this end, and those of a forward pass
    wait before they write. Exceptions are three whose writes no earlier kernel reads: those of the tables, the encoder
    and the decoder."""
    early = [(name, int(waits), int(writes)) for name, waits, writes in (x[1:] for x in lines if x[0] == "EARLY")]
    assert {name for name, *_ in early} >= {"mlp_forward", "gather_project", "particle_cell_forward", "advance"}
    assert all(waits for _, waits, _ in early), early
    writers = {name for name, _, writes in early if writes and not name.endswith("_backward")}
    assert writers == {"prepare_particles", "clear_rows", "sum_coarsest"}, early


@pytest.mark.slow
def test_no_tile_is_copied_over_one_that_is_being_multiplied(lines):
    """Of the weights' products tiles are copied to shared memory ahead, and each product is over before the next copy:
    the compiler keeps too few buffers for one that is under way meanwhile."""
    products = [line[1:] for line in lines if line[0] == "PRODUCT"]
    assert {kernel for kernel, _, _ in products} == {"weight_gradient", "particle_cell_weight_gradient"}
    assert all(int(ahead) >= 2 and int(pending) == 0 for _, ahead, pending in products), products


@pytest.mark.slow
def test_no_group_overwrites_what_another_still_multiplies(lines):
    """Kernels of eight warps have a barrier between a product and the next write to its operands, because the wait for
    products of Triton 3.6 to 3.8 covers only four warps."""
    scanned = [line[1:] for line in lines if line[0] == "HAZARDS"]
    assert {kernel for kernel, _, _ in scanned} >= {
        "weight_gradient",
        "mlp_forward",
        "edge_forward",
        "edge_backward",
        "cell_mlp_backward",
    }
    assert not [line for line in scanned if int(line[-1])], scanned


@pytest.mark.slow
def test_narrow_networks_fit_into_less_shared_memory(lines):
    """Compiled for a GPU with 99 KB of it, as those for graphics have, the kernels of width 64 take no more."""
    shared = {kernel: int(size) for what, kernel, size in (line[:3] for line in lines if line[0] == "SHARED")}
    assert shared.keys() >= {"mlp_forward", "edge_forward", "cell_mlp_forward", "particle_cell_forward"}
    assert max(shared.values()) <= 101_376, shared


@pytest.mark.parametrize(("between", "count"), [("bar.sync 0;", 0), ("add.s32 %r3, %r4, 1;", 1)])
def test_a_missing_barrier_is_seen(between, count):
    """Also behind a branch back, where the write stands before the wait."""
    ptx = f""".reqntid 256
    $L__BB0_1:
    st.shared.b32 [%r1], %r2;
    bar.sync 0;
    wgmma.wait_group.sync.aligned 0;
    {between}
    @%p1 bra $L__BB0_1;
    ret;
    """
    assert len(hazards(ptx)) == count and not hazards(ptx.replace("256", "128"))


@pytest.mark.parametrize(
    ("write", "count"),
    [
        ("st.shared.v4.b32 [%r3+9216], {%r4, %r4, %r4, %r4};", 0),  # above what is read
        ("st.shared.v4.b32 [ %r3 + 9200 ], { %r4, %r4, %r4, %r4 };", 1),
        ("@%p1 cp.async.cg.shared.global [ %r3 + 0 ], [ %rd2 + 0 ], 0x10, 0x10;", 1),
        ("cp.async.bulk.shared::cluster.global [%r3+9216], [%rd2], %r4, [%r5];", 1),  # of a length that is not known
        ("stmatrix.sync.aligned.m8n8.x1.shared.b16 [%r6], {%r4};", 1),  # nor its place
    ],
)
def test_what_is_written_beside_does_no_harm(write, count):
    """Of 4 KB that the threads write together, beside a product's operand in bytes 1,024 to 9,216. What is written
    anywhere counts where a place is not known, the operand's or its own."""
    ptx = f""".reqntid 256
    mov.u32 %r1, %tid.x;
    shl.b32 %r2, %r1, 4;
    mov.b32 %r5, global_smem;
    add.s32 %r3, %r2, %r5;
    add.s32 %r6, %r2, %ctaid.x;
    mov.b64 %rd1, {1 << 62 | 64 << 32 | 64};
    wgmma.mma_async.sync.aligned.m64n64k16.f32.f16.f16 {{%r7}}, {{%r8}}, %rd1, 0, 1, 1, 1;
    wgmma.wait_group.sync.aligned 0;
    {write}
    ret;
    """
    assert len(hazards(ptx)) == count
    assert len(hazards(ptx.replace("mov.b64 %rd1", "ld.global.b64 %rd1"))) == 1
    assert not hazards(ptx.replace(write, f"bar.sync 0;\n{write}"))
