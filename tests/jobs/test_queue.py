"""The queue of one machine: its GPUs share a list, barriers hold, it stops and goes on; and the lists of networks."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from processes import PATIENCE_S, completed, processes_of_session, wait_until, write_program

from datagen.generate import datagen_config
from hgn.average import AverageConfig
from hgn.command import _compose
from hgn.config import DatagenConfig, TrainConfig
from hgn.data.identity import dataset_identity
from hgn.evaluate import EvaluateConfig
from hgn.export import ExportConfig
from hgn.runtime.weights import load_weights, shipped_weights
from hgn.schema import from_mapping
from tools.error_vs_time.settings import ErrorVsTimeConfig
from tools.stability.network import StabilityNetworkConfig

JOBS = Path(__file__).resolve().parents[2] / "jobs"
# the arguments of each call, as a line of JSON; succeeds
PYTHON = f"""#!{sys.executable}
import json, sys
print(json.dumps(sys.argv[1:]))
"""


def start(folder, text, *arguments, **variables):
    """Starts the queue in a folder, on a list or its text, where nvidia-smi is what write_program made of it."""
    if isinstance(text, str):
        (folder / "list.txt").write_text(text)
        text = Path("list.txt")
    other = ("CUDA_VISIBLE_DEVICES", "SCENES", "SHARE")
    kept = {name: value for name, value in os.environ.items() if name not in other}
    return subprocess.Popen(
        [str(JOBS / "queue.sh"), str(text), *arguments],
        cwd=folder,
        env=kept | {"PATH": f"{folder / 'programs'}:{os.environ['PATH']}"} | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def run(folder, text, *arguments, **variables):
    return completed(start(folder, text, *arguments, **variables))


@pytest.fixture
def machine(tmp_path):
    """A folder on a machine with two GPUs."""
    write_program(tmp_path / "programs" / "nvidia-smi", "#!/usr/bin/env bash\nprintf '0\\n1\\n'\n")
    return tmp_path


def events(output):
    """(GPU, name, what) of each line about a command; what is `begin` or `end, exit code N`."""
    told = [line.split("  ") for line in output.splitlines() if "  GPU " in line]
    return [(gpu.removeprefix("GPU "), name, what.rpartition(", ")[0] or what) for _, gpu, name, what in told]


def test_gpus_share_a_list(machine):
    """Each GPU runs one command at a time, which sees that GPU alone; behind a barrier all before it is done."""
    meet = "touch {0}; until [[ -e {1} ]]; do sleep 0.02; done; echo $CUDA_VISIBLE_DEVICES"  # both at once, or never
    lines = [
        f"first: {meet.format('a', 'b')}",
        "# a comment",
        "",
        f"  second:   {meet.format('b', 'a')} ",
        "third: echo words >&2; sleep 0.2; touch third",
        "wait",
        "fourth: [[ -e third ]] && echo $CUDA_VISIBLE_DEVICES",
        "wait",
    ]
    done = run(machine, "\n".join(lines))
    assert (done.returncode, done.stderr) == (0, "")
    said = done.stdout.splitlines()
    assert said[0] == "4 commands, GPUs: 0 1, logs in runs/queue" and said[-1] == "all 4 commands are done"
    begun = {name: gpu for gpu, name, what in events(done.stdout) if what == "begin"}
    assert sorted(begun) == ["first", "fourth", "second", "third"] and {begun["first"], begun["second"]} == {"0", "1"}
    assert sorted(events(done.stdout)) == sorted(
        (gpu, name, what) for name, gpu in begun.items() for what in ("begin", "end, exit code 0")
    )
    logs = machine / "runs" / "queue"
    assert {name: (logs / f"{name}.log").read_text().strip() for name in begun} == begun | {"third": "words"}
    assert {path.stem for path in logs.glob("*.done")} == set(begun)


@pytest.mark.parametrize(
    ("visible", "gpus"), [("5", ["5"]), ("GPU-8a,MIG-1", ["GPU-8a", "MIG-1"]), ("3, 2,7", ["3", "2", "7"])]
)
def test_visible_gpus(tmp_path, visible, gpus):
    """CUDA_VISIBLE_DEVICES says which GPUs there are; nvidia-smi is not asked."""
    write_program(tmp_path / "programs" / "nvidia-smi", "#!/usr/bin/env bash\ntouch asked; exit 1\n")
    count = len(gpus)
    text = "".join(
        f"{i}: touch {i}; until [[ $(ls ? | wc -l) == {count} ]]; do sleep 0.02; done; echo $CUDA_VISIBLE_DEVICES\n"
        for i in range(count)
    )
    done = run(tmp_path, text, "logs", CUDA_VISIBLE_DEVICES=visible)
    assert done.returncode == 0 and not (tmp_path / "asked").exists()
    seen = [(tmp_path / "logs" / f"{i}.log").read_text().strip() for i in range(count)]
    assert sorted(seen) == sorted(gpus)


def test_without_gpus(machine):
    """Without GPUs one command runs after the other, in the order of the list."""
    done = run(machine, "b: echo b >> order\na: echo a >> order\nc: echo c >> order\n", CUDA_VISIBLE_DEVICES="")
    assert done.returncode == 0 and (machine / "order").read_text() == "b\na\nc\n"
    assert done.stdout.startswith("3 commands, GPUs: cpu, logs in runs/queue\n")


def test_nvidia_smi_that_fails_is_told(tmp_path):
    """A driver at fault is no machine without GPUs."""
    write_program(tmp_path / "programs" / "nvidia-smi", "#!/usr/bin/env bash\necho 'no driver'\nexit 9\n")
    done = run(tmp_path, "a: touch a\n")
    assert done.returncode == 2 and not (tmp_path / "a").exists()
    assert done.stderr == (
        "error: nvidia-smi must list the GPUs, got 'no driver'; say which there are, as in CUDA_VISIBLE_DEVICES=0,1, "
        "or that there are none, CUDA_VISIBLE_DEVICES=\n"
    )


def test_failing_and_going_on(machine):
    """A command that fails stops no other before the barrier, and all behind it. The same call runs what is not done,
    and that alone; a third finds nothing to do."""
    lines = [
        "good: echo good >> ran",
        "bad: echo bad >> ran; [[ -e mended ]]",
        "other: echo other >> ran",
        "wait",
        "behind: echo behind >> ran",
    ]
    text = "\n".join(lines)
    done = run(machine, text)
    told = [what for _, name, what in events(done.stdout) if name == "bad"]
    assert done.returncode == 1 and "end, exit code 1" in told
    assert done.stdout.splitlines()[-1] == (
        "failed: bad; see runs/queue/NAME.log. Not begun, behind the barrier: behind; the same call goes on"
    )
    assert sorted((machine / "ran").read_text().split()) == ["bad", "good", "other"]

    (machine / "mended").touch()
    (machine / "ran").unlink()
    done = run(machine, text)
    assert done.returncode == 0 and (machine / "ran").read_text().split() == ["bad", "behind"]

    done = run(machine, text)
    assert done.returncode == 0 and events(done.stdout) == []
    assert (machine / "ran").read_text().split() == ["bad", "behind"]


def test_done_with_other_variables_is_refused(machine):
    """What a trial has done is not taken for the real thing: the variables of a command belong to it, no others do."""
    text = "a: echo $((100 * ${SHARE:-100})) >> ran\n"
    assert run(machine, text, SHARE="1").returncode == 0
    assert run(machine, text, SHARE="1", SCENES="3", CUDA_VISIBLE_DEVICES="7").returncode == 0
    done = run(machine, text)
    assert done.returncode == 2 and (machine / "ran").read_text() == "100\n"
    assert done.stderr == (
        "error: runs/queue/a.done must be of the command in list.txt, with the same variables, got another; "
        "work in another folder, or remove the file to run the command\n"
    )
    assert run(machine, text.replace("100", "200"), SHARE="1").returncode == 2
    (machine / "runs" / "queue" / "a.done").unlink()
    assert run(machine, text).returncode == 0


# ends on SIGTERM, a moment later, with a file; tells its session
TRAINING = """#!/usr/bin/env bash
trap 'sleep 0.3; echo state > "$1"; exit 143' TERM
cut -d' ' -f6 /proc/$$/stat > "$1.session"
while true; do sleep 0.02; done
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_signals_reach_the_commands(machine, number):
    """Commands get SIGTERM, and what they still have to write is waited for, in pipes and in the background too; their
    lines do not go on, no other line begins, and the same call goes on with all of them."""
    write_program(machine / "programs" / "training", TRAINING)
    lines = [
        "a: [[ -e quick ]] || training a; [[ -e quick ]] || touch went_on",
        "b: [[ -e quick ]] || { (training b; true) | cat & wait; }",
        *("c: touch c", "wait", "d: touch d"),
    ]
    text = "\n".join(lines)
    process = start(machine, text)
    sessions = [machine / f"{name}.session" for name in ("a", "b")]
    wait_until(lambda: all(path.exists() and path.read_text() for path in sessions))
    (os.kill if number == signal.SIGTERM else os.killpg)(process.pid, number)  # a terminal's go to the whole group
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, errors) == (128 + number, "")
    assert (machine / "a").read_text() == (machine / "b").read_text() == "state\n"
    assert not any((machine / name).exists() for name in ("went_on", "c", "d"))
    assert output.splitlines()[-1] == f"stopped by {number.name}; not done: a b c d; the same call goes on"
    for path in sessions:
        assert processes_of_session(int(path.read_text())) == []

    (machine / "quick").touch()
    assert run(machine, text).returncode == 0 and (machine / "d").exists()


def test_nothing_is_left_behind(machine):
    """What a command leaves running is ended before its GPU takes the next one."""
    write_program(machine / "programs" / "training", TRAINING)
    text = "a: training a & until [[ -s a.session ]]; do sleep 0.02; done\nb: cat a\n"
    assert run(machine, text, CUDA_VISIBLE_DEVICES="0").returncode == 0
    assert (machine / "runs" / "queue" / "b.log").read_text() == "state\n"


def test_one_queue_a_folder(machine):
    """A second queue in the same folder is refused while the first works."""
    text = "a: touch a; until [[ -e end ]]; do sleep 0.02; done\n"
    first = start(machine, text)
    wait_until((machine / "a").exists)
    second = run(machine, text)
    assert second.returncode == 2
    assert second.stderr.startswith("error: FOLDER must be one that no other queue works in, got 'runs/queue'; ")
    (machine / "end").touch()
    first.communicate(timeout=PATIENCE_S)
    assert first.returncode == 0


LINE_RULE = "a line must be NAME: COMMAND (letters, digits, _ . -) or wait"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("echo 1", f"{LINE_RULE}, got 'echo 1'; as in"),
        ("a b: echo 1", f"{LINE_RULE}, got 'a b: echo 1'"),
        ("../a: echo 1", f"{LINE_RULE}, got '../a:"),
        ("a:", f"{LINE_RULE}, got 'a:'; as in first: echo 1"),
        ("wait for all", f"{LINE_RULE}, got 'wait for all'"),
        ("one: echo 2", "names must differ, got 'one' as in line 2; give it another"),
        ("a: echo 'b", "the command of 'a' must be one that bash can read, got 'echo 'b'; mend it: "),
    ],
)
def test_faulty_lines_are_refused(machine, line, message):
    """File, line, rule and remedy are told before anything begins."""
    done = run(machine, f"# list\none: touch began\n{line}\n")
    assert done.returncode == 2 and done.stderr.startswith(f"error: list.txt:3: {message}")
    assert done.stderr.count("\n") == 1
    assert done.stdout == "" and not (machine / "began").exists() and not (machine / "runs").exists()


def test_lists_are_refused(machine):
    """So are a list that is not there, one without commands, and a call without any."""
    missing = run(machine, Path("none.txt"))
    assert missing.returncode == 2
    assert missing.stderr == (
        "error: LIST must be a file that can be read, got 'none.txt'; as in jobs/queue.sh jobs/networks.txt\n"
    )
    empty = run(machine, "# nothing\nwait\n")
    assert empty.returncode == 2
    assert empty.stderr == "error: list.txt must have a line NAME: COMMAND, got none; add one, as in first: echo 1\n"
    usage = subprocess.run([str(JOBS / "queue.sh")], capture_output=True, text=True)
    assert usage.returncode == 2 and usage.stderr.startswith("usage: jobs/queue.sh LIST [FOLDER]")


def calls(machine, file, **variables):
    """The modules that each line of a list in jobs runs, with their arguments, in the order of the lines."""
    write_program(machine / "programs" / "python", PYTHON)
    done = run(machine, JOBS / file, CUDA_VISIBLE_DEVICES="", **variables)
    assert done.returncode == 0, done.stderr
    names = [name for _, name, what in events(done.stdout) if what == "begin"]
    logs = {name: (machine / "runs" / "queue" / f"{name}.log").read_text().splitlines() for name in names}
    made = {name: [json.loads(line) for line in lines] for name, lines in logs.items()}
    assert all(call[0] == "-m" for lines in made.values() for call in lines)
    return {name: [call[1:] for call in lines] for name, lines in made.items()}


def settings(lines, monkeypatch):
    """What each module of a line is given, by its name."""
    mappings: dict[str, dict[str, Any]] = {}
    for module, *arguments in lines:
        command = module.rpartition(".")[2]
        if command == "stability":
            command += f"_{arguments.pop(0)}"
        monkeypatch.setattr("sys.argv", [module, *arguments])
        (mappings[module],) = _compose(command)
    return mappings


def trained_and_scored(name, mappings, data):
    """A line that trains a network on data made before, exports it and scores it."""
    assert list(mappings) == ["hgn.train", "hgn.export", "hgn.evaluate"]
    mappings["hgn.train"].pop("name")
    config = from_mapping(TrainConfig, mappings["hgn.train"])
    precision = "fp16" if config.network.kind == "hgn" else "tf32"
    assert config.run == f"runs/{name}" and config.training.precision == precision
    made = data[config.dataset.folder]
    assert config.dataset.training_scenes == made.dataset.training_scenes
    assert dataset_identity(config.datagen) == dataset_identity(made)
    assert made.scene.obstacle_count > 0 or not config.network.obstacle_features
    export = from_mapping(ExportConfig, mappings["hgn.export"])
    assert (export.checkpoint, export.stored_precision) == (f"runs/{name}/checkpoints/last.ckpt", "fp16")
    score = from_mapping(EvaluateConfig, mappings["hgn.evaluate"])
    assert score.weights == export.out
    assert (score.split, score.scenes, score.frame_stride, score.precision) == ("test", 20, 5, precision)
    return config, score


def test_networks(tmp_path, monkeypatch):
    """jobs/networks.txt: each command's settings compose to a valid configuration; each network is trained on data that
    an earlier line makes, exported, and scored on the same data; all shipped networks are among them; reports take
    what was exported."""
    data: dict[str, DatagenConfig] = {}
    exported: dict[str, str] = {}  # weights to data
    reported: set[str] = set()
    for name, lines in calls(tmp_path, "networks.txt").items():
        mappings = settings(lines, monkeypatch)
        if list(mappings) == ["datagen"]:
            made = datagen_config(mappings["datagen"])
            data[made.dataset.folder] = made
        elif list(mappings) == ["tools.error_vs_time"]:
            report = from_mapping(ErrorVsTimeConfig, mappings["tools.error_vs_time"])
            assert report.weights is not None
            assert set(report.weights) == {file for file, folder in exported.items() if folder == report.data}
            reported |= set(report.weights)
        else:
            config, score = trained_and_scored(name, mappings, data)
            assert config.dataset.training_scenes == 800 and score.data == config.dataset.folder
            exported[score.weights] = score.data
    assert reported == set(exported)
    assert set(shipped_weights()) - {"mechanics"} <= {Path(file).stem for file in exported}


def test_mechanics(tmp_path, monkeypatch):
    """jobs/mechanics.txt: seven trainings, each from weights that the one before exports, on data that it makes; the
    last one is the network that ships, with its updates, rest and walls, and is scored. The repeats of the fourth,
    which is scored too, differ in name and seed alone."""
    mappings = {name: settings(lines, monkeypatch) for name, lines in calls(tmp_path, "mechanics.txt").items()}
    made = [datagen_config(mappings.pop(name)["datagen"]) for name in list(mappings) if name.endswith("_data")]
    folders = {each.dataset.folder: each for each in made}
    repeated = ["fourth", "repeat_2", "repeat_3"]
    begins_with = {"first": None, "second": "first", "third": "second"} | dict.fromkeys(repeated, "third")
    begins_with |= {"fifth": "fourth", "sixth": "fifth", "mechanics": "sixth"}
    assert list(mappings) == list(begins_with)
    trained, exported = {}, {}
    for name, commands in mappings.items():
        assert commands["hgn.train"].pop("name") == "mechanics"
        config = trained[name] = from_mapping(TrainConfig, commands["hgn.train"])
        export = exported[name] = from_mapping(ExportConfig, commands["hgn.export"])
        assert config.run == f"runs/{name}" and export.checkpoint == f"runs/{name}/checkpoints/last.ckpt"
        assert export.out == f"runs/{name}/{name}.safetensors"
        before = begins_with[name]
        assert config.training.init_weights == (before and exported[before].out)
        assert dataset_identity(config.datagen) == dataset_identity(folders[config.dataset.folder])
        assert set(config.training.more_data) < set(folders)
        assert ("hgn.evaluate" in commands) == (name in (*repeated, "mechanics"))
        if "hgn.evaluate" in commands:
            score = from_mapping(EvaluateConfig, commands["hgn.evaluate"])
            assert (score.weights, score.data) == (export.out, config.dataset.folder)
            assert score.scenes == config.dataset.validation_scenes
    last = trained["mechanics"]
    used = [{each.dataset.folder, *each.training.more_data} for each in trained.values()]
    assert set().union(*used) == set(folders)
    shipped = load_weights(shipped_weights()["mechanics"])[1]
    assert (shipped.network, shipped.step) == (last.network, last.step)
    assert shipped.updates == last.training.maximum_updates
    assert not any(each.step_changes for each in exported.values())
    in_pushforward = {name: each.step.in_training.obstacle_clearance for name, each in trained.items()}
    free = ("first", "second", "third")
    assert in_pushforward == {name: None if name in free else 0.0005 for name in trained}
    repeats, one = [trained[name] for name in repeated], trained["fourth"]
    assert len({each.training.seed for each in repeats}) == 3
    for each in repeats:
        assert replace(each, run=one.run, training=replace(each.training, seed=one.training.seed)) == one


def test_trial_of_mechanics(tmp_path):
    """SCENES and SHARE shorten all data and all trainings."""
    lines = calls(tmp_path, "mechanics.txt", SCENES="2", SHARE="1")
    used = [argument for line in lines.values() for call in line for argument in call]
    scenes = [argument for argument in used if argument.startswith(("scenes=", "dataset.training_scenes="))]
    assert {argument.partition("=")[2] for argument in scenes} == {"2", "25"}  # the last are scored
    updates = [int(argument.partition("=")[2]) for argument in used if argument.startswith("training.maximum_updates")]
    assert len(updates) == 9 and max(updates) < 3000


def test_judged(tmp_path, monkeypatch):
    """jobs/judged.txt trains on both data sets that it makes, judges what it exports by each question, and reports it
    on fresh scenes that are drawn behind it."""
    lines = calls(tmp_path, "judged.txt")
    assert list(lines)[-2:] == ["fresh", "report"]
    mappings = {name: settings(line, monkeypatch) for name, line in lines.items()}
    mappings["judged"]["hgn.train"].pop("name")
    frozen = mappings["fresh"]["datagen"].pop("frozen")
    made = [datagen_config(mappings[name]["datagen"]) for name in ("rest_data", "motion_data", "fresh")]
    config = from_mapping(TrainConfig, mappings["judged"]["hgn.train"])
    weights = from_mapping(ExportConfig, mappings["judged"]["hgn.export"]).out
    assert dataset_identity(config.datagen) == dataset_identity(made[1])
    assert config.training.more_data == (made[0].dataset.folder,) and made[0].mpm == made[1].mpm
    assert frozen == [weights]
    scored = [from_mapping(EvaluateConfig, mappings[name]["hgn.evaluate"]) for name in ("errors_rest", "errors_motion")]
    assert [score.data for score in scored] == [made[0].dataset.folder, config.dataset.folder]
    stability = [from_mapping(StabilityNetworkConfig, mappings[name]["tools.stability"]) for name in ("rest", "flight")]
    assert {score.weights for score in (*scored, *stability)} == {weights}
    report = from_mapping(ErrorVsTimeConfig, mappings["report"]["tools.error_vs_time"])
    assert report.data == made[2].dataset.folder and report.weights is not None and weights in report.weights


def test_pushforward(tmp_path, monkeypatch):
    """jobs/pushforward.txt: it begins with weights that jobs/networks.txt exports; each training goes on from weights
    that are there, on data that an earlier line makes; means are of weights that are there, and the last one ships."""
    data: dict[str, DatagenConfig] = {}
    there = {"runs/obstacles/obstacles.safetensors"}
    trained: set[str] = set()
    for name, lines in calls(tmp_path, "pushforward.txt").items():
        mappings = settings(lines, monkeypatch)
        if list(mappings) == ["datagen"]:
            made = datagen_config(mappings["datagen"])
            data[made.dataset.folder] = made
        elif "hgn.average" in mappings:
            mean = from_mapping(AverageConfig, mappings["hgn.average"])
            assert set(mean.weights) <= there and mean.stored_precision == "fp16"
            there.add(mean.out)
        else:
            config, score = trained_and_scored(name, mappings, data)
            assert config.training.init_weights in there and score.data == "data/obstacles"
            trained.add(config.dataset.folder)
            there.add(score.weights)
    assert trained == set(data) and name == "shipped"
    assert mean.out == from_mapping(EvaluateConfig, mappings["hgn.evaluate"]).weights
    assert Path(mean.out).stem in shipped_weights()


def test_trial_of_pushforward(tmp_path):
    """SCENES and SHARE shorten data and trainings."""
    lines = calls(tmp_path, "pushforward.txt", SCENES="2", SHARE="1")
    used = [argument for line in lines.values() for call in line for argument in call]
    assert {argument for argument in used if "training_scenes" in argument} == {"dataset.training_scenes=2"}
    updates = [int(argument.partition("=")[2]) for argument in used if argument.startswith("training.maximum_updates")]
    assert len(updates) == 5 and max(updates) < 1000


def test_trial_of_networks(tmp_path):
    """SCENES, SHARE and REPORT_SECONDS shorten data, trainings and reports, and change nothing else."""
    (tmp_path / "trial").mkdir()
    whole = calls(tmp_path, "networks.txt")
    trial = calls(tmp_path / "trial", "networks.txt", SCENES="40", SHARE="1", REPORT_SECONDS="60")
    shorter = {f"{key}scenes=800": f"{key}scenes=40" for key in ("", "dataset.training_")}
    shorter |= {f"training.maximum_updates={n}": f"training.maximum_updates={n // 100}" for n in (500_000, 50_000)}
    shorter["seconds=null"] = "seconds=60"
    for name, lines in whole.items():
        assert trial[name] == [[shorter.get(argument, argument) for argument in call] for call in lines]
    assert trial.keys() == whole.keys()
    used = {argument for lines in whole.values() for call in lines for argument in call}
    assert set(shorter) <= used
