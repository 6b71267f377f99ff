"""python -m tools.compare: trees, checks, rows, tables, and processes that end; no assertion on any time."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from kernels.engines import device

from hgn.schema import ConfigError, from_mapping
from tools.bench import contenders, fast
from tools.bench.contenders import PASS
from tools.bench.states import Workload, batch_of
from tools.compare import children
from tools.compare.__main__ import main
from tools.compare.children import Children
from tools.compare.config import CompareConfig
from tools.compare.report import Report
from tools.compare.server import MOST_SAMPLES, Server
from tools.compare.trees import TAKEN, Tree, find_trees
from tools.compare.turns import Comparison

ROOT = Path(__file__).parents[2]
SMALL: dict[str, Any] = {
    "network": {"width": 16, "levels": 1, "message_passing_steps": 1},
    "particles": 1,
    "rounds": 1,
    "device": "cpu",
}
ADDED, SUBTRACTED = "tl.where(newest, v + a, v)", "tl.where(newest, v - a, v)"


def test_this_tree_its_last_commit_and_a_wrong_copy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """This tree, and its last commit where there is a repository, are checked before and after, and timed; a copy
    that subtracts accelerations gets no time but the error, and the exit code is 1."""
    wrong = tmp_path / "wrong"
    for name in TAKEN[:-1]:
        shutil.copytree(ROOT / name, wrong / name, ignore=shutil.ignore_patterns("*.safetensors", "__pycache__"))
    kernel = wrong / "hgn" / "kernels" / "rollout" / "kernel.py"
    right = kernel.read_text()
    assert right.count(ADDED) == 1
    kernel.write_text(right.replace(ADDED, SUBTRACTED))
    monkeypatch.chdir(ROOT)
    good = [".", "HEAD"] if (ROOT / ".git").exists() else ["."]
    out = tmp_path / "reports" / "compare.json"
    asked = {"trees": [*good, str(wrong)], "cases": ["frame_1"], "out": str(out)}
    assert main(SMALL | asked) == 1
    report = json.loads(out.read_text())
    assert {"device", "versions", "commit", "date", "command", "config", "trees"} <= report["meta"].keys()
    assert [tree["tree"] for tree in report["meta"]["trees"]] == [*good, "wrong"]
    *rows, bad = report["rows"]
    assert [row["tree"] for row in rows] == good
    for row in rows:
        assert (row["case"], row["check"], row["checked"]) == ("frame_1", PASS, ["before", "after"])
        low, high = row["ms_quartiles"]
        assert 0 < low <= row["ms"] <= high and row["samples"] == 1
    assert bad["tree"] == "wrong" and bad["ms"] is None and bad["samples"] == 0 and bad["checked"] == ["before"]
    assert bad["check"].startswith("relative error of acceleration 2.0e+00 exceeds")
    assert all(check["errors"].keys() == {"acceleration"} for check in report["checks"])
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == f"| ms | {' | '.join(good)} | wrong |"
    assert printed[-2].startswith("| frame_1 | ") and printed[-2].endswith(" | - |")
    assert printed[-1] == f"frame_1 of wrong: {bad['check']}"


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """Of this tree, in this process, where kernels run natively if there is a GPU."""
    for name in ("reference_acceleration", "reference_gradients", "verdict", "FRAMES_AT_ONCE", "UPDATES_AT_ONCE"):
        monkeypatch.setattr(fast, name, getattr(fast, name))  # which the server replaces
    before = torch.get_float32_matmul_precision()
    yield Server(SMALL | {"precision": "half", "references": str(tmp_path), "device": str(device())})
    torch.set_float32_matmul_precision(before)


def test_an_update_is_checked_and_timed(server: Server) -> None:
    """Loss and gradients of all scenes are compared with those that were kept; a wrong answer is seen."""
    server.reference("update_1")
    server.prepare("update_1")
    found = server.check("update_1")
    assert found["check"] == PASS and found["errors"].keys() == {"loss", "gradient"}
    assert 1 <= len(server.sample("update_1")["ms"]) <= MOST_SAMPLES


def test_a_profile(server: Server) -> None:
    """Names, times and launches of what a frame runs, the longest first, and all together."""
    server.prepare("frame_1")
    found = server.profile("frame_1")
    times = [kernel["us"] for kernel in found["kernels"]]
    assert times == sorted(times, reverse=True) and found["us"] >= sum(times) > 0 and found["launches"] > 1


def test_references_of_many_scenes(server: Server, tmp_path: Path) -> None:
    """Scenes that do not fit into the GPU at once give the same loss and gradients in groups."""
    server.reference("update_11")
    loss, gradient = torch.load(tmp_path / "update_11.pt")
    network = contenders.bench_network(server.network, server.device)
    batch = batch_of(Workload(1, 11), server.network, server.device)
    expected_loss, expected = contenders.reference_gradients(network, batch)
    torch.testing.assert_close(loss, expected_loss)
    torch.testing.assert_close(gradient, expected)


STAND_IN = """
import json, os, sys
from pathlib import Path
folder = Path(os.environ["PYTHONPATH"].split(os.pathsep)[0])
assert json.loads(sys.argv[1])["cases"]
checks = 0
for line in sys.stdin:
    order = json.loads(line)
    name, answer = order["order"], {}
    if (folder / f"dies_at_{name}").exists():
        print("first line\\n\\nout of luck", file=sys.stderr, flush=True)
        os._exit(3)
    if (folder / f"hangs_at_{name}").exists():
        import time
        time.sleep(600)
    if (folder / f"fails_at_{name}").exists():
        answer = {"error": "no luck"}
    elif name == "hello":
        answer = {"folder": str(folder)}
    elif name == "check":
        checks += 1
        answer = {"check": "too wrong" if checks == 2 and (folder / "wrong_after").exists() else "pass", "errors": {}}
    elif name == "sample":
        answer = {"ms": [1.0, 3.0]}
    elif name == "profile":
        answer = {"us": 2.0, "launches": 1, "kernels": [{"kernel": "k", "us": 2.0, "launches": 1}]}
    print(json.dumps(answer), flush=True)
"""
COMPILER = """
import os, sys
from pathlib import Path
folder = Path(os.environ["PYTHONPATH"].split(os.pathsep)[0])
if (folder / "compiles_for_ever").exists():
    import time
    time.sleep(600)
assert not (folder / "does_not_compile").exists(), "no such kernel"
(Path(os.environ["TRITON_CACHE_DIR"])).mkdir(exist_ok=True)
"""


@pytest.fixture
def stand_ins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of server and compiler: what a tree does is told by the files in it."""
    programs = tmp_path / "programs"
    programs.mkdir()
    (programs / "server.py").write_text(STAND_IN)
    (programs / "compiler.py").write_text(COMPILER)
    monkeypatch.setattr(children, "PROGRAMS", programs)


@pytest.fixture
def compare(tmp_path: Path, stand_ins: None) -> Callable[..., Report]:
    """Compares trees, a file in each."""

    def run(*files: str, seconds: float = 60.0, rounds: int = 4, interrupt: bool = False) -> Report:
        trees = []
        for i, file in enumerate(files):
            folder = tmp_path / f"tree_{i}"
            folder.mkdir()
            (folder / file).touch()
            trees.append(Tree(i, f"tree_{i}", folder, "unknown"))
        config = CompareConfig(
            tuple(files), "unused", ("frame_5",), profiles=("frame_5",), seconds=seconds, rounds=rounds
        )
        report = Report(tmp_path / "compare.json", {}, config.cases, [tree.name for tree in trees])
        started = Children({"cases": ["frame_5"]}, tmp_path, interpreter=False)
        try:
            with started:
                comparison = Comparison(config, started, trees, report)
                if interrupt:
                    comparison._profile = interrupted  # type: ignore[method-assign]
                comparison.run()
        finally:
            assert all(process.poll() is not None for process in started._processes)
        assert json.loads(report.path.read_text())["rows"] == report.rows()
        return report

    return run


def interrupted(case: str) -> None:
    raise KeyboardInterrupt


def test_rounds_and_table(compare: Callable[..., Report]) -> None:
    """Every tree has the samples of all rounds, quartiles, and a ratio to the first in the table."""
    report = compare("fine", "fine_too")
    assert report.green()
    for row in report.rows():
        assert (row["ms"], row["ms_quartiles"], row["samples"]) == (2.0, [1.0, 3.0], 8)
    assert report.table().splitlines() == [
        "| ms | tree_0 | tree_1 |",
        "| :-- | --: | --: |",
        "| frame_5 | 2 | 2 (1.000) |",
    ]
    assert "| k | 2.0 × 1 | 2.0 × 1 |" in report.profile_tables()


@pytest.mark.parametrize(("file", "code"), [("fine", 0), ("wrong_after", 1)])
def test_exit_code(
    repository: Path, tmp_path: Path, stand_ins: None, capsys: pytest.CaptureFixture[str], file: str, code: int
) -> None:
    """0 where every check of every tree passes, else 1; the table comes last."""
    (repository / file).touch()
    asked = {"trees": ["main", ".."], "cases": ["frame_1", "frame_2"], "out": str(tmp_path / "compare.json")}
    assert main(SMALL | asked) == code
    assert capsys.readouterr().out.startswith("| ms | main | .. |")


def test_no_time_of_what_fails_afterwards(compare: Callable[..., Report]) -> None:
    """Times of a tree whose second check is red are taken back."""
    first, second = (report := compare("fine", "wrong_after")).rows()
    assert first["ms"] == 2.0 and second["ms"] is None
    assert second["check"] == "too wrong" and second["checked"] == ["before", "after"] and not report.green()
    assert report.table().endswith("| frame_5 | 2 | - |\nframe_5 of tree_1: too wrong")


@pytest.mark.parametrize("order", ["prepare", "check", "sample", "profile"])
def test_a_process_that_dies(compare: Callable[..., Report], order: str) -> None:
    """The end of its log is told, the others go on, and there is no time of it."""
    dead, alive = (report := compare(f"dies_at_{order}", "fine")).rows()
    assert alive["ms"] == 2.0 and dead["ms"] is None and not report.green()
    assert dead["check"] == "the process died (exit code 3): first line | out of luck"


@pytest.mark.parametrize("order", ["prepare", "check", "sample"])
def test_an_order_that_fails(compare: Callable[..., Report], order: str) -> None:
    """It is told in place of a time."""
    failed, other = compare(f"fails_at_{order}", "fine").rows()
    assert (failed["check"], failed["ms"], other["ms"]) == ("no luck", None, 2.0)


def test_a_process_that_hangs(compare: Callable[..., Report], monkeypatch: pytest.MonkeyPatch) -> None:
    """It is waited for as long as there is time, and then ended."""
    monkeypatch.setattr(children, "LEAST_PATIENCE_S", 0.1)
    hanging, other = compare("hangs_at_check", "fine", seconds=2.0).rows()
    assert hanging["check"].startswith("no answer in ") and hanging["ms"] is None
    assert other["case"] == "frame_5"


def test_compilers(
    compare: Callable[..., Report], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What fails is told with its message, what takes too long is stopped, and the comparison goes on all the same."""
    compile_all = Children.compile

    def once_one_failed(self: Children, trees: Any, shares: int, stop: Callable[[], bool]) -> str:
        servers = len(self._processes)  # on a busy machine time is over before the first compiler runs
        return compile_all(self, trees, shares, lambda: self._processes[servers].poll() is not None and stop())

    monkeypatch.setattr(Children, "compile", once_one_failed)
    assert compare("does_not_compile", "compiles_for_ever", seconds=4.0).green()
    told = capsys.readouterr().err
    assert (
        re.search("[1-9][0-9]* of them were stopped", told)
        and "tree_0 failed" in told
        and "AssertionError: no such kernel" in told
    )


def test_rounds_end_in_time(compare: Callable[..., Report], capsys: pytest.CaptureFixture[str]) -> None:
    """Without time left there are three rounds and the last checks."""
    report = compare("fine", seconds=1e-3, rounds=100)
    assert report.green() and report.rows()[0]["samples"] == 6
    assert "ended after 3 rounds" in capsys.readouterr().err


def test_an_interrupted_run_keeps_what_it_has(tmp_path: Path, compare: Callable[..., Report]) -> None:
    """After Ctrl-C no process is left, and the file has the times of all rounds, with the checks made so far."""
    with pytest.raises(KeyboardInterrupt):
        compare("fine", "hangs_at_profile", interrupt=True)
    rows = json.loads((tmp_path / "compare.json").read_text())["rows"]
    assert [(row["samples"], row["checked"]) for row in rows] == [(8, ["before"])] * 2


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One with a tree as small as can be, with weights in it, as the current folder."""
    folder = tmp_path / "repository"
    files = (
        "hgn/kernels/precompile.py",
        "tools/bench/fast.py",
        "pyproject.toml",
        "hgn/weights/a.safetensors",
        "tests/t.py",
    )
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(file)
    for name in ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE"):
        monkeypatch.delenv(name, raising=False)
    author = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
    for arguments in (("init", "-q", "-b", "main"), ("add", "."), (*author, "commit", "-q", "-m", "first")):
        subprocess.run(["git", "-C", str(folder), *arguments], check=True)
    monkeypatch.chdir(folder / "tests")
    return folder


def test_trees_by_name(repository: Path, tmp_path: Path) -> None:
    """A branch or commit is taken out without weights and tests, whatever part of the repository one is in; a folder is
    taken as it is."""
    branch, folder = find_trees(["main", ".."], tmp_path)
    assert (branch.name, branch.number, folder.name, folder.number) == ("main", 0, "..", 1)
    assert len(branch.commit) == 12 and folder.commit == branch.commit and folder.folder == repository
    taken = sorted(str(path.relative_to(branch.folder)) for path in branch.folder.rglob("*") if path.is_file())
    assert taken == ["hgn/kernels/precompile.py", "pyproject.toml", "tools/bench/fast.py"]
    (repository / "pyproject.toml").write_text("changed")
    assert find_trees([str(repository)], tmp_path) == [Tree(0, "repository", repository, f"{branch.commit}+changes")]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["no_branch"], r"trees\[0\] must be a folder, or a commit or branch .* got 'no_branch'; git says: fatal"),
        (["main", "--help"], r"trees\[1\] must be a folder, or a commit"),
        (
            [".."],
            r"trees\[0\] must be a tree with hgn/kernels/precompile.py and .* got '..'; name the folder above hgn",
        ),
        (["{other}/x", "{here}/x"], r"trees\[1\] must be of another name than the others, got 'x'"),
    ],
)
def test_trees_that_are_none(repository: Path, tmp_path: Path, names: list[str], message: str) -> None:
    """Each wrong name is refused with what it should be."""
    for parent in ("other", "here"):
        shutil.copytree(repository, tmp_path / parent / "x")
    (repository / "tools/bench/fast.py").unlink()
    with pytest.raises(ConfigError, match=message):
        find_trees([name.format(other=tmp_path / "other", here=tmp_path / "here") for name in names], tmp_path / "room")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"trees": []}, "trees must be a list with at least one tree, got .*; as in"),
        ({"trees": ["a", "a"]}, r"trees\[1\] must be named once, got 'a'"),
        (
            {"cases": ["train_8"]},
            r"cases\[0\] must be update_SCENES or frame_PARTICLES, got 'train_8'; as in update_32",
        ),
        ({"cases": ["update_0"]}, r"cases\[0\] must be update_SCENES"),
        ({"cases": ["update_1"], "profiles": ["update_2"]}, r"profiles\[0\] must be one of the cases, got 'update_2'"),
        ({"rounds": 0}, "rounds must be a finite number > 0"),
        ({"precision": "fp16"}, "precision must be one of highest, high, half"),
        ({"network": {"kind": "gns", "levels": 1}}, "network.kind must be hgn"),
        ({"out": ""}, "out must be the name of a JSON file"),
    ],
)
def test_bad_options(change: dict[str, Any], message: str) -> None:
    """Each wrong option is named before anything is started."""
    with pytest.raises(ConfigError, match=message):
        from_mapping(CompareConfig, {"trees": ["a"], "out": "b"} | change)


def test_no_hours_in_the_interpreter() -> None:
    """Without a GPU the paper's sizes are refused, and what the fast path does not compute everywhere."""
    asked = {"trees": ["."], "out": "b", "device": "cpu"}
    with pytest.raises(ConfigError, match=r"network.width must be at most 32 without a GPU.*; take a GPU, or cases="):
        main(asked)
    with pytest.raises(
        ConfigError, match=r"cases\[0\] must be of at most 200 particles without a GPU.* got 'update_8'"
    ):
        main(asked | {"network": {"width": 16}})
    with pytest.raises(ConfigError, match=r"network must be one that the fast path computes, .*width must be one of"):
        main(asked | {"network": {"width": 24}})


def test_profiles_by_default() -> None:
    """An update of 32 scenes, where it is asked for."""
    assert CompareConfig(("a",), "b").profiled == ("update_32",)
    assert CompareConfig(("a",), "b", ("frame_20",)).profiled == ()
