"""python -m tools.compare: trees in turns, rows, the table, and what is refused; no assertion on any time."""

import json
import subprocess

import pytest

from hgn.schema import ConfigError
from tools.compare import compared, main

BENCH = """
import json, sys
options = dict(argument.split("=", 1) for argument in sys.argv[1:])
print("a line for people")
if {dies}:
    sys.exit("out of luck")
row = {{"case": "frame", "particles": 4, "scenes": 1, "precision": options["precision"], "memory_gb": 0.1}}
row |= {{"ms": {ms}, "check": {check!r}}}
with open(options["json"], "w") as file:
    json.dump({{"meta": {{"device": "a GPU", "versions": {{}}, "commit": {name!r}}}, "rows": [row]}}, file)
with open({log!r}, "a") as file:
    file.write({name!r} + " ")
sys.exit(0 if row["check"] == "pass" else 1)
"""


def tree(folder, ms=1.0, check="pass", dies=False):
    """A tree whose bench answers at once, and notes its turn in log.txt beside it."""
    (folder / "tools" / "bench").mkdir(parents=True)
    for package in (folder / "tools", folder / "tools" / "bench"):
        (package / "__init__.py").touch()
    log = str(folder.parent / "log.txt")
    (folder / "tools" / "bench" / "__main__.py").write_text(
        BENCH.format(ms=ms, check=check, dies=dies, log=log, name=folder.name)
    )
    return folder


def test_trees_take_turns(tmp_path, capsys):
    """Every tree runs its own bench once a round, in the other order every other round; ratios are to the first."""
    trees = [str(tree(tmp_path / "a", 2.0)), str(tree(tmp_path / "b", 3.0))]
    out = tmp_path / "reports" / "compare.json"
    assert main({"trees": trees, "out": str(out), "rounds": 2, "bench": ["precision=fp16"]}) == 0
    assert (tmp_path / "log.txt").read_text().split() == ["a", "b", "b", "a"]
    report = json.loads(out.read_text())
    assert {"device", "versions", "commit", "date", "command", "config"} <= report["meta"].keys()
    assert report["meta"]["device"] == "a GPU"
    assert report["meta"]["commits"] == dict(zip(trees, "ab", strict=True))
    first, second = report["rows"]
    assert (first["ms"], first["ratio"], first["runs"], first["precision"]) == (2.0, 1.0, 2, "fp16")
    assert (second["tree"], second["ms_range"], second["ratio"]) == (trees[1], [3.0, 3.0], 1.5)
    *_, line = capsys.readouterr().out.splitlines()
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells == [
        "frame, 4 particles, 1 scenes, fp16",
        "2.000 (2.000 … 2.000, 1.000)",
        "3.000 (3.000 … 3.000, 1.500)",
    ]


def test_no_time_where_a_check_is_red(tmp_path, capsys):
    """A tree whose check fails gets the reason instead of a time, one whose bench dies its last line; exit code 1."""
    wrong, dead = tree(tmp_path / "wrong", None, "too wrong"), tree(tmp_path / "dead", dies=True)
    asked = {"trees": [str(wrong), str(dead)], "out": str(tmp_path / "c.json"), "rounds": 1, "bench": ["precision=x"]}
    assert main(asked) == 1
    rows = json.loads((tmp_path / "c.json").read_text())["rows"]
    assert [(row["ms"], row["check"]) for row in rows] == [
        (None, "too wrong"),
        (None, "the bench ended with exit code 1: out of luck"),
    ]
    assert capsys.readouterr().out.splitlines()[-2:] == [
        f"frame of {wrong}: too wrong",
        f"bench of {dead}: the bench ended with exit code 1: out of luck",
    ]


def test_a_run_that_fails_once_takes_the_time_away():
    """A check that is red in one of the runs is red."""
    work = {"case": "train", "particles": 1, "scenes": 1, "precision": "tf32"}
    runs = [{"rows": [work | {"ms": 1.0, "check": "pass"}]}, {"rows": [work | {"ms": None, "check": "late"}]}]
    (row,) = compared({"tree": runs})
    assert (row["ms"], row["check"], row["runs"]) == (None, "late", 2)


def test_a_commit_is_a_tree(tmp_path, monkeypatch):
    """Commits and branches of the repository here are taken out of it, and left as they are."""
    repository = tree(tmp_path / "repository")
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for arguments in (["init", "-q", "-b", "main"], ["add", "."], ["commit", "-qm", "one"]):
        subprocess.run([*git, *arguments], cwd=repository, check=True)
    monkeypatch.chdir(repository)
    assert main({"trees": ["main"], "out": "c.json", "rounds": 1, "bench": ["precision=tf32"]}) == 0
    assert (tmp_path / "log.txt").read_text().split() == ["repository"]


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ("no_branch", r"trees\[0\] must be a folder, or a commit or branch .* git says: fatal"),
        ("{empty}", r"trees\[0\] must be a tree with tools/bench, got .* name the folder above"),
    ],
)
def test_what_is_refused(tmp_path, tree, message):
    """What is no tree is named before anything is timed."""
    with pytest.raises(ConfigError, match=message):
        main({"out": str(tmp_path / "c.json"), "trees": [tree.format(empty=tmp_path)]})
    assert not (tmp_path / "c.json").exists()
