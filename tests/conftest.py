"""Data sets made with the ballistic stand-in for the solver, and the process put right after every test."""

import atexit
import gc
import importlib.util
import io
import os
import resource
import shutil
import signal
import sys
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path

import pytest

import hgn  # noqa: F401 - before torch

# the networks of the tests are tiny: threads would wait for one another for most of the time, above all on busy cores
os.environ.setdefault("OMP_NUM_THREADS", "1")

# what a script runs in the background ignores Ctrl-C, under nohup also SIGHUP, and so would all that the tests start
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

if gc.isenabled():
    gc.disable()  # until all is loaded

import file_scheduling
import interpreter
import torch
import warm_server
from tqdm import tqdm

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # kernels run in Triton's interpreter; said before any of them is defined
    for name in [each for each in sys.modules if each.startswith("triton") and not each.startswith("triton._C")]:
        del sys.modules[name]  # warm_server.py has loaded it, whose own functions would be compiled
    if importlib.util.find_spec("triton"):
        interpreter.spare_repeated_work()

sys.path.insert(0, str(Path(__file__).parent / "datagen"))  # spawned workers find the stand-in by name

import ballistic_dataset
import ballistic_solver

from hgn.config import DatagenConfig, DatasetConfig


def pytest_addoption(parser):
    parser.addoption("--soak", type=int, metavar="N", help="damage each kind of file in N other ways at each run")


def pytest_configure(config):
    """All processes of these tests share a warm interpreter; the first that asks for it has it started. Those of
    pytest-xdist are forks of it."""
    if not hasattr(config, "workerinput"):
        processes = getattr(config.option, "tx", None) or []
        config.add_cleanup(warm_server.WarmServer(warm_server.FOR_TESTS if processes else ()).stop)
        if set(processes) == {"popen"}:
            config.option.tx = [f"popen//python={os.environ[warm_server.VARIABLE]}/python"] * len(processes)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Asked for where several processes run the tests (pytest-xdist)."""
    return file_scheduling.FileScheduling(config, log)


def pytest_collection_modifyitems(items):
    """Long files first, for begun last, one of them would run alone."""
    items.sort(key=lambda item: file_scheduling.place_of(item.nodeid))


def pytest_collection_finish():
    """What is loaded by now stays: garbage collections need not look at it, half a second each."""
    if "hydra" in sys.modules:
        import composition

        composition.read_once()
    gc.freeze()
    gc.enable()
    atexit.register(gc.unfreeze)  # else Triton tells of all that it still holds


@pytest.fixture(autouse=True)
def keep_signal_handlers_and_no_bars():
    """Commands that a test runs in this process leave handlers behind. An open bar would print in another test."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)
    bars = [tqdm._instances.pop() for _ in range(len(tqdm._instances))]
    assert not bars


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder of fetched shards, the test's own; and a first pause that is short."""
    monkeypatch.setenv("HGN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("hgn.system.patience.FIRST_PAUSE_S", 0.01)
    return tmp_path / "cache" / "shards"


@pytest.fixture
def backend(tmp_path, monkeypatch):
    folder = tmp_path / "control"
    folder.mkdir()
    monkeypatch.setenv(ballistic_solver.FOLDER_VARIABLE, str(folder))
    return ballistic_solver.BALLISTIC


@pytest.fixture
def control(backend, tmp_path):
    """The folder whose files steer the stand-in."""
    return tmp_path / "control"


def small_config(folder, **changes):
    values = {"training_scenes": 5, "validation_scenes": 2, "test_scenes": 1, "frames": 6, "workers": 1}
    return DatagenConfig(dataset=DatasetConfig(**({"folder": str(folder)} | values | changes)))


@pytest.fixture
def make_config(tmp_path):
    return partial(small_config, folder=tmp_path / "data")


@pytest.fixture
def stage(backend):
    """Simulates one episode in this process and stages it; the writer claims what comes before it too."""
    return ballistic_dataset.stage


@pytest.fixture
def make_dataset(backend):
    """Makes a whole data set without any worker process."""
    return ballistic_dataset.make_dataset


@pytest.fixture(scope="session")
def solver_kernels():
    """The solver in this process, with kernels that tests share."""
    import shared_kernels

    shared_kernels.start()


@pytest.fixture(scope="session")
def small_dataset(tmp_path_factory):
    """What tests that do not make one themselves get a copy of."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ballistic_solver.FOLDER_VARIABLE, str(tmp_path_factory.mktemp("control")))
        return ballistic_dataset.make_dataset(small_config(tmp_path_factory.mktemp("small") / "data"))


@pytest.fixture
def data(make_config, small_dataset):
    """The configuration of a small data set, which is there."""
    config = make_config()
    shutil.copytree(small_dataset, config.dataset.folder)
    return config


@pytest.fixture(scope="session")
def finished_once(small_dataset, tmp_path_factory):
    """A training of 12 updates that ended, with rollouts measured: its data, its folder, and what it printed."""
    from training.runs import train_mapping

    from hgn import train

    config, run, said = small_config(small_dataset), tmp_path_factory.mktemp("finished") / "run", io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        assert train.main(train_mapping(config, run, monitor_rollout_frames=4)) == 0
    return config, run, said.getvalue()


@pytest.fixture
def finished(finished_once, tmp_path):
    """The data of that training, and a copy of its folder."""
    config, run, _ = finished_once
    shutil.copytree(run, tmp_path / "run")
    return config, tmp_path / "run"


@pytest.fixture
def folder(data):
    """Its folder."""
    return Path(data.dataset.folder)


@pytest.fixture(scope="session")
def warm_python():
    """An interpreter that has the training stack loaded, see warm_server.py."""
    return Path(os.environ[warm_server.VARIABLE]) / "python"


@pytest.fixture
def file_limit():
    """Sets the largest size of a file in bytes; None: none."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (before[0] if size is None else size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
