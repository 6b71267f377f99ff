"""The queue of one machine: its GPUs share a list, barriers hold, it stops and goes on; and the lists of networks."""

import os
import signal
import subprocess
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from processes import PATIENCE_S, completed, processes_of_session, wait_until, write_program

from datagen.generate import datagen_config
from hgn.config import DatagenConfig, TrainConfig
from hgn.data.identity import dataset_identity
from hgn.evaluate import EvaluateConfig
from hgn.export import ExportConfig
from hgn.runtime.weights import load_weights, shipped_weights
from hgn.schema import from_mapping
from tools.error_vs_time.settings import ErrorVsTimeConfig
from tools.stability.network import StabilityNetworkConfig

JOBS = Path(__file__).resolve().parents[2] / "jobs"


def start(folder, text, *arguments, **variables):
    """Starts the queue in a folder, on a list or its text, where nvidia-smi is what write_program made of it."""
    if isinstance(text, str):
        (folder / "list.txt").write_text(text)
        text = Path("list.txt")
    other = ("CUDA_VISIBLE_DEVICES", "SCENES", "SHARE")
    kept = {name: value for name, value in os.environ.items() if name not in other}
    environment = kept | {"PATH": f"{folder / 'programs'}:{os.environ['PATH']}"} | variables
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    return subprocess.Popen([str(JOBS / "queue.sh"), str(text), *arguments], cwd=folder, env=environment, **pipes)


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
    lines = [f"first: {meet.format('a', 'b')}", "# a comment", "", f"  second:   {meet.format('b', 'a')} "]
    lines += ["third: echo words >&2; sleep 0.2; touch third", "wait"]
    lines += ["fourth: [[ -e third ]] && echo $CUDA_VISIBLE_DEVICES", "wait"]
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


@pytest.mark.parametrize("gpus", [["5"], ["GPU-8a", "MIG-1"], ["3", "2", "7"]])
def test_visible_gpus(tmp_path, gpus):
    """CUDA_VISIBLE_DEVICES determines the GPUs, and nvidia-smi is not called."""
    write_program(tmp_path / "programs" / "nvidia-smi", "#!/usr/bin/env bash\ntouch asked; exit 1\n")
    meet = f"until [[ $(ls ? | wc -l) == {len(gpus)} ]]; do sleep 0.02; done; echo $CUDA_VISIBLE_DEVICES"
    text = "".join(f"{i}: touch {i}; {meet}\n" for i in range(len(gpus)))
    done = run(tmp_path, text, "logs", CUDA_VISIBLE_DEVICES=", ".join(gpus))
    assert done.returncode == 0 and not (tmp_path / "asked").exists()
    assert sorted((tmp_path / "logs" / f"{i}.log").read_text().strip() for i in range(len(gpus))) == sorted(gpus)


def test_without_gpus(machine):
    """Without GPUs one command runs after the other, in the order of the list."""
    done = run(machine, "b: echo b >> order\na: echo a >> order\nc: echo c >> order\n", CUDA_VISIBLE_DEVICES="")
    assert done.returncode == 0 and (machine / "order").read_text() == "b\na\nc\n"
    assert done.stdout.startswith("3 commands, GPUs: cpu, logs in runs/queue\n")


def test_failing_and_going_on(machine):
    """A command that fails stops all commands after the barrier, and none before it. The same call then runs only
    commands that are not done. A third call finds none."""
    text = "good: echo good >> ran\nbad: echo bad >> ran; [[ -e mended ]]\nother: echo other >> ran\n"
    text += "wait\nbehind: echo behind >> ran\n"
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
    """Commands get SIGTERM, and the queue waits for their last output, also of pipes and background processes. Their
    lines do not continue, no other line starts, and the same call resumes all of them."""
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
    """A second queue in the same folder is refused while the first works. Without a list it says how it is called."""
    done = subprocess.run([str(JOBS / "queue.sh")], capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.startswith("usage: jobs/queue.sh LIST [FOLDER]")
    text = "a: touch a; until [[ -e end ]]; do sleep 0.02; done\n"
    first = start(machine, text)
    wait_until((machine / "a").exists)
    second = run(machine, text)
    assert second.returncode == 2
    assert second.stderr.startswith("error: FOLDER must be one that no other queue works in, got 'runs/queue'; ")
    (machine / "end").touch()
    first.communicate(timeout=PATIENCE_S)
    assert first.returncode == 0


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir, lambda path: path.symlink_to("target")])
def test_a_lock_that_is_no_file(machine, make):
    """A pipe, a folder or a link in the place of the lock is refused in one line, and the link's target stays."""
    (machine / "runs" / "queue").mkdir(parents=True)
    lock, target = machine / "runs/queue/.lock", machine / "runs/queue/target"
    target.write_text("mine")
    make(lock)
    done = run(machine, "one: touch began\n")
    assert done.returncode == 2 and not (machine / "began").exists() and target.read_text() == "mine"
    assert done.stderr == "error: runs/queue/.lock must be a file, got a link, pipe, device or folder; delete it\n"


LINE_RULE = "list.txt:3: a line must be NAME: COMMAND (letters, digits, _ . -) or wait"
GPUS = (
    "nvidia-smi must list the GPUs, got 'no driver'; say which there are, as in CUDA_VISIBLE_DEVICES=0,1, or that "
    "there are none, CUDA_VISIBLE_DEVICES=\n"
)
LINES = {  # the third of a list, and what is said of it
    "echo 1": f"{LINE_RULE}, got 'echo 1'; as in",
    "a b: echo 1": f"{LINE_RULE}, got 'a b: echo 1'",
    "../a: echo 1": f"{LINE_RULE}, got '../a:",
    "a:": f"{LINE_RULE}, got 'a:'; as in first: echo 1",
    "wait for all": f"{LINE_RULE}, got 'wait for all'",
    "one: echo 2": "list.txt:3: names must differ, got 'one' as in line 2; give it another",
    "a: echo 'b": "list.txt:3: the command of 'a' must be one that bash can read, got 'echo 'b'; mend it: ",
}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *((f"# list\none: touch began\n{line}\n", message) for line, message in LINES.items()),
        ("# nothing\nwait\n", "list.txt must have a line NAME: COMMAND, got none; add one, as in first: echo 1\n"),
        (Path("none.txt"), "LIST must be a file that can be read, got 'none.txt'; as in jobs/queue.sh jobs/netw"),
        ("one: touch began\n", GPUS),
    ],
)
def test_faulty_lists_are_refused(machine, text, message):
    """File, line, rule and remedy are told before anything begins; a driver at fault is no machine without GPUs."""
    if message == GPUS:
        write_program(machine / "programs" / "nvidia-smi", "#!/usr/bin/env bash\necho 'no driver'\nexit 9\n")
    done = run(machine, text)
    assert (done.returncode, done.stdout) == (2, "") and done.stderr.startswith(f"error: {message}")
    assert done.stderr.count("\n") == 1 and not (machine / "began").exists()
    assert not list((machine / "runs").rglob("*.log"))


def calls(machine, file, **variables):
    """The modules that each line of a list in jobs runs, with their arguments, in the order of the lines."""
    write_program(machine / "programs" / "python", "#!/usr/bin/env bash\nprintf '%s\\x1f' \"$@\"; echo\n")
    done = run(machine, JOBS / file, CUDA_VISIBLE_DEVICES="", **variables)
    assert done.returncode == 0, done.stderr
    names = [name for _, name, what in events(done.stdout) if what == "begin"]
    logs = {name: (machine / "runs" / "queue" / f"{name}.log").read_text().splitlines() for name in names}
    made = {name: [line.split("\x1f")[:-1] for line in lines] for name, lines in logs.items()}
    assert all(call[0] == "-m" for lines in made.values() for call in lines)
    return {name: [call[1:] for call in lines] for name, lines in made.items()}


@pytest.fixture
def listed(tmp_path, composed):
    """What each line of a list gives its modules: their configurations by line and module. An experiment's name, and
    the weights that a fresh set is drawn after, are no settings."""

    def settings(file):
        lines: dict[str, dict[str, Any]] = {}
        for name, modules in calls(tmp_path, file).items():
            lines[name] = {}
            for module, *arguments in modules:
                command = f"stability_{arguments.pop(0)}" if module == "tools.stability" else module.rpartition(".")[2]
                mapping = composed(command, arguments)
                mapping.pop("name" if module == "hgn.train" else "frozen", None)
                lines[name][module] = CONFIGS[module](mapping)
        return lines

    return settings


CONFIGS = {"datagen": datagen_config} | {
    module: partial(from_mapping, config)
    for module, config in (
        *(("hgn.train", TrainConfig), ("hgn.export", ExportConfig), ("hgn.evaluate", EvaluateConfig)),
        *(("tools.error_vs_time", ErrorVsTimeConfig), ("tools.stability", StabilityNetworkConfig)),
    )
}


def trained_and_scored(name, configs, data):
    """A line that trains a network on data made before, exports it and scores it."""
    assert list(configs) == ["hgn.train", "hgn.export", "hgn.evaluate"]
    config, export, score = configs.values()
    precision = "fp16" if config.network.kind == "hgn" else "tf32"
    assert config.run == f"runs/{name}" and config.training.precision == precision
    made = data[config.dataset.folder]
    assert config.dataset.training_scenes == made.dataset.training_scenes
    assert dataset_identity(config.datagen) == dataset_identity(made)
    assert made.scene.obstacle_count > 0 or not config.network.obstacle_features
    assert (export.checkpoint, export.stored_precision) == (f"runs/{name}/checkpoints/last.ckpt", "fp16")
    assert score.weights == export.out
    assert (score.split, score.scenes, score.frame_stride, score.precision) == ("test", 20, 5, precision)
    return config, score


def test_networks(listed):
    """jobs/networks.txt: each command's settings compose to a valid configuration; each network is trained on data that
    an earlier line makes, exported, and scored on the same data; the paper's network and the shipped ones of
    absolute inputs are among them; reports take what was exported."""
    data: dict[str, DatagenConfig] = {}
    exported: dict[str, str] = {}  # weights to data
    reported: set[str] = set()
    for name, configs in listed("networks.txt").items():
        if "datagen" in configs:
            data[configs["datagen"].dataset.folder] = configs["datagen"]
        elif "tools.error_vs_time" in configs:
            report = configs["tools.error_vs_time"]
            assert set(report.weights) == {file for file, folder in exported.items() if folder == report.data}
            reported |= set(report.weights)
        else:
            config, score = trained_and_scored(name, configs, data)
            assert config.dataset.training_scenes == 800 and score.data == config.dataset.folder
            exported[score.weights] = score.data
    assert reported == set(exported)
    shipped = set(shipped_weights()) - {"mechanics", "own_physics"}
    assert shipped | {"obstacles"} <= {Path(file).stem for file in exported}


def test_mechanics(listed):
    """jobs/mechanics.txt: seven trainings, each from weights that the one before exports, on data that it makes; the
    last one is the network that ships, with its updates, rest and walls, and is scored. The repeats of the fourth,
    which is scored too, differ in name and seed alone."""
    lines = listed("mechanics.txt")
    made = [lines.pop(name)["datagen"] for name in list(lines) if name.endswith("_data")]
    folders = {each.dataset.folder: each for each in made}
    repeated, free = ["fourth", "repeat_2", "repeat_3"], ("first", "second", "third")
    begins_with = {"first": None, "second": "first", "third": "second"} | dict.fromkeys(repeated, "third")
    begins_with |= {"fifth": "fourth", "sixth": "fifth", "mechanics": "sixth"}
    assert list(lines) == list(begins_with)
    trained = {name: configs["hgn.train"] for name, configs in lines.items()}
    for name, config in trained.items():
        export, before = lines[name]["hgn.export"], begins_with[name]
        assert config.run == f"runs/{name}" and export.checkpoint == f"runs/{name}/checkpoints/last.ckpt"
        assert export.out == f"runs/{name}/{name}.safetensors" and not export.step_changes
        assert config.training.init_weights == (before and lines[before]["hgn.export"].out)
        assert dataset_identity(config.datagen) == dataset_identity(folders[config.dataset.folder])
        assert set(config.training.more_data) < set(folders)
        assert config.step.in_training.obstacle_clearance == (None if name in free else 0.0005)
        assert ("hgn.evaluate" in lines[name]) == (name in (*repeated, "mechanics"))
        if (score := lines[name].get("hgn.evaluate")) is not None:
            assert (score.weights, score.data) == (export.out, config.dataset.folder)
            assert score.scenes == config.dataset.validation_scenes
    used = [{each.dataset.folder, *each.training.more_data} for each in trained.values()]
    assert set().union(*used) == set(folders)
    last, shipped = trained["mechanics"], load_weights(shipped_weights()["mechanics"])[1]
    assert (shipped.network, shipped.step) == (last.network, last.step)
    assert shipped.updates == last.training.maximum_updates
    repeats, one = [trained[name] for name in repeated], trained["fourth"]
    assert len({each.training.seed for each in repeats}) == 3
    for each in repeats:
        assert replace(each, run=one.run, training=replace(each.training, seed=one.training.seed)) == one


def test_judged(listed):
    """jobs/judged.txt trains on the two data sets that it makes, checks the exported weights with each test, and
    reports on fresh scenes, which are drawn afterwards."""
    lines = listed("judged.txt")
    assert list(lines)[-2:] == ["fresh", "report"]
    rest, motion, fresh = (lines[name]["datagen"] for name in ("rest_data", "motion_data", "fresh"))
    config, weights = lines["judged"]["hgn.train"], lines["judged"]["hgn.export"].out
    assert dataset_identity(config.datagen) == dataset_identity(motion)
    assert config.training.more_data == (rest.dataset.folder,) and rest.mpm == motion.mpm
    assert f"'frozen=[{weights}]'" in (JOBS / "judged.txt").read_text()
    scored = [lines[name]["hgn.evaluate"] for name in ("errors_rest", "errors_motion")]
    assert [score.data for score in scored] == [rest.dataset.folder, config.dataset.folder]
    stability = [lines[name]["tools.stability"] for name in ("rest", "flight")]
    assert {score.weights for score in (*scored, *stability)} == {weights}
    report = lines["report"]["tools.error_vs_time"]
    assert report.data == fresh.dataset.folder and weights in report.weights


@pytest.mark.parametrize(("file", "lines"), [("networks.txt", 10), ("mechanics.txt", 31)])
def test_trials(tmp_path, file, lines):
    """SCENES, SHARE and REPORTED shorten all data, trainings and reports, and change nothing else."""
    (tmp_path / "trial").mkdir()
    whole, trial = calls(tmp_path, file), calls(tmp_path / "trial", file, SCENES="2", SHARE="1", REPORTED="2")

    def shorter(argument, module):
        key, _, value = argument.partition("=")
        if key in ("dataset.training_scenes", "scenes") and module != "hgn.evaluate":
            value = "2"
        elif key == "training.maximum_updates":
            value = str(int(value) // 100)
        return f"{key}={value}" if value else argument

    expected = {name: [[shorter(text, call[0]) for text in call] for call in lines] for name, lines in whole.items()}
    changed = [(a, b) for name in whole for a, b in zip(whole[name], expected[name], strict=True) if a != b]
    assert trial == expected and list(trial) == list(whole) and len(changed) == lines
