"""python -m tools.tables: pages agree with their JSON, and a changed page or file is named."""

import json

import pytest

import tools.tables
from hgn.schema import ConfigError
from tools.tables import ROOT, Record, Records, _fill, formatted, main, pages, specifications

SPECIFICATION = """
files: {bench: bench.json, weights: weights.safetensors}
values:
  frame: "{bench.rows(case='frame', particles=4296).ms:.3f} ms"
tables:
  frames:
    rows: every(bench.rows, case='frame')
    columns: {particles: "{row.particles:,}", ms: "{row.ms:.2g}", MSE: "{row.mse['10']:?.2g}", check: "{row.check:?}"}
  chosen:
    rows:
      - {label: one, particles: 4296, must: 0.35}
      - {label: two, particles: 400000}
    let: {row: "bench.rows(case='frame', particles=particles)", first: "bench.rows[0]"}
    columns: {"": "{label}", must: "{must:?}", ratio: "{row.ms / first.ms:.1f}", outside: "{row.outside:.2g%}"}
"""
PAGE = """A frame takes <!--=frame-->0.302 ms<!--/-->.

<!-- table: frames -->

| particles | ms | MSE | check |
| --: | --: | --: | --- |
| 4,296 | 0.30 | 8.4e-6 | yes |
| 400,000 | 4.6 | | |

<!-- end -->
<!-- table: chosen -->

| | must | ratio | outside |
| --- | --: | --: | --: |
| one | 0.35 | 1.0 | 0, 12 % |
| two | | 15.4 | 0.072, 1.4 % |

<!-- end -->
"""
BENCH = {
    "rows": [
        {"case": "frame", "particles": 4296, "ms": 0.30213, "mse": {"10": 8.4e-6}, "check": True, "outside": [0, 0.12]},
        {"case": "frame", "particles": 400000, "ms": 4.641, "mse": {}, "check": None, "outside": [0.00072, 0.014]},
        {"case": "update", "particles": 4296, "ms": 1.06},
    ]
}


def folder(path, specification=SPECIFICATION, page=PAGE):
    """A repository with one folder of a page, its JSON and its specification; returns the last."""
    results = path / "results" / "bench"
    results.mkdir(parents=True)
    (results / "bench.json").write_text(json.dumps(BENCH))
    (results / "README.md").write_text(page)
    (results / "tables.yaml").write_text(specification)
    return results / "tables.yaml"


@pytest.mark.parametrize("specification", specifications(ROOT), ids=lambda path: str(path.parent.relative_to(ROOT)))
def test_pages_and_their_json_agree(specification):
    """Every page of the repository agrees with its sources."""
    assert [page.differences for page in pages(specification) if page.differences] == []


def test_writes_tables_and_figures(tmp_path, monkeypatch, capsys):
    """Only text between markers is replaced; check=true prints differences and changes nothing."""
    monkeypatch.setattr(tools.tables, "ROOT", tmp_path)
    page = folder(tmp_path).with_name("README.md")
    assert main({}) == 0 and page.read_text() == PAGE and capsys.readouterr().out == ""
    edited = PAGE.replace("0.302", "0.058").replace("| 15.4 |", "| 15 |")
    page.write_text(edited)
    assert main({"check": True}) == 1 and page.read_text() == edited
    assert capsys.readouterr().out.splitlines() == [
        "results/bench/README.md: table chosen is not what bench.json says; run python -m tools.tables",
        "results/bench/README.md: figure frame is not what bench.json says; run python -m tools.tables",
    ]
    assert main({}) == 0 and page.read_text() == PAGE
    assert capsys.readouterr().out == "results/bench/README.md\n"


FAULTS = [
    (("particles=4296).ms", "particles=1).ms"), "figure frame: LookupError: 0 items of 3 have"),
    (("rows(case='frame', particles=4296)", "rows(case='frame')"), "figure frame: LookupError: 2 items of 3 have"),
    (("row.particles:,", "row.particle:,"), "table frames: LookupError: no 'particle' among case, particles"),
    (("row.mse['10']:?", "row.mse['10']:"), "table frames: LookupError: no '10' among"),
    (("row.ms:.2g", "row.mse:.2g"), "table frames: TypeError"),
    (("row.check:?", "row.check:"), "table frames: ValueError: there is no value"),
    (("  chosen:", "  other:"), "has no table chosen; define it there or remove the marker"),
    (("bench.json", "none.json"), "FileNotFoundError: [Errno 2] No such file or directory: "),
    (("values:", "values:\n  more: '1'"), "no page has a marker for more"),
    (("every(bench.rows, case='frame')", "every(bench.rows, case='no')"), "table frames: LookupError: no rows: every("),
    (("bench.rows(case='frame', particles=4296).ms:.3f", "held([])"), "figure frame: LookupError: no rows that could"),
]


@pytest.mark.parametrize(("change", "message"), FAULTS)
def test_faulty_specifications(tmp_path, change, message):
    """Expressions without a unique value and names without a counterpart are refused by name."""
    assert change[0] in SPECIFICATION
    with pytest.raises(ConfigError) as error:
        pages(folder(tmp_path, SPECIFICATION.replace(*change)))
    assert message in str(error.value) and "tables.yaml" in str(error.value)


@pytest.mark.parametrize("marker", ["<!--/-->", "<!-- end -->\n<!-- table: chosen"])
def test_a_marker_without_an_end(tmp_path, marker):
    """A missing end is not taken from the next table."""
    broken = PAGE.replace(marker, marker.removeprefix("<!--/-->").removeprefix("<!-- end -->\n"))
    with pytest.raises(ConfigError, match=r"README.md: a marker has no end"):
        pages(folder(tmp_path, page=broken))


def test_rows_that_pass():
    """Rows that pass are counted; without rows a format with `?` leaves the cell empty."""
    rows = Records([Record(held=True), Record(held=False), Record(held=True)])
    assert _fill("{held(rows)}", {"rows": rows}) == "2 of 3"
    assert _fill("{held(rows):?}", {"rows": Records()}) == ""


def test_outside_of_a_checkout(tmp_path):
    """Without pages the command fails with a message."""
    with pytest.raises(ConfigError, match="run it from a checkout"):
        specifications(tmp_path)


def test_formats():
    """Figures are shown as pages write them."""
    for value, form, text in (
        *((0.00064, ".2g", "6.4e-4"), (0.0489, ".2g", "0.049"), (0.1, ".2g", "0.10"), (38.7, ".2g", "39")),
        *((1.65e-7, ".3g", "1.65e-7"), (-3e-5, ".1g", "-3e-5"), (4296, ",", "4,296"), (0.8882, ".0%", "89 %")),
        *(([0.8882, 0.968], ".0%", "89, 97 %"), ((0.0270, 0.0597), ".3f", "0.027, 0.060"), (0.0, ".3f", "0")),
        *((1.5e-3, ".1e", "1.5e-3"), (True, "", "yes"), ("pass", "", "pass")),
    ):
        assert formatted(value, form) == text


def test_safetensors_header(tmp_path):
    """Size, tensors and metadata of a weights file are a source like any other."""
    header = json.dumps({"__metadata__": {"hgn": '{"updates": 7}'}, "a": {"dtype": "F16", "shape": [2, 3]}}).encode()
    specification = folder(
        tmp_path,
        SPECIFICATION + "  files:\n    rows: weights.tensors.values()\n"
        "    columns: {updates: '{weights.metadata.updates}', bytes: '{weights.bytes}', size: '{prod(row.shape)}'}\n",
        PAGE + "<!-- table: files -->\n<!-- end -->\n",
    )
    specification.with_name("weights.safetensors").write_bytes(len(header).to_bytes(8, "little") + header)
    (page,) = pages(specification)
    assert f"| 7 | {len(header) + 8} | 6 |" in page.text
    assert page.differences == ("table files is not what weights.safetensors says; run python -m tools.tables",)


def test_pages_elsewhere(tmp_path):
    """A specification may name the pages that it writes. Other pages in their folder stay unchanged."""
    specification = folder(tmp_path, "pages: [../../READ.md]\n" + SPECIFICATION, "<!--=unknown-->1<!--/-->")
    (tmp_path / "READ.md").write_text(PAGE)
    (page,) = pages(specification)
    assert page.path.resolve() == tmp_path / "READ.md" and page.differences == ()
