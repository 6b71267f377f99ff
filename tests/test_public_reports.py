"""Kinds of reports that users of tools like this one publish, on configuration files, names and streams."""

import io
import sys

import pytest

from hgn.command import run_command

HEAD = "# @package _global_\n"


@pytest.fixture
def command(monkeypatch, capsys):
    """Runs a command that only returns; its exit code, its configuration and its errors."""

    def run(name, *arguments):
        given = []
        monkeypatch.setattr("sys.argv", [name, *arguments])
        with pytest.raises(SystemExit) as ended:
            run_command(given.append, name)
        return ended.value.code, given, capsys.readouterr().err

    return run


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (HEAD + "name: x\nseed: [1\n", "must be a YAML file: line 4"),
        (HEAD + "training:\n\tseed: 1\n", "must be a YAML file: line 3"),
        (HEAD + "name: 'x\n", "must be a YAML file: line"),
        (HEAD + "training: {seed: 1}\nname: x\ntraining: {seed: 2}\n", "line 4: the key training is given twice"),
        (HEAD + "training:\n  batch_scenes: 010\n", "line 3: batch_scenes: 010 is an octal number"),
        (HEAD + "scene:\n  group_size: 1:30\n", "line 3: group_size: 1:30 is a number of base 60"),
        ("\ufeff" + HEAD + "name: x\n", "must be UTF-8 without a byte order mark"),
    ],
)
def test_experiments_with_bad_yaml(tmp_path, command, content, message):
    """One line with the file, the key and the line, and exit code 2; with Hydra's options too."""
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text(content, encoding="utf-8")
    for more in ((), ("--cfg", "job")):
        code, _, error = command("train", f"--config-dir={tmp_path}", "experiment=mine", *more)
        assert code == 2 and error.count("\n") == 1 and "mine.yaml" in error and message in error
    code, _, error = command("train", "--config-dir", str(tmp_path), "+experiment=mine")
    assert code == 2 and message in error


def test_groups_and_included_files(tmp_path, command):
    """A file of a group is read as strictly; one that an experiment includes ends in one line too."""
    for folder in ("experiment", "scene"):
        (tmp_path / folder).mkdir()
    (tmp_path / "scene" / "own.yaml").write_text("group_size: 0.1\ngroup_size: 0.2\n")
    (tmp_path / "experiment" / "outer.yaml").write_text(HEAD + "defaults:\n  - inner\n")
    (tmp_path / "experiment" / "inner.yaml").write_text(HEAD + "name: [x\n")
    for choice in ("scene=own", "experiment=outer"):
        code, _, error = command("train", f"--config-dir={tmp_path}", choice)
        assert code == 2 and error.count("\n") == 1 and ("own.yaml" in error or "inner.yaml" in error)


def test_overrides_that_remove(command, capsys):
    """`~training` is an override, wherever options stand."""
    for arguments in (("~training", "--cfg", "job"), ("--cfg", "job", "~training")):
        code, _, error = command("train", *arguments)
        assert code == 0 and error == ""


@pytest.mark.parametrize("name", ["[x].yaml", "a${b}.yaml", "{y}.yaml", "it's [1].yaml", "plain.yaml"])
def test_names_that_are_syntax(tmp_path, command, monkeypatch, name):
    """Files are found under names that Hydra takes for lists and references."""
    (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    code, given, error = command("rollout", f"scene={name}")
    assert (code, error) == (0, "") and given[0]["scene"] == name


@pytest.mark.parametrize(("encoding", "shown"), [("ascii", b"64? ?"), ("latin-1", b"64\xb3 ?"), ("utf-8", None)])
def test_outputs_without_unicode(monkeypatch, encoding, shown):
    """What an output cannot show is replaced."""
    raw = io.BytesIO()
    monkeypatch.setattr("sys.argv", ["bench"])
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding=encoding))
    with pytest.raises(SystemExit) as ended:
        run_command(lambda mapping: print("64³ …"), "bench")
    assert ended.value.code == 0 and raw.getvalue().strip() == (shown or "64³ …".encode())
