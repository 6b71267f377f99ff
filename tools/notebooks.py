"""python -m tools.notebooks: writes the notebooks of docs/notebooks from pages of the documentation.

Text becomes Markdown cells, Python blocks code cells, commands `!` lines and files `%%writefile`. The tests run the
blocks of the pages, which are the only source.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from hgn.system.files import write_atomically

DOCS = Path(__file__).resolve().parents[1] / "docs"
NOTEBOOKS = {
    "quick_start": "tutorials/program.md",
    "own_data": "tutorials/train.md",
    "inverse_problem": "how_to/gradients.md",
}
_BLOCK = re.compile(r"(?:<!-- file: (\S+) -->\n)?```(\w+)\n(.*?)```\n", re.DOTALL)


def main() -> int:
    """Writes all notebooks; returns the exit code."""
    (DOCS / "notebooks").mkdir(exist_ok=True)
    for name, page in NOTEBOOKS.items():
        write_atomically(DOCS / "notebooks" / f"{name}.ipynb", notebook(DOCS / page).encode())
    return 0


def notebook(page: Path) -> str:
    """Returns the notebook of a page, as JSON."""
    text, cells, end = page.read_text(encoding="utf-8"), [], 0
    for block in _BLOCK.finditer(text):
        cells.append(_cell("markdown", text[end : block.start()]))
        file, language, content = block.groups()
        if file is not None:
            content = f"%%writefile {file}\n{content}"
        elif language == "bash":
            content = re.sub(r"^(?=\S)(?!#)", "!", content.replace("\\\n    ", ""), flags=re.MULTILINE)
        elif language != "python":
            cells.append(_cell("markdown", block.group()))
            content = ""
        cells.append(_cell("code", content))
        end = block.end()
    cells.append(_cell("markdown", text[end:]))
    filled = [cell | {"id": f"cell-{i}"} for i, cell in enumerate(cell for cell in cells if cell["source"])]
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    mapping = {"cells": filled, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(mapping, indent=1, ensure_ascii=False) + "\n"


def _cell(kind: str, source: str) -> dict[str, Any]:
    lines = source.strip().splitlines(keepends=True)
    return {"cell_type": kind, "metadata": {}, "source": lines} | (
        {"execution_count": None, "outputs": []} if kind == "code" else {}
    )


if __name__ == "__main__":
    raise SystemExit(main())
