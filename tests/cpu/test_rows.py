"""Rows through an MLP in PyTorch and compiled, against the MLP itself in float64."""

import itertools
import subprocess

import pytest
import torch

from hgn.cpu import compiled
from hgn.cpu.compiled import CompiledRows, compiled_rows, describe, rows_class, unsupported_reason
from hgn.cpu.rows import Hidden, Rows, Segments
from hgn.network.mlp import MLP

NO_COMPILER = compiled.unsupported_reason(16, torch.float32)
KINDS = [Rows, pytest.param(CompiledRows, marks=pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER)))]
TABLE = 50


def assert_close(found, expected):
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=2e-5)


def fcn_of(width):
    torch.manual_seed(width)
    network = MLP((width, width, 3), width, width)
    assert network.norm is not None
    torch.nn.init.normal_(network.norm.weight)
    torch.nn.init.normal_(network.norm.bias)
    return network.requires_grad_(False)


def hidden_of(rows, width, each, value):
    """`each` 0: the rows of the table in their order."""
    table_KW = torch.randn(TABLE if each else rows, width)
    chosen = torch.randint(TABLE, (rows * each,)) if each else None
    return Hidden(table_KW, chosen, max(each, 1), 1, torch.randn(rows, width) if value else None)


def expected_outputs(network, hidden):
    table_KW = hidden.table_KW.double()
    rows_RW = table_KW if hidden.chosen is None else table_KW[hidden.chosen].unflatten(0, (-1, hidden.each)).sum(1)
    wide = MLP(network.parts, network.second.in_features, network.second.out_features).double().requires_grad_(False)
    wide.load_state_dict(network.state_dict())
    if hidden.value_RW is not None:
        rows_RW = rows_RW + wide.project(hidden.part, hidden.value_RW.double())
    return wide.finish(rows_RW.clone())


def segments_of(rows, weighted):
    """Runs of rows with empty ones between, at the start and at the end; and each row's run."""
    segment_R = torch.randint(1, 2 + rows // 3, (rows,)).sort()[0]
    count = 4 + rows // 3
    offset = torch.searchsorted(segment_R, torch.arange(count + 1))
    return Segments(rows, offset, torch.rand(rows) if weighted else None), segment_R


# width, rows, addends of each row: every pair of rows and addends, half of them beside a value
CASES = [
    ((16, 48, 128)[i % 3], rows, each, (i + i // 4) % 2 == 0)
    for i, (rows, each) in enumerate(itertools.product((0, 1, 6, 47, 48, 301), range(4)))
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("width", "rows", "each", "value"), CASES)
def test_rows_are_those_of_the_mlp(kind, width, rows, each, value):
    """Each part's product with and without the bias, and added to what is there; outputs alone, onto a residual in
    place, sums of weighted outputs, and both, also where the value itself is the residual."""
    network = fcn_of(width)
    computed, hidden = kind(network), hidden_of(rows, width, each, value)
    for part, depth in enumerate(network.parts):
        value_RW, out_RW = torch.randn(rows, depth), torch.full((rows, width), torch.nan)
        expected_RW = value_RW.double() @ network.columns(part).double().T
        computed.project_into(out_RW, part, value_RW)
        assert_close(out_RW, expected_RW)
        assert_close(computed.add_projection(out_RW, part, value_RW), 2 * expected_RW)
        with_bias_RW = computed.project(part, value_RW, computed.first_bias)
        assert_close(with_bias_RW, expected_RW + network.first.bias.double())
    expected_RW = expected_outputs(network, hidden)

    def again():
        """The table may be overwritten."""
        return hidden._replace(table_KW=hidden.table_KW.clone())

    out_RW, residual_RW = torch.full((rows, width), torch.nan), torch.randn(rows, width)
    total_RW = expected_RW + residual_RW
    computed.output(out_RW, again())
    computed.output(residual_RW, again(), residual_RW)
    assert_close(out_RW, expected_RW)
    assert_close(residual_RW, total_RW)

    for weighted in (False, True):
        segments, segment_R = segments_of(rows, weighted)
        before_SW = torch.randn(len(segments.offset) - 1, width)
        weight_R = torch.ones(rows) if segments.weight_R is None else segments.weight_R
        after_SW = before_SW.double().index_add_(0, segment_R, expected_RW * weight_R[:, None])
        sum_SW = before_SW.clone()
        computed.add_sums(sum_SW, again(), segments)
        assert_close(sum_SW, after_SW)
        for edges_RW in () if weighted else (None, torch.randn(rows, width), hidden.value_RW):
            total_RW = expected_RW if edges_RW is None else expected_RW + edges_RW
            sum_SW = before_SW.clone()
            edges_RW = computed.output_and_add_sums(sum_SW, again(), segments, edges_RW)
            assert_close(edges_RW, total_RW)
            assert_close(sum_SW, after_SW)
        hidden = hidden_of(rows, width, each, value)
        expected_RW = expected_outputs(network, hidden)


@pytest.mark.parametrize("kind", KINDS)
def test_rows_do_not_depend_on_those_beside_them(kind):
    """To the last bit: a row alone, among a few and among many."""
    network, hidden = fcn_of(128), hidden_of(200, 128, 2, value=True)
    computed, out_RW = kind(network), torch.empty(200, 128)
    computed.output(out_RW, hidden)
    projected_RW = computed.project(1, hidden.value_RW)
    for first, last in ((0, 1), (0, 5), (3, 60), (199, 200)):
        part = hidden._replace(chosen=hidden.chosen[2 * first : 2 * last], value_RW=hidden.value_RW[first:last])
        found_RW = torch.empty(last - first, 128)
        computed.output(found_RW, part)
        assert torch.equal(found_RW, out_RW[first:last])
        assert torch.equal(computed.project(1, part.value_RW), projected_RW[first:last])


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
@pytest.mark.parametrize("narrower", ["-mno-avx512f", "-mno-avx"])
def test_vectors_of_other_cpus(monkeypatch, tmp_path, narrower):
    """What is compiled for shorter vectors computes the same."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compiled, "FLAGS", (*compiled.FLAGS, narrower))
    monkeypatch.setattr(compiled, "_library", compiled._library.__wrapped__)
    if (reason := unsupported_reason(128, torch.float32)) is not None:
        pytest.skip(reason)  # a CPU of another kind
    network, hidden = fcn_of(128), hidden_of(100, 128, 3, value=True)
    expected_RW, out_RW = expected_outputs(network, hidden), torch.empty(100, 128)
    CompiledRows(network).output(out_RW, hidden)
    assert_close(out_RW, expected_RW)
    assert len(list((tmp_path / "hgn" / "rows").iterdir())) == 1


def test_what_is_not_compiled(monkeypatch, tmp_path):
    """Types and widths that rows.c does not know, and machines without a compiler, have their rows in PyTorch, and say
    so."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compiled, "_library", compiled._library.__wrapped__)
    assert rows_class(128, torch.float64) is Rows
    reason = "network.width must be a multiple of 16, at most 512, for it, not 24"
    assert unsupported_reason(24, torch.float32) == reason
    monkeypatch.setenv("CC", str(tmp_path / "none"))
    assert describe(128) == f"rows in PyTorch ([Errno 2] No such file or directory: '{tmp_path / 'none'}')"
    monkeypatch.setenv("CC", "false")
    assert unsupported_reason(128, torch.float32) == "false does not compile rows.c: "
    monkeypatch.delenv("CC")
    monkeypatch.setattr(compiled, "COMPILERS", ("no-such-compiler",))
    assert unsupported_reason(128, torch.float32) == "it needs a C compiler: no-such-compiler or CC=…"
    assert rows_class(128, torch.float32) is Rows
    assert not list((tmp_path / "hgn" / "rows").iterdir())


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
def test_compiled_once(monkeypatch, tmp_path):
    """The next process finds what one has compiled, and needs no compiler."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compiled, "_library", compiled._library.__wrapped__)
    assert describe(16) == "rows compiled for this CPU"

    def run(*_, **__):
        raise AssertionError("compiled again")

    monkeypatch.setattr(subprocess, "run", run)
    assert rows_class(16, torch.float32) is compiled_rows


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
def test_compiled_rows_follow_their_parameters():
    """The rows of a network are made once, and compute with its present parameters: after updates in place, after
    other parameters took their places."""
    network = fcn_of(16)
    hidden = hidden_of(7, 16, 2, value=True)
    rows = compiled_rows(network)
    for change in (
        lambda: network.second.weight.mul_(1.5),
        lambda: network.first.bias.add_(0.3),
        lambda: setattr(network.norm, "weight", torch.nn.Parameter(torch.rand(16), requires_grad=False)),
    ):
        change()
        out_RW = torch.empty(7, 16)
        compiled_rows(network).output(out_RW, hidden)
        assert_close(out_RW, expected_outputs(network, hidden))
    assert compiled_rows(network) is not rows
    network.second.bias.zero_()
    assert compiled_rows(network) is compiled_rows(network)
