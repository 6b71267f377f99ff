"""python -m tools.notebooks [NAME …]: writes docs/notebooks from pages of the documentation, and runs them.

Text becomes Markdown cells, Python blocks code cells, commands `!` lines and files `%%writefile`. Outputs are kept. A
notebook whose code has not changed gets the page's new text and is not run again. The pages are the only source; FEWER
lists what is smaller, so that each notebook takes minutes on two CPU cores.
"""

import json
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

from hgn.system.files import write_atomically
from hgn.system.provenance import without_folders

DOCS = Path(__file__).resolve().parents[1] / "docs"
NOTEBOOKS = {
    "quick_start": "tutorials/program.md",
    "own_data": "tutorials/train.md",
    "inverse_problem": "tutorials/friction.md",
}
FEWER = {
    "training_scenes: 200\n": "training_scenes: 2 # 200\n  frames: 24 # 300\n",
    "validation_scenes: 5\n": "validation_scenes: 1\n  test_scenes: 0\n",
    "maximum_updates: 20000\n": "maximum_updates: 60 # 20000\n  batch_scenes: 1 # 8\n  monitor_every: 30\n",
    "training.maximum_updates=5000": "training.maximum_updates=20",
}
OPEN = "make setup\n.venv/bin/pip install jupyterlab\n.venv/bin/jupyter lab docs/notebooks"
FIRST = (
    "This notebook is the page docs/{page}. It writes its files to a new temporary folder, and does not delete them. "
    f"To open it, in the folder of the project:\n```bash\n{OPEN}\n```"
)
BEGIN = "import os\nimport sys\nimport tempfile\n\nos.chdir(tempfile.mkdtemp())  # for the files of this notebook"
SHOW = {"own_data": "from IPython.display import Image\n\nImage('mine.png')"}
RAISING = ["--InteractiveShell.system_raise_on_error=True"]  # a cell ends with an error where its command fails
SHOWN_LINES = 20  # number of last lines of each cell's output that an error shows
_BLOCK = re.compile(r"(?:<!-- file: (\S+) -->\n)?```(\w+)\n(.*?)```\n", re.DOTALL)


def main() -> int:
    """Writes the notebooks that the command line names, or all; returns the exit code."""
    if {"--help", "-h"} & set(sys.argv[1:]):
        print(__doc__.strip())
        return 0
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError
    from nbformat import from_dict

    (DOCS / "notebooks").mkdir(exist_ok=True)
    for name in sys.argv[1:] or NOTEBOOKS:
        content, path = from_dict(notebook(name)), DOCS / "notebooks" / f"{name}.ipynb"
        code, kept = _code(content), _code(json.loads(path.read_bytes())) if path.exists() else []
        if [cell["source"] for cell in code] == [cell["source"] for cell in kept]:
            for cell, stored in zip(code, kept, strict=True):
                cell.update(stored | {"id": cell["id"]})
        else:
            with tempfile.TemporaryDirectory() as folder:
                place = {"metadata": {"path": folder}}
                try:
                    NotebookClient(content, timeout=None, extra_arguments=RAISING, resources=place).execute()
                except CellExecutionError as error:
                    for cell in _code(content):
                        if text := _printed(cell):
                            error.add_note("\n".join([cell.source, *text.splitlines()[-SHOWN_LINES:]]))
                    raise
            for cell in content.cells:
                _tidy(cell)
        write_atomically(path, (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode())
    return 0


def _code(content: Any) -> list[Any]:
    return [cell for cell in content["cells"] if cell["cell_type"] == "code"]


def _printed(cell: Any) -> str:
    """Joins what a cell prints, and keeps only the end of a progress bar."""
    printed = "".join(output.get("text", "") for output in cell.get("outputs", ()))
    return without_folders(re.sub(r"[^\n]*\r(?!\n)", "", printed.replace("\r\n", "\n")))


def _tidy(cell: Any) -> None:
    """Keeps of a cell's outputs the text and one form of a picture."""
    cell.metadata.clear()
    text, outputs = _printed(cell), cell.get("outputs", ())
    shown = [output for output in outputs if "text" not in output]
    for output in shown:
        output.data.pop("image/jpeg", None)
    if outputs:
        stream = [{"output_type": "stream", "name": "stdout", "text": text}] if text else []
        cell.outputs = [*stream, *shown]


def notebook(name: str) -> dict[str, Any]:
    """Returns the notebook of a page, without outputs."""
    text = (DOCS / NOTEBOOKS[name]).read_text(encoding="utf-8")
    cells, end = [_cell("markdown", FIRST.format(page=NOTEBOOKS[name])), _cell("code", BEGIN)], 0
    for block in _BLOCK.finditer(text):
        cells.append(_cell("markdown", text[end : block.start()]))
        file, language, content = block.groups()
        for whole, fewer in FEWER.items():
            content = content.replace(whole, fewer)
        if file is not None:
            folder = f"!mkdir -p {Path(file).parent}\n" if "/" in file else ""
            cells.append(_cell("code", folder))
            content = f"%%writefile {file}\n{content}"
        elif language == "bash":
            content = re.sub(r"^python", "!{sys.executable}", content.replace("\\\n    ", ""), flags=re.MULTILINE)
            content = "" if content.startswith("pip install") else content  # make setup has installed it
        elif language != "python":
            cells.append(_cell("markdown", block.group()))
            content = ""
        cells.append(_cell("code", content))
        end = block.end()
    cells += [_cell("code", SHOW.get(name, "")), _cell("markdown", text[end:])]
    filled = [cell | {"id": f"cell-{i}"} for i, cell in enumerate(cell for cell in cells if cell["source"])]
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return {"cells": filled, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}


def _cell(kind: str, source: str) -> dict[str, Any]:
    code: dict[str, Any] = {"execution_count": None, "outputs": []} if kind == "code" else {}
    return {"cell_type": kind, "metadata": {}, "source": source.strip()} | code


if __name__ == "__main__":
    raise SystemExit(main())
