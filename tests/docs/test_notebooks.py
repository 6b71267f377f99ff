"""Notebooks are their pages, and run in a kernel."""

import os

import nbclient
import nbformat
import pytest
from docs.pages import FEWER, ROOT
from processes import PATIENCE_S

from tools.notebooks import DOCS, NOTEBOOKS, notebook

SMALLER = FEWER | {"!pip install PATH_OF_THE_CHECKOUT": ""}


@pytest.mark.parametrize("name", list(NOTEBOOKS))
def test_notebook_is_its_page(name):
    """What is stored is what `python -m tools.notebooks` writes today, and a valid notebook."""
    path = DOCS / "notebooks" / f"{name}.ipynb"
    assert path.read_text(encoding="utf-8") == notebook(DOCS / NOTEBOOKS[name]), "run python -m tools.notebooks"
    nbformat.validate(nbformat.read(path, as_version=4))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_quick_start_runs(tmp_path, monkeypatch):
    """Every cell in a kernel of its own, with two frames; test_tutorials runs the other pages' blocks."""
    content = nbformat.read(DOCS / "notebooks/quick_start.ipynb", as_version=4)
    for cell in content.cells:
        for text, other in SMALLER.items():
            cell.source = cell.source.replace(text, other)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    nbclient.NotebookClient(content, timeout=PATIENCE_S, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert (tmp_path / "my_scene.vtkhdf").is_file()
