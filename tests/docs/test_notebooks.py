"""Notebooks are their pages, run as they stand, and keep what they showed."""

import json
import re

import nbformat
import pytest
from docs.pages import run_module
from nbclient.exceptions import CellExecutionError

from tools import notebooks
from tools.notebooks import DOCS, NOTEBOOKS, notebook

# what is smaller when the notebooks run here, as the other pages are in test_tutorials.py
FEWER: dict[str, dict[str, str]] = {
    "quick_start": {
        "frames=300": "frames=4",
        "frame == 300": "frame == 2",
        "range(120)": "range(3)",
        "frame == 60": "frame == 1",
    },
    "own_data": {
        "scene:\n": "network: {width: 8, levels: 2, message_passing_steps: 1}\nscene:\n",
        "obstacle_count: 2": "obstacle_count: 1\n  group_count: 1\n  group_size: 0.04",
        "[water, sand]": "[water]",
        "lone_particles: 4": "lone_particles: 0",
        "frames: 24": "frames: 6",
        "maximum_updates: 60": "maximum_updates: 4",
        "monitor_every: 30": "monitor_every: 2\n  monitor_rollout_frames: 0",
        "maximum_updates=20": "maximum_updates=5",
    },
    "inverse_problem": {
        "FRAMES = 40": "FRAMES = 6",
        "ANGLES_DEG = (22.0, 30.0, 40.0)": "ANGLES_DEG = (30.0,)",
        "(16, 16, 16)": "(4, 4, 4)",
        "range(1, 9)": "range(1, 2)",
        "np.linspace(15, 45, 7)": "np.linspace(15, 45, 2)",
    },
}


@pytest.mark.parametrize("name", list(NOTEBOOKS))
def test_notebook_is_its_page(name):
    """A stored notebook has the cells of its page, was run in order without an error, and shows a picture."""
    stored = nbformat.read(DOCS / "notebooks" / f"{name}.ipynb", as_version=4)
    nbformat.validate(stored)
    made = notebook(name)["cells"]
    assert [cell.source for cell in stored.cells] == [cell["source"] for cell in made], "run python -m tools.notebooks"
    code = [cell for cell in stored.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell.outputs]
    assert not any(output.output_type == "error" or "error: " in output.get("text", "") for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)


def test_friction_angles_are_found():
    """The stored notebook finds the angles of the network's own run-outs within one degree."""
    text = (DOCS / "notebooks" / "inverse_problem.ipynb").read_text(encoding="utf-8")
    errors = [float(error) for error in re.findall(r"degrees: error ([+-][\d.]+) in", text)]
    assert len(errors) == 6 and max(map(abs, errors[:3])) < 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", list(NOTEBOOKS))
def test_notebooks_run(name, warm_python, tmp_path, monkeypatch):
    """Every cell, in a kernel of its own, with fewer frames, scenes and updates. No command fails."""
    (tmp_path / "notebooks").mkdir()
    (tmp_path / NOTEBOOKS[name]).parent.mkdir()
    (tmp_path / NOTEBOOKS[name]).write_text((DOCS / NOTEBOOKS[name]).read_text())
    monkeypatch.setattr(notebooks, "DOCS", tmp_path)
    monkeypatch.setattr(notebooks, "BEGIN", f"{notebooks.BEGIN}\nsys.executable = {str(warm_python)!r}")
    monkeypatch.setattr(notebooks, "FEWER", notebooks.FEWER | FEWER[name])
    monkeypatch.setattr("sys.argv", ["notebooks", name])
    assert all(json.dumps(few)[1:-1] in json.dumps(notebook(name)) for few in FEWER[name].values())
    assert notebooks.main() == 0
    ended = nbformat.read(tmp_path / "notebooks" / f"{name}.ipynb", as_version=4)
    printed = [output.get("text", "") for cell in ended.cells for output in cell.get("outputs", ())]
    assert not any("error: " in text or "Traceback" in text for text in printed), printed


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_failing_command_ends_a_notebook(tmp_path, monkeypatch):
    """A cell fails where its command fails; the error shows the ends of what this cell and those before it printed."""
    commands = ("print(*range(40), sep=chr(10))", 'import sys; sys.exit(print("third") or 3)', "")
    (tmp_path / "page.md").write_text("".join(f"```bash\npython -c '{command}'\n```\n" for command in commands))
    monkeypatch.setattr(notebooks, "DOCS", tmp_path)
    monkeypatch.setattr(notebooks, "NOTEBOOKS", {"failing": "page.md"})
    monkeypatch.setattr("sys.argv", ["notebooks", "failing"])
    with pytest.raises(CellExecutionError, match=r"CalledProcessError.*exit status 3") as error:
        notebooks.main()
    first, second = (note.splitlines()[1:] for note in error.value.__notes__)
    assert first == [str(i) for i in range(20, 40)] and second == ["third"]
    assert not list(tmp_path.rglob("*.ipynb"))


def test_help(capsys):
    """Help prints the usage, and writes no notebook."""
    assert run_module("tools.notebooks", ["--help"]) == 0
    assert capsys.readouterr().out.startswith("python -m tools.notebooks [NAME")
