"""Tests what all commands have in common: reading of settings and their files, and output."""

import errno
import io
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hgn import hydra_compat
from hgn.command import EXIT_UNREAD, _compose, run_command
from hgn.schema import ConfigError
from hgn.system.files import make_folder, temporary_file, write_json

HEAD = "# @package _global_\n"


@pytest.fixture
def command(monkeypatch, capsys):
    """Runs a command that only returns; its exit code, its configuration and its errors."""

    def run(name, *arguments, main=None):
        given = []
        monkeypatch.setattr("sys.argv", [name, *arguments])
        with pytest.raises(SystemExit) as ended:
            run_command(main or given.append, name)
        return ended.value.code, given, capsys.readouterr().err

    return run


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        *((name, name) for name in ("../my data/dé mo", "weights (1).safetensors", "a&b#1!;x=y", "it's", "plain")),
        *((name, name) for name in ("data(1)", "ends in \\", "ü\\", "ü\\'")),  # the first is a function to Hydra
        ("~/runs/ü", f"{Path.home()}/runs/ü"),
        ("'ü'", "ü"),
    ],
)
def test_names_that_hydra_refuses(given, meant, monkeypatch):
    """Names of files and folders may contain characters of Hydra's syntax. Other arguments are read as usual."""
    monkeypatch.setattr("sys.argv", ["error_vs_time", f"data={given}", "out=x", "weights=null", "mpm_steps=[0.1]"])
    (composed,) = _compose("error_vs_time")
    assert composed["data"] == meant and composed["weights"] is None and composed["mpm_steps"] == [0.1]


def test_names_in_lists(monkeypatch):
    """Each name of a list is taken by itself; what is no name is refused."""
    monkeypatch.setattr("sys.argv", ["error_vs_time", "data=d", "weights=[a, dé mo (1),3]", "out=ü", "+new=[x&y]"])
    (composed,) = _compose("error_vs_time")
    assert (composed["weights"], composed["out"], composed["new"]) == (["a", "dé mo (1)", 3], "ü", ["x&y"])
    monkeypatch.setattr("sys.argv", ["error_vs_time", "data=d", "weights=[a,{ü]", "out=x"])
    with pytest.raises(ConfigError, match="weights="):
        _compose("error_vs_time")
    names = [f"network_{number}.safetensors" for number in range(400)]  # longer than the name of a file may be
    monkeypatch.setattr("sys.argv", ["error_vs_time", "data=d", f"weights=[{','.join(names)}]", "out=x"])
    (composed,) = _compose("error_vs_time")
    assert composed["weights"] == names


@pytest.mark.parametrize(
    "name", ["[x].yaml", "a${b}.yaml", "{y}.yaml", "it's [1].yaml", "plain.yaml", "a$b.yaml", "a,b.yaml", "'a'.yaml"]
)
def test_names_that_are_syntax(tmp_path, command, monkeypatch, name):
    """Files are found under names that Hydra takes for lists and references."""
    (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    code, given, error = command("rollout", f"scene={name}")
    assert (code, error) == (0, "") and given[0]["scene"] == name


WAYS = [
    ("mine", ["experiment=mine.yaml"]), ("mine", ["+experiment=[mine]"]), ("mine", ["+experiment='mine'"]),
    ("mine", ["hydra.searchpath=[file://{}]", "+experiment=mine"]), ("../own", ["--config-name=own"]),
    ("../scene/own", ["+experiment=outer"]),
]  # fmt: skip


@pytest.mark.parametrize(("file", "arguments"), WAYS)
@pytest.mark.parametrize("content", ["training: {seed: 010}\n", "- 1\n", "training: {seed: 1, seed: 2}\n"])
def test_other_ways_to_choose_files(tmp_path, command, file, arguments, content):
    """Files are read as strictly however they are chosen: in lists, by defaults, from other folders."""
    for folder in ("experiment", "scene"):
        (tmp_path / folder).mkdir()
    (tmp_path / "experiment" / "outer.yaml").write_text(HEAD + "defaults:\n  - override /scene: own\n")
    (tmp_path / "experiment" / f"{file}.yaml").write_text(content)
    given = [argument.format(tmp_path) for argument in arguments]
    code, _, error = command("train", *([] if "searchpath" in given[0] else [f"--config-dir={tmp_path}"]), *given)
    assert code == 2 and error.count("\n") == 1 and f"{file[-4:].strip('/')}.yaml must be a" in error


@pytest.mark.parametrize("form", [["--config-dir", "folder"], ["--config-dir=folder"], ["-cd=folder"]])
def test_missing_folders_of_configurations(tmp_path, monkeypatch, command, form):
    """One line with the option, the rule and the folder."""
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    for name in ("nothere", "file"):
        code, _, error = command("train", *(part.replace("folder", name) for part in form))
        assert (code, error) == (2, f"error: --config-dir must be an existing folder, got '{name}'\n")


def test_loops_of_defaults(tmp_path, command):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text(HEAD + "defaults: [mine]\n")
    code, _, error = command("train", f"--config-dir={tmp_path}", "experiment=mine")
    assert (code, error) == (2, "error: defaults must not refer back to the same file, got a cycle\n")


@pytest.mark.parametrize(
    ("streams", "main", "code"),
    [
        (["stdout"], "print(1)", 1),
        (["stderr"], "print(1, file=sys.stderr, flush=True)", 0),
        (["stderr"], "print(1, file=sys.stderr) or 3", 3),
        (["stderr"], "require(False, 'a', 'b', 1)", 2),
        (["stderr"], "bar('x', total=1, unit='y').close()", 0),
        (["stderr"], "warnings.warn('x')", 0),
        (["stdout", "stderr"], "print(1)", 1),
    ],
)
def test_full_disk_of_the_output(streams, main, code):
    """The end of a command whose output cannot be written is a line too; lost messages change no exit code."""
    program = (
        "import sys, warnings; from hgn.command import run_command, require; from hgn.system.progress import bar\n"
    )
    program += f"run_command(lambda _: {main}, 'rollout')"
    with Path("/dev/full").open("w") as full:
        environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
        given: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | dict.fromkeys(streams, full)
        done = subprocess.run([sys.executable, "-c", program], text=True, env=environment, check=False, **given)
    assert done.returncode == code and not done.stdout
    if "stderr" not in streams:
        assert done.stderr.lower().startswith("error: no space left on") and done.stderr.count("\n") == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("passed_on", [True, False])
def test_signals(tmp_path, command, number, passed_on):
    """Each command ends on a signal as on Ctrl-C: with a line and its exit code, and without temporary files. The code
    does not depend on libraries, some of which raise an interruption of their own in place of ours. More signals, as
    terminals and services send them, do not interrupt what it still writes."""

    def interrupted(_):
        with temporary_file(tmp_path / "a") as temporary:
            temporary.touch()
            try:
                signal.raise_signal(number)
            except KeyboardInterrupt as interruption:
                for later in (signal.SIGTERM, signal.SIGHUP, signal.SIGHUP):
                    signal.raise_signal(later)
                (tmp_path / "kept").touch()
                raise interruption if passed_on else KeyboardInterrupt from None

    outer = signal.signal(signal.SIGINT, signal.default_int_handler)  # which shells ignore in the background
    before = signal.getsignal(number)
    code, _, error = command("bench", main=interrupted)
    assert (code, error) == (128 + number, "error: interrupted\n") and [*tmp_path.iterdir()] == [tmp_path / "kept"]
    assert signal.getsignal(number) is before
    signal.signal(signal.SIGINT, outer)


def test_signals_while_settings_are_read(command, monkeypatch):
    """They end the command as later ones do. Hydra and OmegaConf report an interruption as an error of a setting."""
    compose = hydra_compat.compose

    def interrupted(*arguments):
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt as interruption:
            raise ConfigError("settings must follow Hydra's syntax") from interruption
        return compose(*arguments)

    monkeypatch.setattr(hydra_compat, "compose", interrupted)
    assert command("bench") == (143, [], "error: interrupted\n")


@pytest.mark.parametrize("place", ["pipe", "pipe/a/b", "/dev/null", "/dev/null/a", "link"])
@pytest.mark.parametrize("write", [make_folder, Path.mkdir, lambda path: write_json(path / "x", 1), os.listdir])
def test_pipes_and_devices_in_place_of_folders(tmp_path, command, monkeypatch, place, write):
    """They are invalid input (exit code 2) in one line, whichever setting names them."""
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("link").symlink_to("pipe")
    code, _, error = command("train", main=lambda _: write(Path(place)))
    assert code == 2 and error.startswith("error: ") and place.split("/a")[0] in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("value", "write", "seen"),
    [
        ("file", Path.mkdir, "'file': File exists"),
        ("file/a/b", make_folder, "'file/a/b': "),
        ("file", os.listdir, "'file': Not a directory"),
        ("folder", Path.read_text, "'folder': Is a directory"),
        ("folder/../file/x", lambda path: make_folder(path.absolute()), "'folder/../file/x': "),
        ("..", Path.read_text, "'..': Is a directory"),
    ],
)
def test_paths_of_another_kind(tmp_path, command, monkeypatch, value, write, seen):
    """A file in place of a folder, or the reverse, is invalid input (exit code 2); the line names its setting."""
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    Path("folder").mkdir()
    code, _, error = command("train", f"dataset.folder={value}", "run=.", main=lambda _: write(Path(value)))
    assert code == 2 and error.startswith(f"error: dataset.folder must be another path, got {seen}"), error
    code, _, error = command("train", main=lambda _: Path("file").mkdir())
    assert code == 2 and error == "error: File exists: file; choose another path and run the same command again\n"


def test_paths_without_a_name(command):
    """An error that has no path names no setting."""

    def read(_):
        raise IsADirectoryError(errno.EISDIR, "Is a directory")

    code, _, error = command("train", "run=.", main=read)
    assert code == 2 and error == "error: Is a directory; choose another path and run the same command again\n"


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


@pytest.mark.parametrize("head", ["", "# mine\n" + HEAD])
def test_experiments_without_a_package(tmp_path, command, head):
    """The key that Hydra puts such a file under is not the user's mistake: the line that is missing is named."""
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text(head + "training: {seed: 1}\n")
    code, _, error = command("train", f"--config-dir={tmp_path}", "experiment=mine")
    assert code == 2 and "must begin with the line '# @package _global_'" in error and error.count("\n") == 1


@pytest.mark.parametrize("name", ["yes", "2024", "1e3", "null", "[a]", "{a: 1}", "''"])
def test_names_of_trainings(tmp_path, command, name):
    """A name that YAML does not read as text is refused as the name of a folder."""
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text(f"{HEAD}name: {name}\n")
    given = (f"--config-dir={tmp_path}", "experiment=mine", "training.devices=0")  # refused after the name
    code, _, error = command("train", *given, main="hgn.train")
    assert code == 2 and error.startswith("error: name must be text, got ") and error.count("\n") == 1


def test_groups_and_included_files(tmp_path, command):
    """A file of a group is read as strictly; one that an experiment includes ends in one line too. `~training` is
    refused, wherever options stand."""
    for folder in ("experiment", "scene"):
        (tmp_path / folder).mkdir()
    (tmp_path / "scene" / "own.yaml").write_text("group_size: 0.1\ngroup_size: 0.2\n")
    (tmp_path / "experiment" / "outer.yaml").write_text(HEAD + "defaults:\n  - inner\n")
    (tmp_path / "experiment" / "inner.yaml").write_text(HEAD + "name: [x\n")
    for choice in ("scene=own", "experiment=outer"):
        code, _, error = command("train", f"--config-dir={tmp_path}", choice)
        assert code == 2 and error.count("\n") == 1 and ("own.yaml" in error or "inner.yaml" in error)
    for arguments in (("~training", "--cfg", "job"), ("--cfg", "job", "~training")):
        code, _, error = command("train", *arguments)
        assert code == 2 and error.startswith("error: training must be kept, got '~training'; ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(
            (arguments, "Hydra's options must have the form --cfg job, got argument --cfg/-c: ")
            for arguments in (["--cfg", "foo"], ["--cfg=foo"], ["-c", ""], ["--cfg"], ["--cfg", "job", "--cfg"])
        ),
        (["--info", "foo"], "got argument --info/-i: invalid choice: 'foo'"),
        (["--cfg", "job", "--package"], "got argument --package/-p: expected one argument"),
        (["--config-name"], "got argument --config-name/-cn: expected one argument"),
        (["--resolve=3"], "got argument --resolve: ignored explicit argument '3'"),
        (["frames=3", "--cfg", "job", "seed=4"], "settings must be consecutive, got seed=4 separately"),
        (["hydra.job.env_copy=[NONE]"], "follow Hydra's syntax, got hydra.job.env_copy=[NONE] (KeyError: 'NONE')"),
        (["hydra.searchpath=[file:///none]"], "path=/none is not available"),
        (["--experimental-rerun=x"], "Experimental rerun CLI option, other command line args are ignored"),
        (["--cfg", "job", "--package", "none"], "package 'none' not found in config"),
    ],
)
def test_wrong_values_of_hydras_options(command, arguments, message):
    """One line without Hydra's page about its options."""
    code, given, error = command("rollout", *arguments)
    assert code == 2 and not given and message in error and error.count("\n") == 1


@pytest.mark.parametrize(("encoding", "shown"), [("ascii", b"64? ??"), ("latin-1", b"64\xb3 ??"), ("utf-8", None)])
def test_outputs_without_unicode(command, monkeypatch, encoding, shown):
    """Characters that an output cannot show are replaced, also those of a path that is not UTF-8."""
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding=encoding))
    assert command("bench", main=lambda mapping: print("64³ …\udcff"))[0] == 0
    assert raw.getvalue().strip() == (shown or "64³ …?".encode())


@pytest.mark.parametrize(
    "arguments",
    [
        ["hgn.export", "--help"],  # printed by the command
        ["hgn.train", "--help"],  # by Hydra
        ["hgn.export", "checkpoint="],  # an error, to where nobody reads
    ],
)
def test_a_reader_that_leaves(warm_python, arguments):
    """As in `… | head`: the command ends with an exit code of its own, and without a traceback."""
    read, write = os.pipe()
    os.close(read)
    error = write if arguments[1] != "--help" else subprocess.PIPE
    ended = subprocess.run([str(warm_python), "-m", *arguments], stdout=write, stderr=error, text=True)
    os.close(write)
    assert ended.returncode == EXIT_UNREAD and not ended.stderr


def test_nothing_is_open():
    """A command that is started without standard output and error does its work."""
    program = "import sys; from hgn.command import run_command; from hgn.system.progress import bar"
    program += "; sys.argv[1:] = []; run_command(lambda mapping: bar('x', total=1, unit='y').close(), 'bench')"
    command = ["bash", "-c", 'exec "$0" -c "$1" >&- 2>&-', sys.executable, program]
    assert subprocess.run(command, check=False).returncode == 0


def test_the_end_of_a_command():
    """A command ends without a search for garbage, which takes long among PyTorch's modules."""
    program = "import sys; from hgn.command import run_command\nclass Garbage:\n"
    program += "  def __init__(self): self.own = self\n  def __del__(self): print('found')\n"
    program += "sys.argv[1:] = []; run_command(lambda _: Garbage() and None, 'bench')"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    ended = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert ended.stdout == ""


def test_other_broken_pipes_are_faults(monkeypatch):
    """Broken pipes to a process or a server of the command are errors and are reported."""

    def talks(mapping):
        raise BrokenPipeError("the server")

    monkeypatch.setattr("sys.argv", ["bench"])
    with Path(os.devnull).open("w") as out:
        monkeypatch.setattr("sys.stdout", out)
        monkeypatch.setattr("sys.stderr", out)
        with pytest.raises(BrokenPipeError, match="the server"):
            run_command(talks, "bench")
