"""Kernels compiled ahead: processes that compile, what the user hears of them, and that the cache then has it all."""

import sys
import time

import pytest
from processes import run_compiled

from hgn.config import NetworkConfig, SceneConfig, TrainConfig, TrainingConfig
from hgn.runtime.precompile import Precompilation, frame_sizes
from hgn.runtime.precompile_program import FrameJob, job_of, job_text
from hgn.step_config import StepConfig
from hgn.training.precompile import job_of_training


def job(batch_scenes=8):
    training = TrainingConfig(batch_scenes=batch_scenes, precision="fp16")
    config = TrainConfig(SceneConfig(), network=NetworkConfig(width=16, levels=2), training=training)
    return job_of_training(config, (9, 0), False)


@pytest.fixture
def started():
    all_started: list[Precompilation] = []
    yield all_started
    for ahead in all_started:
        ahead.stop()


def start(started, program):
    started.append(Precompilation(job(), 2, (sys.executable, "-c", f"import sys; {program}")))
    return started[0]


def test_the_job_follows_from_the_configuration():
    """Sizes are those of the scenes' distribution as it begins, to a few per cent, and the job survives its text."""
    made = job()
    assert made.precision == "fp16" and made.capability == 90 and made.settings.scenes == 8
    assert made.particles == pytest.approx(8 * 4296, rel=0.05)
    assert made.cells == pytest.approx((8 * 1419, 8 * 231), rel=0.2)  # of a measured batch
    assert job_of(job_text(made)) == made


def test_jobs_of_simulations():
    """Networks keep their precisions through the job's text; few and many particles, dense and spread, are among the
    sizes, and as many as there are cases change little."""
    small = NetworkConfig(width=16)
    networks = ((small, StepConfig(), "fp16"), (small, StepConfig(0.1), "tf32"))
    made = FrameJob(networks, frame_sizes([2_763, 30_000, 1, 30_000]), 90)
    assert job_of(job_text(made)) == made
    assert {particles for particles, _ in made.sizes} == {1, 2_763, 30_000} and len(made.sizes) == 9
    assert min(made.sizes) == (1, 1) and max(made.sizes) == (30_000, 36_000)
    assert len(frame_sizes(range(1, 1000))) == 9


def test_what_was_compiled_is_counted(started):
    """Each process gets its share and the job; the counts of all are told together."""
    ahead = start(started, "assert 'fp16' in sys.stdin.read(); print(10 + int(sys.argv[1]) + int(sys.argv[2]))")
    assert "backend triton: 25 kernels ready" in ahead.wait(lambda: False)


def test_a_failure_is_told(started):
    """When a process fails, its exit code and last line are told, and that nothing is lost."""
    text = start(started, "sys.exit('no ptxas' if sys.argv[1] == '1' else 0)").wait(lambda: False)
    assert "1 of 2 processes" in text and "exit code 1: no ptxas" in text and "when it is first used" in text


def test_an_interruption_ends_them(started):
    """Whoever is interrupted waits no longer, and no process is left."""
    ahead = start(started, "import time; time.sleep(60)")
    begin = time.monotonic()
    assert "interrupted" in ahead.wait(lambda: True)
    assert time.monotonic() - begin < 30
    assert not ahead.running


def test_the_launches_are_those_of_an_update(warm_python, tmp_path):
    """Without memory and without a GPU the same kernels with the same specialisations are found as on tensors that
    exist, and one of them is compiled into Triton's cache. A kernel's key in that cache does not depend on which
    kernels the process saw before: those that a share compiles are found by a training, which begins with others."""
    text = run_compiled(warm_python, tmp_path, "training/precompile_program.py")
    assert list(tmp_path.glob("*/*.cubin"))
    forwards, backwards = (part.split("\n") for part in text.split("\n\n"))
    assert len(forwards) > 30 and forwards == backwards[::-1]
