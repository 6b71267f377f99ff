"""Writes the references from the sources: the dataclasses of hgn/config.py, each command's docstring and settings, and
the fields of documented dataclasses."""

import ast
import dataclasses
import functools
import inspect
import io
import re
import textwrap
import tokenize
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
CONF = ROOT / "conf"
CONFIG = ROOT / "hgn" / "config.py"
GENERATED = ROOT / "docs" / "_generated"


def configuration_page() -> str:
    """Markdown: a section and a table for each dataclass of hgn/config.py."""
    parts = []
    for node in ast.parse(CONFIG.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef) and any("dataclass" in ast.unparse(d) for d in node.decorator_list):
            text = " ".join((ast.get_docstring(node) or "").split("\n\n")[0].split())
            parts.append(f"## {node.name}\n\n{text}\n\n{fields_table(CONFIG, node.name)}")
    return "\n".join(parts)


def fields_table(path: Path, name: str) -> str:
    """The fields of a dataclass in a file, in order: types, defaults, and the comments beside them."""
    return "\n".join(["| field | type | default | what |", "|---|---|---|---|", *_rows(path, name)]) + "\n"


def _rows(path: Path, name: str) -> list[str]:
    """The rows of a dataclass: its own fields, then those that it inherits."""
    source = path.read_text(encoding="utf-8")
    lines, comments = source.splitlines(), _comments(source)
    (node,) = [n for n in ast.parse(source).body if isinstance(n, ast.ClassDef) and n.name == name]
    fields = [item for item in node.body if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)]
    rows = [_row(item, _comment_of(item, lines, comments)) for item in fields]
    for base in {"SimulatorConfig", "ReportConfig"}.intersection(map(ast.unparse, node.bases)):
        rows += _rows(CONFIG if base == "SimulatorConfig" else ROOT / "tools" / "report.py", base)
    return rows


def _row(item: ast.AnnAssign, comment: str) -> str:
    value = item.value
    if isinstance(value, ast.Name):
        value = _config_constants().get(value.id, value)
    default = "required" if value is None else ast.unparse(value)
    if default.startswith("field("):
        default = "the group's own"
    cells = (f"`{item.target.id}`", f"`{ast.unparse(item.annotation)}`", f"`{default}`", comment)  # type: ignore[union-attr]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


@functools.cache
def _config_constants() -> dict[str, ast.expr]:
    """The constants of hgn/config.py by name, for defaults are shown as values."""
    body = ast.parse(CONFIG.read_text(encoding="utf-8")).body
    named = [(node.targets[0], node.value) for node in body if isinstance(node, ast.Assign)]
    return {target.id: value for target, value in named if isinstance(target, ast.Name)}


def _comments(source: str) -> dict[int, str]:
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}


def _comment_of(item: ast.AnnAssign, lines: list[str], comments: dict[int, str]) -> str:
    """The comment behind a field, after what stands above it on lines of their own."""
    above = []
    number = item.lineno - 1
    while number in comments and lines[number - 1].lstrip().startswith("#"):
        above.insert(0, comments[number])
        number -= 1
    behind = comments.get(item.end_lineno or item.lineno)
    return "; ".join(([" ".join(above)] if above else []) + ([behind] if behind else []))


def command_names() -> dict[str, tuple[Path, list[str]]]:
    """By `python -m` name, the file of each command and the names of its configurations."""
    found = {}
    for folder in ("datagen", "hgn", "tools"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            names = re.findall(r"^ +run_command\(.*\"(\w+)\"\)", path.read_text(encoding="utf-8"), re.MULTILINE)
            if names:
                parts = path.relative_to(ROOT).with_suffix("").parts
                found[".".join(parts[:-1] if parts[-1] == "__main__" else parts)] = (path, names)
    return found


def commands_page() -> str:
    """Markdown: a section for each command, with its module's docstring and its settings."""
    parts = []
    for name, (path, configurations) in command_names().items():
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        parts.append(f"## {name}\n\n```text\n{text}\n```\n")
        parts += [_settings(configuration) for configuration in configurations]
    return "\n".join(parts)


def _settings(configuration: str) -> str:
    """The settings of a command: the fields of its dataclass, or where they stand, and what its own file changes."""
    (file,) = [
        path for path in (CONF / f"{configuration}.yaml", CONF / "command" / f"{configuration}.yaml") if path.is_file()
    ]
    content = yaml.safe_load(file.read_text(encoding="utf-8"))
    parts = []
    for default in content.pop("defaults", []):
        if isinstance(default, dict):
            ((group, choice),) = default.items()
            parts.append(f"- `{group}`: {choice}, of `conf/{group}`")
        elif "." in default:
            module, _, name = default.rpartition(".")
            source = ROOT / f"{module.replace('.', '/')}.py"
            linked = source == CONFIG
            parts.append(f"[{name}](configuration.md#{name.lower()})" if linked else fields_table(source, name))
    if content:
        text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
        parts.append(f"\nIn its own file:\n\n```yaml\n{text}```")
    return "Settings:\n\n" + "\n".join(parts) + "\n"


def _write(_: Any) -> None:
    GENERATED.mkdir(exist_ok=True)
    pages = {
        "configuration.md": configuration_page(),
        "commands.md": commands_page(),
    }
    for name, page in pages.items():
        target = GENERATED / name
        if not target.is_file() or target.read_text(encoding="utf-8") != page:
            target.write_text(page, encoding="utf-8")


def _document_fields(_: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Adds a dataclass's fields, with their types and the comments beside them, to its docstring."""
    if what != "class" or not dataclasses.is_dataclass(obj):
        return
    source = textwrap.dedent(inspect.getsource(obj))
    node, text, comments = ast.parse(source).body[0], source.splitlines(), _comments(source)
    assert isinstance(node, ast.ClassDef)
    lines.append("")
    for item in node.body:
        if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name) and item.target.id[0] != "_":
            comment = _comment_of(item, text, comments).replace("*", "\\*").replace("`", "")
            lines.append(f":param {item.target.id}: ``{ast.unparse(item.annotation)}``; {comment}".rstrip("; "))


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", _write)
    app.connect("autodoc-process-docstring", _document_fields)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
