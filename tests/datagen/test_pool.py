"""Tests the pool: whatever happens to its workers, the data set becomes complete, and no process remains."""

import contextlib
import dataclasses
import errno
import multiprocessing
import os
import pickle
import shutil
import signal
import tarfile
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import ballistic_solver
import numpy as np
import pytest
from written_files import Recorder, hashes, simulated, simulated_once

from datagen.pool import local_workers, pool
from datagen.pool.local_workers import LocalWorker, LocalWorkerFactory
from datagen.pool.plan import SceneTask, scene_seed
from datagen.pool.pool import Pool, Stopped
from datagen.pool.worker import Backend, MadeScene, Parcel, Worker, make_scene
from datagen.pool.worker_plan import WorkerPlan, plan_workers, visible_gpus
from datagen.pool.writer import DatasetWriter
from datagen.service import supervisor
from hgn.config import DatagenConfig, DatasetConfig, MpmConfig, SceneConfig
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.schema import ConfigError

ONE = WorkerPlan(solvers=1, threads=1, makers=1, scenes_per_launch=1, first_launch=1)


def generate(config, backend, plan=ONE, **options):
    recorder = Recorder()
    try:
        with DatasetWriter(config, recorder.message) as writer:
            Pool(writer, recorder, LocalWorkerFactory(config, backend, plan), **options).run()
    finally:
        assert not multiprocessing.active_children()
    return recorder


def test_whole_dataset(make_config, small_dataset, backend, tmp_path):
    """Two solvers in processes of their own make the same shards, bitwise, as one loop in this process; they end in
    order, for only then Taichi writes what it compiled to its cache."""
    config = make_config()
    ending = tmp_path / "control" / "ending"
    ending.mkdir()
    recorder = generate(config, backend, WorkerPlan(2, 1, 1, 1, 1))
    ended = len(list(ending.iterdir()))
    shutil.rmtree(ending)
    assert 1 <= ended <= 2  # one may have had no scene
    assert hashes(Path(config.dataset.folder)) == hashes(small_dataset)
    assert len(recorder.episodes) == 8 and len(recorder.shards) == 7
    episode = next(iter(EpisodeStore(config.dataset.folder, "train")))
    assert episode.solver["counters"] == {"substeps": 6}
    assert episode.solver["settings"]["youngs_modulus_pa"] == 1e6 and "device" not in episode.solver["settings"]
    assert {path.suffix for path in Path(config.dataset.folder).iterdir()} == {".tar", ".json", ""}


class Counted:
    """Counts how often one was read."""

    read = 0

    def __init__(self):
        self.kept = True

    def __setstate__(self, state):
        Counted.read += 1
        self.__dict__.update(state)


def test_a_parcel_is_read_where_it_is_opened():
    """Who passes it on only copies its bytes, and who opens it twice reads it once."""
    there = pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(Parcel(Counted())))))
    assert Counted.read == 0
    assert there.open().kept and there.open() is there.open() and Counted.read == 1
    assert pickle.loads(pickle.dumps(there)).open().kept and Counted.read == 2


def test_scenes_that_cannot_be_read(make_config, backend):
    """The solver's thread that reads them tells why and ends, else the parent would wait for it for ever."""
    unreadable = dataclasses.replace(backend, build_collider="ballistic_solver:unreadable_collider")
    with pytest.raises(RuntimeError, match=r"(?s)a worker failed.*a collider of another time"):
        generate(make_config(), unreadable, WorkerPlan(1, 1, 2, 4, 4))


def test_long_episodes(make_config, backend, threads):
    """A third of each split's episodes, evenly spread, have long_frames; a launch of both kinds becomes two."""
    config = make_config(training_scenes=9, validation_scenes=3, test_scenes=0, long_fraction=0.34, long_frames=11)
    generate(config, backend, WorkerPlan(1, None, 2, 4, 4))
    manifest = Manifest.load(config.dataset.folder)
    entries = [[e for shard in manifest.shards_of(split) for e in shard.episodes] for split in ("train", "validation")]
    frames = [[entry.frames for entry in sorted(some, key=lambda entry: entry.index)] for some in entries]
    short = config.dataset.frames
    assert frames == [[short, short, 11] * 3, [short, short, 11]]
    for episode in EpisodeStore(Path(config.dataset.folder), "train"):
        time_s, down = (episode.frame_count - 1) / 60, np.array(episode.gravity)
        moved_N3 = episode.position_TN3[-1] - episode.position_TN3[0] - time_s * episode.initial_velocity_N3
        np.testing.assert_allclose(moved_N3, np.tile(0.5 * time_s**2 * down, (len(moved_N3), 1)), atol=1e-6)


def test_batches(make_config, backend, control, threads):
    """A solver that takes several scenes a launch starts with a small launch and fills the later ones."""
    config = make_config(training_scenes=9, validation_scenes=0, test_scenes=0)
    recorder = generate(config, backend, WorkerPlan(1, None, 2, 4, 2))
    assert recorder.launches == [2, 4, 3]
    assert sorted(simulated(control)) == sorted(scene_seed(0, "train", i, 0) for i in range(9))
    for largest, launches in ((4, [3, 3, 3]), (8, [5, 4])):  # even ones: a small last one costs as much time
        shutil.rmtree(config.dataset.folder)
        assert generate(config, backend, WorkerPlan(1, None, 2, largest, largest)).launches == launches


class Immediate(ThreadPoolExecutor):
    """Runs what is submitted in the thread that submits it."""

    def submit(self, function, /, *arguments):
        future = Future()
        future.set_result(function(*arguments))
        return future


@pytest.mark.parametrize(("threads", "fault"), [(1, False), (1, True), (2, False)])
def test_staging_begins_when_the_next_launch_runs(make_config, backend, monkeypatch, threads, fault):
    """Threads that stage a launch would delay the thread that prepares the next one. The last launch is staged without
    a delay, and so are the one before an error and a launch with at most one scene for each thread."""
    config = make_config(training_scenes=4, validation_scenes=0, test_scenes=0, frames=11)
    (Path(config.dataset.folder) / ".staging").mkdir(parents=True)
    pool_end, solver_end = multiprocessing.Pipe()
    tasks = [SceneTask("train", i, 0, scene_seed(0, "train", i, 0)) for i in range(4)]
    made = [make_scene(task, config, backend)[1] for task in tasks]
    for message in (*made[:2], None, *made[2:], None):
        pool_end.send(message)
    pool_end.close()
    events: list[object] = []
    simulate = ballistic_solver.simulate

    def recorded(scenes, *arguments, on_frame, **options):
        for thread in threading.enumerate():
            if thread.name == "inbox":  # the next launch has been received
                thread.join()
        if fault and events:
            raise OSError("a fault in the second launch")
        results = simulate(scenes, *arguments, **options)
        for frame in range(11):
            events.append(frame)
            on_frame(frame)
        return results

    def send(kind, *values):
        if kind == "staged":
            events.append(values[0])

    monkeypatch.setattr(ballistic_solver, "simulate", recorded)
    monkeypatch.setattr(local_workers, "ThreadPoolExecutor", Immediate)
    monkeypatch.setattr(local_workers, "_STAGING_THREADS", threads)
    first, second = ([task.key for task in tasks[i : i + 2]] for i in (0, 2))
    expected = pytest.raises(OSError, match="second launch") if fault else contextlib.nullcontext()
    with expected:
        local_workers._solve(solver_end, send, config, backend, None, None, 2)
    begun = local_workers._STAGING_FRAME + 1
    after = first if fault else [*range(begun), *first, *range(begun, 11), *second]
    if threads == 2:
        after = [*first, *range(11), *second]
    assert events == [*range(11), *after]


def test_scenes_are_spread_over_solvers(make_config, backend, control, threads):
    """Each of three solvers gets a launch of the same size, though those on a GPU ask for more as soon as they have
    one, and some take long to start.
    """
    config = make_config(training_scenes=11, validation_scenes=0, test_scenes=0)
    batches: dict[int, list[int]] = {}

    class WorkerFactory(LocalWorkerFactory):
        def start_solver(self, number):
            worker = super().start_solver(number)
            give = worker.give

            def recorded(message):
                batches.setdefault(number, []).append(len(message))
                give(message)
                worker.idle = True  # asks for more before any other has started

            worker.give = recorded
            return worker

    for first, expected in ((9, {0: [4], 1: [4], 2: [3]}), (1, {0: [1, 3], 1: [1, 3], 2: [1, 2]})):
        shutil.rmtree(config.dataset.folder, ignore_errors=True)
        batches.clear()
        plan = WorkerPlan(3, None, 1, 9, first)
        with DatasetWriter(config) as writer:
            Pool(writer, Recorder(), WorkerFactory(config, backend, plan)).run()
        assert batches == expected


def test_first_launch_waits_for_the_first_scenes(make_config, backend, control, threads):
    """A scene that is quick to make does not overtake the first ones: training waits for the first shard."""
    config = make_config(training_scenes=7, validation_scenes=0, test_scenes=0)
    first, second = (scene_seed(0, "train", i, 0) for i in range(2))
    (control / f"late-{first}").touch()
    generate(config, backend, WorkerPlan(1, None, 3, 4, 2))
    assert simulated(control)[:2] == [first, second]


SECOND = scene_seed(0, "train", 1, 0)
DIVERGED, NO_ROOM, NO_GRID = "diverged in frame 3", "no room for the obstacles", "a surface too large"
FAULTS = [  # a file that steers the stand-in and its content, scenes a launch, the cause, how often it was simulated
    (f"kill-{SECOND}", "1", 1, None, 2),
    (f"kill-{SECOND}", "99", 4, "ended by SIGKILL", 4),  # with the others, with a half of them, twice alone
    (f"fail-{SECOND}", "", 1, DIVERGED, 1),
    (f"refuse-{SECOND}", "", 1, NO_ROOM, 0),
    (f"gridless-{SECOND}", "", 1, NO_GRID, None),  # may be simulated meanwhile
    (f"kill-grid-{SECOND}", "", 1, None, 1),
]


@pytest.mark.parametrize(("sign", "content", "scenes", "cause", "count"), FAULTS)
def test_a_scene_at_fault(make_config, backend, control, threads, monkeypatch, sign, content, scenes, cause, count):
    """If a worker is killed once, its scene is retried with the same seed. A scene that alone kills its worker
    MAXIMUM_ATTEMPTS times is found by halving its batch, and quarantined. A scene that cannot be made or simulated, or
    whose grid cannot be built, is quarantined immediately, because a retry of the seed would not help. The next seed
    replaces it."""
    monkeypatch.setattr(pool, "MAXIMUM_ATTEMPTS", 2)
    config = make_config(training_scenes=4, validation_scenes=0, test_scenes=0)
    (control / sign).write_text(content)
    recorder = generate(config, backend, WorkerPlan(1, None, 1, scenes, scenes))
    manifest = Manifest.load(config.dataset.folder)
    assert manifest.complete and count in (None, simulated(control).count(SECOND))
    failures = [(failure.key, failure.seed, failure.attempt, failure.cause) for failure in manifest.quarantined]
    assert failures == ([("train-000001", SECOND, 0, cause)] if cause else [])
    seeds = {entry.index: (entry.seed, entry.attempt) for entry in EpisodeStore(config.dataset.folder, "train").entries}
    last = int(cause is not None)
    assert seeds == {i: (scene_seed(0, "train", i, last * (i == 1)), last * (i == 1)) for i in range(4)}
    if cause is None:
        message = "a worker died (ended by SIGKILL); it is replaced and its scenes are tried again"
        assert recorder.messages == [message]
    elif scenes == 1:
        message = f"train-000001 (seed {SECOND}) could not be simulated: {cause}; trying another seed"
        assert recorder.messages == [message]


def test_workers_that_die_while_stopping(make_config, backend, control, threads):
    """A signal to the whole process group ends workers as well: then none is replaced, and nothing is said of it."""
    config = make_config(training_scenes=1, validation_scenes=0, test_scenes=0)
    (control / f"kill-{scene_seed(0, 'train', 0, 0)}").write_text("1")
    recorder = Recorder()
    with pytest.raises(Stopped), DatasetWriter(config) as writer:
        factory = LocalWorkerFactory(config, backend, ONE)
        Pool(writer, recorder, factory, lambda: (control / "simulated.log").exists()).run()
    assert recorder.messages == [] and len(simulated(control)) == 1


@pytest.mark.parametrize("sent", [b"", b"\0", b"\0\0\1\0" + bytes(9)])
def test_a_process_that_is_killed_in_a_message(make_config, monkeypatch, sent):
    """It is a dead one to the pool, its workers and the service. Full memory may end a maker that sends a scene."""
    ends = [multiprocessing.Pipe() for _ in range(3)]
    for _, end in ends:
        os.write(end.fileno(), sent)
        end.close()
    worker = StoppedWorker()
    worker.connection = ends[0][0]
    assert list(LocalWorkerFactory.receive(None, [worker], 1.0)) == [(worker, None)]
    assert list(local_workers._received(ends[1][0])) == []
    dead = SimpleNamespace(join=lambda: None, exitcode=-signal.SIGKILL)
    monkeypatch.setattr(supervisor, "start_child", lambda *_, **__: (dead, ends[2][0]))
    assert supervisor.Supervisor(make_config(), Recorder())._run_once() == ("died", "ended by SIGKILL")


def test_simulated_scenes_are_kept_after_a_stop(make_config, backend, control):
    """A stop while the second launch runs keeps the first one, whose staging waits for the second to be under way. A
    closed terminal signals workers too."""
    count = local_workers._STAGING_THREADS + 1
    config = make_config(training_scenes=2 * count, validation_scenes=0, test_scenes=0)
    first, second = (control / f"hold-{scene_seed(0, 'train', index, 0)}" for index in (0, count))
    for path in (first, second, control / "simulated.log"):
        path.touch()
    with DatasetWriter(config) as writer:
        factory = LocalWorkerFactory(config, backend, WorkerPlan(1, None, 1, count, count))

        def ready():
            made = [made for solver in stopped._solvers for made in solver.tasks.values()]
            if len(made) == 2 * count and all(one.obstacle_grid for one in made):
                first.unlink(missing_ok=True)
            if late := len(simulated(control)) > count:
                os.kill(stopped._solvers[0].process.pid, signal.SIGHUP)
            return late

        stopped = Pool(writer, Recorder(), factory, ready)
        with pytest.raises(Stopped):
            stopped.run()
        assert writer.done == count


def test_two_generators_at_once(make_config, small_dataset, backend, control, threads):
    """Two that share a folder at once: each scene is simulated and each shard published once, both end with the whole
    data set, and it is bitwise the one that a single generator makes."""
    (control / "slow").touch()
    with ThreadPoolExecutor() as both:
        recorders = [both.submit(generate, make_config(), backend) for _ in range(2)]
    assert all(len(recorder.result().shards) for recorder in recorders) and simulated_once(control) == 8
    assert hashes(Path(make_config().dataset.folder)) == hashes(small_dataset)


def test_fault_in_the_solver_ends_the_run(make_config, backend, control, threads):
    """An exception that no scene is to blame for is not retried: it ends the run with the worker's traceback; so does a
    solver that cannot be imported. Full memory is a fault of the machine."""
    (control / "raise").write_text("Virtual memory allocation (1073741824 B) failed.")
    with pytest.raises(OSError, match="memory is full") as full:
        generate(make_config(), backend)
    assert full.value.errno == errno.ENOMEM
    (control / "raise").write_text("a fault in the solver")
    with pytest.raises(RuntimeError, match=r"(?s)a worker failed:\nTraceback .*a fault in the solver"):
        generate(make_config(), backend)
    with pytest.raises(RuntimeError, match="ModuleNotFoundError"):
        generate(make_config(), Backend(backend.generate_scene, backend.build_obstacle_grid, "no_such_module:simulate"))


def test_full_disk_in_a_worker_reaches_the_parent(make_config, backend, tmp_path, threads):
    """An OSError while staging ends the run as that OSError."""
    config = make_config(training_scenes=1, validation_scenes=0, test_scenes=0)
    with DatasetWriter(config) as writer:
        staging = writer.folder / ".staging"
        staging.rmdir()
        staging.write_text("in the way")
        with pytest.raises(NotADirectoryError):
            Pool(writer, Recorder(), LocalWorkerFactory(config, backend, ONE)).run()
        staging.unlink()
        staging.mkdir()


def test_every_scene_fails(make_config, backend, control, threads):
    """When no seed works the run ends with the cause and what to change."""
    for attempt in range(20):
        (control / f"refuse-{scene_seed(0, 'train', 0, attempt)}").touch()
    with pytest.raises(ConfigError, match=r"train-000000 could not be simulated with 20 seeds, .* no room"):
        generate(make_config(training_scenes=1, validation_scenes=0, test_scenes=0), backend)


@pytest.mark.parametrize(
    ("sections", "gpus", "memory", "plan"),
    [
        ({}, (), 2**36, WorkerPlan(4, 2, 1, 1, 1)),
        ({}, ("0",), 2**36, WorkerPlan(1, None, 7, 416, 416, ("0",))),
        ({"mpm": MpmConfig(device="cpu")}, ("0",), 2**36, WorkerPlan(4, 2, 1, 1, 1)),
        ({"scene": SceneConfig(domain_size=(4.0, 1.0, 4.0))}, ("0",), 2**36, WorkerPlan(1, None, 7, 52, 52, ("0",))),
        ({}, ("0",), 2**32, WorkerPlan(1, None, 7, 138, 138, ("0",))),  # frames that fill half of 4 GB
        ({"mpm": MpmConfig(scenes_per_launch=2)}, (), 2**36, WorkerPlan(4, 2, 1, 2, 2)),
        ({"dataset": DatasetConfig(workers=3)}, ("4", "5"), 2**40, WorkerPlan(3, None, 7, 416, 416, ("4", "5"))),
        ({}, ("4", "5"), 2**40, WorkerPlan(2, None, 7, 416, 416, ("4", "5"))),
        ({}, ("4", "5"), 2**33, WorkerPlan(2, None, 7, 138, 138, ("4", "5"))),  # each holds its own frames
        ({"dataset": DatasetConfig(workers=1)}, ("4", "5"), 2**40, WorkerPlan(1, None, 7, 416, 416, ("4", "5"))),
    ],
)
def test_worker_plans(sections, gpus, memory, plan, monkeypatch):
    """One solver for two cores; one for each GPU that is not hidden, with full launches and makers in front; settings
    win. Where a training waits, first launches are small."""
    assert plan_workers(DatagenConfig(**sections), gpus, 8, memory) == plan
    early = plan_workers(DatagenConfig(**sections), gpus, 8, memory, early=True)
    assert early == dataclasses.replace(plan, first_launch=min(2, plan.first_launch) if gpus else plan.first_launch)
    assert plan_workers(DatagenConfig(), (), 1, 2**36) == WorkerPlan(1, 1, 1, 1, 1)
    for value in ("", "-1"):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", value)
        assert visible_gpus() == ()


def test_tars_are_those_of_tarfile(folder, tmp_path):
    """Shards are bitwise what Python's own module makes of their members."""
    for shard in Manifest.load(folder).shards:
        path = folder / shard.name
        with tarfile.open(path) as given, tarfile.open(tmp_path / "own.tar", "w", format=tarfile.GNU_FORMAT) as own:
            for info in given:
                plain = tarfile.TarInfo(info.name)
                plain.size, plain.mode = info.size, 0o644
                own.addfile(plain, given.extractfile(info))
        assert path.read_bytes() == (tmp_path / "own.tar").read_bytes()


class StoppedWorker(LocalWorker):
    """A worker that sends nothing."""

    def __init__(self):
        Worker.__init__(self)
        self.killed, self.idle = False, True

    def send(self, message):
        pass

    def dismiss(self, deadline_s):
        pass

    def kill(self):
        self.killed = True


def test_stopped_solver_is_replaced(make_config, monkeypatch):
    """A busy solver that sends nothing for too long (SIGSTOP, a device that hangs) is replaced, and another one
    simulates its scene. Idle solvers are not replaced, and none is after the pool itself was stopped."""
    now, passes = [1000.0], iter([250, 250, 10_000, 250, 250, 250, 250])
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    solvers: list[StoppedWorker] = []

    class Workers:
        plan = ONE

        def start_maker(self):
            return StoppedWorker()

        def start_solver(self, number):
            solvers.append(StoppedWorker())
            return solvers[-1]

        def receive(self, workers, timeout):
            if len(solvers) > 1:
                raise TimeoutError("the test ends")
            now[0] += next(passes)
            made = [(worker, task) for worker in workers for task in worker.tasks.values()]
            return [(worker, ("made", MadeScene(t, None, None))) for worker, t in made if isinstance(t, SceneTask)]

    config, recorder = make_config(training_scenes=1, validation_scenes=0, test_scenes=0), Recorder()
    with DatasetWriter(config) as writer, pytest.raises(TimeoutError):
        Pool(writer, recorder, Workers()).run()
    assert recorder.messages[0].startswith("a worker died (it sent nothing for 600 s); it is replaced")
    assert solvers[0].killed and solvers[0].last_message_s > 1000 and list(passes) == [250]
