"""python -m tools.tables [check=true]: writes the tables and figures of Markdown pages from JSON files.

A folder of pages has a `tables.yaml`, for its own pages or for those that its `pages` names. A page has the markers
`<!-- table: NAME -->` … `<!-- end -->` for a table and `<!--=NAME-->0.302<!--/-->` for a figure within a sentence. This
command writes the text between the markers:

    files: {bench: bench_h100.json}     # sources by name, relative to the folder: .json, or .safetensors (the header)
    values:
      frame: "{bench.rows(case='frame').ms:.3f} ms"
    tables:
      frames:
        rows: bench.rows                # an expression: each item is `row`; or a list of mappings, one for each row
        columns:
          particles: "{row.particles:,}"
          ms: "{row.ms:.3f}"

Braces contain a Python expression over the sources, the names of the row and the functions of `FUNCTIONS`, then a
format. `rows(case='frame')` is the item of the list `rows` with these fields; there must be only one.
`every(rows, case='frame')` is the list of all such items. `held(rows)` counts rows that pass, for example 35 of 36.
`let: {NAME: EXPRESSION}` in a table gives each row further names. A format that starts with `?` leaves the cell empty
if there is no value. Lists are joined by commas, and `%` multiplies by 100.
"""

import json
import math
import re
import statistics
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from hgn.command import run_command
from hgn.schema import ConfigError, from_mapping
from hgn.system.files import write_atomically

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("results", "hgn/weights", "jobs", "docs")  # of the repository, searched for SPECIFICATION
SPECIFICATION = "tables.yaml"
REMEDY = "run python -m tools.tables"

# OSError: a missing file
EXPRESSION_ERRORS = ArithmeticError, AttributeError, LookupError, NameError, OSError, SyntaxError, TypeError, ValueError

TABLE = re.compile(r"(?P<begin><!-- table: (?P<name>[\w-]+) -->\n)(?P<text>.*?)(?P<end><!-- end -->)", re.DOTALL)
VALUE = re.compile(r"(?P<begin><!--=(?P<name>[\w-]+)-->)(?P<text>[^<]*)(?P<end><!--/-->)")
OPENING = re.compile(r"<!-- table: |<!--=")
FIELD = re.compile(r"\{([^{}]+)\}")
NUMERIC = re.compile(r"\W*(\d|$)")
WITH_FORMAT = re.compile(r"(.*):([^:'\"()\[\]]*)", re.DOTALL)


@dataclass(frozen=True)
class TablesConfig:
    """The options of `python -m tools.tables`."""

    check: bool = False  # true: changes nothing, prints differences, and exits with 1 if there are any


@dataclass(frozen=True)
class Page:
    """A page with the text from its sources, and its differences from the file."""

    path: Path
    text: str
    differences: tuple[str, ...]


def main(mapping: dict[str, Any]) -> int:
    """Writes the pages that differ from their sources, or prints the differences."""
    config = from_mapping(TablesConfig, mapping)
    differing = [page for path in specifications(ROOT) for page in pages(path) if page.differences]
    for page in differing:
        name = page.path.resolve().relative_to(ROOT)
        print("\n".join(f"{name}: {difference}" for difference in page.differences) if config.check else name)
        if not config.check:
            write_atomically(page.path, page.text.encode())
    return int(config.check and bool(differing))


def specifications(root: Path) -> list[Path]:
    """Returns all `tables.yaml` of the repository. Raises: ConfigError if there are none."""
    paths = sorted(path for folder in FOLDERS for path in (root / folder).rglob(SPECIFICATION))
    if not paths:
        places = f"{root}/{{{','.join(FOLDERS)}}}"
        raise ConfigError(f"no {SPECIFICATION} in {places}; run it from a checkout of the repository")
    return paths


def pages(specification: Path) -> list[Page]:
    """Returns the Markdown pages in the folder of a specification, or those of its `pages`.

    Raises: ConfigError with file and definition for a marker without a definition or an end, a definition without a
    marker, and an expression without a value.
    """
    definitions = yaml.safe_load(specification.read_text())
    folder = specification.parent
    read: set[str] = set()  # sources of the current definition
    sources = {name: Source(folder / file, read) for name, file in (definitions.get("files") or {}).items()}
    kinds = {"table": definitions.get("tables") or {}, "figure": definitions.get("values") or {}}
    used: set[str] = set()

    def page(path: Path) -> Page:
        differences = []

        def filled(match: re.Match[str], kind: str) -> str:
            name = match["name"]
            if name not in kinds[kind]:
                remedy = "define it there or remove the marker"
                raise ConfigError(f"{path}: {specification} has no {kind} {name}; {remedy}")
            used.add(name)
            read.clear()
            try:
                text = (_table if kind == "table" else _fill)(kinds[kind][name], sources)
            except EXPRESSION_ERRORS as error:
                raise ConfigError(f"{specification}: {kind} {name}: {type(error).__name__}: {error}") from error
            if text != match["text"]:
                differences.append(f"{kind} {name} is not what {' and '.join(sorted(read))} says; {REMEDY}")
            return match["begin"] + text + match["end"]

        text = path.read_text()
        if len(OPENING.findall(text)) != len(TABLE.findall(text)) + len(VALUE.findall(text)):
            raise ConfigError(f"{path}: a marker has no end; tables end with <!-- end -->, figures with <!--/-->")
        text = TABLE.sub(lambda match: filled(match, "table"), text)
        text = VALUE.sub(lambda match: filled(match, "figure"), text)
        return Page(path, text, tuple(differences))

    named = [folder / name for name in definitions.get("pages") or []]
    written = [page(path) for path in named or sorted(folder.glob("*.md"))]
    unused = (kinds["table"].keys() | kinds["figure"].keys()) - used
    if unused:
        raise ConfigError(f"{specification}: no page has a marker for {', '.join(sorted(unused))}")
    return written


class Source:
    """A file of `files`, read at first use; its name is then added to `read`."""

    def __init__(self, path: Path, read: set[str]) -> None:
        self._path = path
        self._read = read
        self._node: Any = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loaded(), name)

    def __getitem__(self, key: Any) -> Any:
        return self._loaded()[key]

    def _loaded(self) -> Any:
        self._read.add(self._path.name)
        if self._node is None:
            weights = self._path.suffix == ".safetensors"
            self._node = _node(_safetensors_header(self._path) if weights else json.loads(self._path.read_text()))
        return self._node


class Record(dict):
    """A JSON object whose fields are attributes too."""

    def __getattr__(self, name: str) -> Any:
        return self[name]

    def __missing__(self, key: Any) -> Any:
        raise LookupError(f"no {key!r} among {', '.join(map(str, self))}")


class Records(list):
    """A JSON list. A call with fields returns the item that has them; there must be only one."""

    def __call__(self, **fields: Any) -> Any:
        chosen = every(self, **fields)
        if len(chosen) != 1:
            raise LookupError(f"{len(chosen)} items of {len(self)} have {fields}")
        return chosen[0]


def every(records: Iterable[Record], **fields: Any) -> Records:
    """Returns all items of a list that have these fields."""
    return Records(item for item in records if all(item.get(name) == value for name, value in fields.items()))


def held(rows: Sequence[Record]) -> str:
    """Returns the number of rows that pass, for example 35 of 36. Raises: LookupError if there are no rows."""
    if not rows:
        raise LookupError("no rows that could pass")
    return f"{sum(row.held for row in rows)} of {len(rows)}"


def _node(value: Any) -> Any:
    if isinstance(value, dict):
        return Record({key: _node(item) for key, item in value.items()})
    return Records(map(_node, value)) if isinstance(value, list) else value


def _safetensors_header(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        (length,) = struct.unpack("<Q", file.read(8))
        header = json.loads(file.read(length))
    metadata = json.loads(header.pop("__metadata__")["hgn"])
    return {"bytes": path.stat().st_size, "tensors": header, "metadata": metadata}


FUNCTIONS: dict[str, Any] = {
    **{
        function.__name__: function
        for function in (abs, any, dict, every, held, len, list, max, min, sorted, str, sum, zip)
    },
    **{"mean": statistics.fmean, "median": statistics.median, "stdev": statistics.stdev, "prod": math.prod},
    "rms": lambda values: math.sqrt(statistics.fmean(value**2 for value in values)),
}


def _table(definition: Mapping[str, Any], sources: Mapping[str, Any]) -> str:
    rows, columns = definition["rows"], definition["columns"]
    scopes: list[dict[str, Any]] = []
    for row in _evaluate(rows, sources) if isinstance(rows, str) else rows:
        scope = dict(sources) | ({"row": row} if isinstance(rows, str) else row)
        for name, expression in definition.get("let", {}).items():
            scope[name] = _evaluate(expression, scope)
        scopes.append(scope)
    if not scopes:
        raise LookupError(f"no rows: {rows}")
    cells = [[_fill(template, scope) for template in columns.values()] for scope in scopes]
    rules = ["--:" if all(NUMERIC.match(text) for text in column) else "---" for column in zip(*cells, strict=True)]
    lines = ["|" + "".join(f" {text} |" if text else " |" for text in line) for line in (columns, rules, *cells)]
    return "\n" + "\n".join(lines) + "\n\n"


def _fill(template: str, names: Mapping[str, Any]) -> str:
    fields = [_field(field, names) for field in FIELD.findall(template)]
    if fields and not any(fields):
        return ""
    return FIELD.sub(lambda _: fields.pop(0), template)


def _field(field: str, names: Mapping[str, Any]) -> str:
    match = WITH_FORMAT.fullmatch(field)
    expression, form = (match[1], match[2]) if match else (field, "")
    optional = form.startswith("?")
    try:
        value = _evaluate(expression, names)
    except (AttributeError, LookupError, NameError, TypeError) as error:
        if optional and (isinstance(error, (LookupError, NameError)) or "NoneType" in str(error)):
            return ""
        raise
    if value is None and optional:
        return ""
    return formatted(value, form.removeprefix("?"))


def _evaluate(expression: str, names: Mapping[str, Any]) -> Any:
    return eval(expression.strip(), {"__builtins__": {}} | FUNCTIONS | dict(names))


def formatted(value: Any, form: str) -> str:
    """Formats a value for a page: 8.4e-6 for 8.4e-06, 12 % for 0.12, 0 for zero; lists are joined by commas."""
    if isinstance(value, (list, tuple)):
        texts = [formatted(item, form) for item in value]
        unit = " %" if form.endswith("%") else ""
        return ", ".join(text.removesuffix(unit) for text in texts) + unit
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        raise ValueError("there is no value")
    if isinstance(value, str) or value == 0:
        return str(value) if isinstance(value, str) else "0"
    percent = form.endswith("g%")  # significant digits of a percentage
    if percent:
        value, form = value * 100, form[:-1]
    if form.endswith("g"):
        digits = int(form[1:-1])
        form = f".{digits - 1}e" if abs(value) < 1e-3 else f"#{form}" if abs(value) < 10**digits else ",.0f"
    text = format(value, form) + ("%" if percent else "")
    text = re.sub(r"e([+-])0*(\d+)", lambda match: f"e{match[1].strip('+')}{match[2]}", text)
    return re.sub(r"\.(?=$|%)", "", text).replace("%", " %")


if __name__ == "__main__":
    run_command(main, "tables")
