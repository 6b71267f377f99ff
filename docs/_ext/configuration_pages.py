"""Writes the configuration reference from the dataclasses of hgn/config.py: fields, types, defaults, comments."""

from __future__ import annotations

import ast
import io
import tokenize
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "hgn" / "config.py"
TARGET = ROOT / "docs" / "_generated" / "configuration.md"


def configuration_page(source: str) -> str:
    """Markdown: a section and a table for each dataclass, its fields in order, with the comments beside them."""
    tree = ast.parse(source)
    lines, comments = source.splitlines(), _comments(source)
    parts = []
    for node in tree.body:
        if not isinstance(node, ast.ClassDef) or not any("dataclass" in ast.unparse(d) for d in node.decorator_list):
            continue
        rows = [
            "| field | type | default | what |",
            "|---|---|---|---|",
        ]
        for item in node.body:
            if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name):
                rows.append(_row(item, _comment_of(item, lines, comments)))
        text = " ".join((ast.get_docstring(node) or "").split("\n\n")[0].split())
        parts.append(f"## {node.name}\n\n{text}\n\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


def _row(item: ast.AnnAssign, comment: str) -> str:
    default = "required" if item.value is None else ast.unparse(item.value)
    if default.startswith("field("):
        default = "the group's own"
    cells = (f"`{item.target.id}`", f"`{ast.unparse(item.annotation)}`", f"`{default}`", comment)  # type: ignore[union-attr]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


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


def _write(_: Any) -> None:
    TARGET.parent.mkdir(exist_ok=True)
    page = configuration_page(SOURCE.read_text(encoding="utf-8"))
    if not TARGET.is_file() or TARGET.read_text(encoding="utf-8") != page:
        TARGET.write_text(page, encoding="utf-8")


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
