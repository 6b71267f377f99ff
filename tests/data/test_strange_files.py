"""Files that claim more than they hold are refused before memory is allocated for the claim."""

import json
import os
import subprocess
from pathlib import Path

import pytest
from data import strange_data, strange_scenes
from data.strange_files import CASES

TESTS = Path(__file__).parents[1]
assert strange_data and strange_scenes  # which add their files to CASES
READ = {  # files that hold what they claim
    "mesh: primitives", "mesh: instances", "mesh: targets", "mesh: obj of polygons",
    "mesh: cloud of triangles", "mesh: obj of groups", "mesh: obj of pentagons", "mesh: obj of a spiral",
    "mesh: obj of materials", "mesh: stl of solids", "mesh: ply of short lists", "rollout: attributes",
    "particles: a longer stream",
    "picture: fan", "picture: 50 large triangles",
    "scene: sheet of 9000", "scene: larger obstacle", "scene: keyframes",
    "scene: keyframes of many obstacles", "scene: sheets on one another",
}  # fmt: skip


@pytest.fixture(scope="module")
def outcomes(warm_python):
    """What became of each file, in processes with 2 GB of memory and 20 s of a core."""
    paths = os.pathsep.join(map(str, (TESTS.parent, TESTS, TESTS / "datagen")))
    command = [str(warm_python), str(TESTS / "data" / "strange_program.py")]
    run = subprocess.run(command, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True, check=True)
    return {(line := json.loads(text))["name"]: line for text in run.stdout.splitlines()}


@pytest.mark.parametrize("name", CASES)
def test_claims_are_compared_first(outcomes, name):
    """The file is refused in one short line, or read within the limits; it is not memory that runs out."""
    text = outcomes[name]["text"]
    assert text == "read" if name in READ else text.startswith("refused: ")
    assert "operations" not in name or "must keep the content within" in text
    assert "allocate" not in text and "\n" not in text and len(text) < 1500
    assert outcomes[name]["kB"] < 1_000_000
