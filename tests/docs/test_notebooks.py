"""Notebooks are their pages, run as they stand, and keep what they showed."""

import nbformat
import pytest

from tools import notebooks
from tools.notebooks import DOCS, NOTEBOOKS, notebook

WITHOUT_OUTPUTS = ("inverse_problem",)  # half an hour on two cores


@pytest.mark.parametrize("name", list(NOTEBOOKS))
def test_notebook_is_its_page(name):
    """What is stored is what `python -m tools.notebooks` writes today, was run from its first cell to its last without
    an error, shows a picture where its page makes one, and names no folder of the machine."""
    stored = nbformat.read(DOCS / "notebooks" / f"{name}.ipynb", as_version=4)
    nbformat.validate(stored)
    made = notebook(name)["cells"]
    assert [cell.source for cell in stored.cells] == [cell["source"] for cell in made], "run python -m tools.notebooks"
    if name in WITHOUT_OUTPUTS:
        return
    code = [cell for cell in stored.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell.outputs]
    assert not any(output.output_type == "error" or "error: " in output.get("text", "") for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", list(NOTEBOOKS))
def test_notebooks_run_as_they_stand(name, tmp_path, monkeypatch):
    """Every cell in a kernel of its own, with nothing changed."""
    (tmp_path / "notebooks").mkdir()
    for page in NOTEBOOKS.values():
        (tmp_path / page).parent.mkdir(exist_ok=True)
        (tmp_path / page).write_text((DOCS / page).read_text())
    monkeypatch.setattr(notebooks, "DOCS", tmp_path)
    monkeypatch.setattr("sys.argv", ["notebooks", name])
    assert notebooks.main() == 0
    ended = nbformat.read(tmp_path / "notebooks" / f"{name}.ipynb", as_version=4)
    assert not any("error: " in output.get("text", "") for cell in ended.cells for output in cell.get("outputs", ()))
