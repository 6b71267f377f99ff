"""Tests precompilation: its processes, its messages to the user, and the completeness of the cache."""

import json
import re
import sys
from dataclasses import replace

import pytest
from processes import run_compiled

from hgn.config import NetworkConfig, SceneConfig, TrainConfig, TrainingConfig, config_directory
from hgn.hydra_compat import compose
from hgn.schema import from_mapping
from hgn.training.precompile import Precompilation, sizes_of


def job(batch_scenes=8):
    training = TrainingConfig(batch_scenes=batch_scenes, precision="fp16")
    return TrainConfig(SceneConfig(), network=NetworkConfig(width=16, levels=2), training=training)


def test_sizes_follow_from_the_configuration():
    """Sizes are those of the distribution of scenes at their start, to a few per cent."""
    particles, cells = sizes_of(job())
    assert particles == pytest.approx(8 * 4296, rel=0.05)
    assert cells == pytest.approx((8 * 1419, 8 * 231), rel=0.2)  # of a measured batch


@pytest.mark.parametrize("experiment", ["obstacles", "mechanics", "own_physics"])
def test_processes_compile_the_kernels_of_the_training(experiment, monkeypatch):
    """Each process reads the whole configuration, its part, the GPU's capability, and whether there are more ranks."""
    (mapping,) = compose(config_directory(), "train", ["train", f"experiment={experiment}"])
    given = from_mapping(TrainConfig, {key: mapping[key] for key in mapping if key not in ("name", "run")})
    given = replace(given, training=replace(given.training, precision="fp16"))
    seen = []
    monkeypatch.setattr("hgn.training.precompile.Program", lambda command, _, text: seen.append((command, text)))
    Precompilation(given, (9, 0), True, 2)._files.close()
    assert len(seen) == 2
    for part, (command, text) in enumerate(seen):
        assert command[-4:] == [str(part), "2", "90", "1"]
        assert from_mapping(TrainConfig, json.loads(text)) == given


@pytest.mark.parametrize(
    ("program", "interrupted", "expected"),
    [  # each process gets its share and the job; the counts of all are told together
        ("assert 'fp16' in sys.stdin.read(); print(10 + sum(map(int, sys.argv[1:3])))", False, "25 kernels ready"),
        (
            "sys.exit('no ptxas' if sys.argv[1] == '1' else 0)",
            False,
            "1 of 2 .*exit code 1: no ptxas.*at their first",
        ),
        ("import time; time.sleep(600)", True, "interrupted"),
    ],
)
def test_what_is_told(program, interrupted, expected):
    """The message counts the compiled kernels. If a process fails, it contains the exit code and the last line, and
    states that missing kernels are compiled later. An interruption ends the wait, and no process remains."""
    ahead = Precompilation(job(), (9, 0), False, 2, (sys.executable, "-c", f"import sys; {program}"))
    try:
        assert re.search(expected, ahead.wait(lambda: interrupted)) and not ahead.running
    finally:
        ahead.stop()


def test_the_launches_are_those_of_an_update(warm_python, tmp_path):
    """Without memory and without a GPU the same kernels with the same specialisations are found as on tensors that
    exist, and one of them is compiled into Triton's cache. A kernel's key in that cache does not depend on which
    kernels the process saw before: those that a share compiles are found by a training, which begins with others."""
    text = run_compiled(warm_python, tmp_path, "training/precompile_program.py")
    assert list(tmp_path.glob("*/*.cubin"))
    forwards, backwards = (part.split("\n") for part in text.split("\n\n"))
    assert len(forwards) > 30 and forwards == backwards[::-1]


def test_a_training_with_pushforward_launches_only_kernels_compiled_ahead(warm_python, tmp_path):
    """An update and a simulation of episodes with friction, parameters, elastic bodies and moving obstacles."""
    lines = run_compiled(warm_python, tmp_path, "training/needed_program.py").splitlines()
    assert len(lines) == 6
    for line in lines:
        update, both = map(int, re.findall(r": (\d+) (\d+)", line)[0])
        assert 45 < update < both - 10 and line.endswith(f": {update} {both} |"), line
