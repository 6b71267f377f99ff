"""The pool: whatever happens to its workers, the data set comes out whole, and no process is left behind."""

import dataclasses
import multiprocessing
import pickle
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest
from written_files import Recorder, hashes, simulated

from datagen.pool import pool
from datagen.pool.local_workers import LocalWorker, LocalWorkerFactory
from datagen.pool.plan import SceneTask, scene_seed
from datagen.pool.pool import Pool, Stopped
from datagen.pool.worker import Backend, MadeScene, Parcel, Worker
from datagen.pool.worker_plan import WorkerPlan, plan_workers, visible_gpus
from datagen.pool.writer import DatasetWriter
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


def test_killed_worker_is_replaced(make_config, backend, control):
    """A worker that is killed once costs a retry of the same seed, nothing else."""
    config = make_config(training_scenes=3, validation_scenes=0, test_scenes=0)
    seed = scene_seed(0, "train", 1, 0)
    (control / f"kill-{seed}").write_text("1")
    recorder = generate(config, backend)
    assert recorder.messages == ["a worker died (ended by SIGKILL); it is replaced and its scenes are tried again"]
    manifest = Manifest.load(config.dataset.folder)
    assert manifest.complete and not manifest.quarantined
    assert simulated(control).count(seed) == 2


def test_scene_that_kills_its_worker_is_quarantined(make_config, backend, control, monkeypatch):
    """In a batch only the guilty scene, found by halves, is quarantined after MAXIMUM_ATTEMPTS alone; the next seed
    replaces it."""
    config = make_config(training_scenes=4, validation_scenes=0, test_scenes=0)
    monkeypatch.setattr(pool, "MAXIMUM_ATTEMPTS", 2)
    seed = scene_seed(0, "train", 2, 0)
    (control / f"kill-{seed}").write_text("99")
    generate(config, backend, WorkerPlan(1, None, 1, 4, 4))
    manifest = Manifest.load(config.dataset.folder)
    (failure,) = manifest.quarantined
    assert (failure.key, failure.seed, failure.cause) == ("train-000002", seed, "ended by SIGKILL")
    assert manifest.complete
    assert list(EpisodeStore(config.dataset.folder, "train").entries)[2].attempt == 1
    assert simulated(control).count(seed) == 4  # with the others, with a half of them, twice alone


@pytest.mark.parametrize(("sign", "cause"), [("fail", "diverged in frame 3"), ("refuse", "no room for the obstacles")])
def test_scene_that_fails_is_quarantined(make_config, backend, control, sign, cause, threads):
    """A scene that cannot be made or simulated is replaced at once: trying the same seed again would not help."""
    config = make_config(training_scenes=2, validation_scenes=0, test_scenes=0)
    seed = scene_seed(0, "train", 0, 0)
    (control / f"{sign}-{seed}").touch()
    recorder = generate(config, backend)
    manifest = Manifest.load(config.dataset.folder)
    (failure,) = manifest.quarantined
    assert (failure.seed, failure.attempt, failure.cause) == (seed, 0, cause)
    seeds = {entry.index: entry.seed for shard in manifest.shards for entry in shard.episodes}
    assert seeds == {0: scene_seed(0, "train", 0, 1), 1: scene_seed(0, "train", 1, 0)}
    assert recorder.messages == [f"train-000000 (seed {seed}) could not be simulated: {cause}; trying another seed"]


def test_stop_keeps_what_is_staged(make_config, backend, control):
    """A run that is asked to stop ends, and the next one simulates only what is left."""
    config = make_config()
    recorder = Recorder()
    with pytest.raises(Stopped), DatasetWriter(config) as writer:
        factory = LocalWorkerFactory(config, backend, ONE)
        Pool(writer, recorder, factory, lambda: len(recorder.episodes) >= 3).run()
    assert not multiprocessing.active_children()
    # the episode in flight may or may not have been staged when its worker ended
    done = len(recorder.episodes)
    again = generate(config, backend)
    assert Manifest.load(config.dataset.folder).complete
    assert 8 - done - 1 <= len(again.episodes) <= 8 - done
    assert len(simulated(control)) <= 9


def test_workers_that_die_while_stopping(make_config, backend, control):
    """A signal to the whole process group ends workers as well: then none is replaced, and nothing is said of it."""
    config = make_config(training_scenes=1, validation_scenes=0, test_scenes=0)
    (control / f"kill-{scene_seed(0, 'train', 0, 0)}").write_text("1")
    recorder = Recorder()
    with pytest.raises(Stopped), DatasetWriter(config) as writer:
        factory = LocalWorkerFactory(config, backend, ONE)
        Pool(writer, recorder, factory, lambda: (control / "simulated.log").exists()).run()
    assert recorder.messages == [] and len(simulated(control)) == 1


def test_fault_in_the_solver_ends_the_run(make_config, backend, control):
    """An exception that no scene is to blame for is not retried: it ends the run with the worker's traceback; so does a
    solver that cannot be imported."""
    (control / "raise").touch()
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


def test_worker_plans():
    """One solver for two cores; one for each GPU, with full launches and makers in front; settings win."""
    default = DatagenConfig()
    assert plan_workers(default, (), 8, 2**36) == WorkerPlan(4, 2, 1, 1, 1)
    assert plan_workers(default, (), 1, 2**36) == WorkerPlan(1, 1, 1, 1, 1)
    assert plan_workers(default, ("0",), 8, 2**36) == WorkerPlan(1, None, 7, 416, 416, ("0",))
    assert plan_workers(DatagenConfig(mpm=MpmConfig(device="cpu")), ("0",), 4, 2**36).threads == 2
    many = DatagenConfig(dataset=DatasetConfig(workers=3), mpm=MpmConfig(scenes_per_launch=2))
    large = DatagenConfig(scene=SceneConfig(domain_size=(4.0, 1.0, 4.0)))
    assert plan_workers(large, ("0",), 8, 2**36).scenes_per_launch == 52
    assert plan_workers(default, ("0",), 8, 2**32).scenes_per_launch == 138  # of frames that fill half of 4 GB
    assert plan_workers(default, ("0",), 8, 2**36, early=True) == WorkerPlan(1, None, 7, 416, 2, ("0",))
    assert plan_workers(many, (), 8, 2**36) == WorkerPlan(3, 2, 1, 2, 2)
    assert plan_workers(many, ("4", "5"), 8, 2**36) == WorkerPlan(3, None, 7, 2, 2, ("4", "5"))
    assert plan_workers(default, ("4", "5"), 8, 2**40) == WorkerPlan(2, None, 7, 416, 416, ("4", "5"))
    assert plan_workers(default, ("4", "5"), 8, 2**33).scenes_per_launch == 138  # each holds its own frames
    alone = DatagenConfig(dataset=DatasetConfig(workers=1))
    assert plan_workers(alone, ("4", "5"), 8, 2**40).solvers == 1


def test_hidden_gpus_are_not_used(monkeypatch):
    """CUDA_VISIBLE_DEVICES takes GPUs away, as everywhere else."""
    for value in ("", "-1"):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", value)
        assert visible_gpus() == ()


def test_grids_follow(make_config, backend, control):
    """A scene whose grid cannot be built is replaced, also when it was simulated meanwhile; a maker that dies of one
    grid is replaced and builds it.
    """
    config = make_config(training_scenes=3, validation_scenes=0, test_scenes=0)
    (control / f"gridless-{scene_seed(0, 'train', 0, 0)}").touch()
    (control / f"kill-grid-{scene_seed(0, 'train', 1, 0)}").touch()
    recorder = generate(config, backend)
    manifest = Manifest.load(config.dataset.folder)
    assert manifest.complete
    (failure,) = manifest.quarantined
    assert (failure.key, failure.cause) == ("train-000000", "a surface too large")
    assert len(recorder.messages) == 2


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
    """One that says nothing."""

    def __init__(self):
        Worker.__init__(self)
        self.killed, self.idle = False, True

    def tell(self, message):
        pass

    def kill(self):
        self.killed = True


def test_stopped_solver_is_replaced(make_config, monkeypatch):
    """A solver that has work and says nothing for too long (SIGSTOP, a device that hangs) is ended; one without work
    is left alone, and so are all when the pool was stopped, too. Its scene is tried again by another."""
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
    assert recorder.messages[0].startswith("a worker died (it said nothing for 600 s); it is replaced")
    assert solvers[0].killed and solvers[0].heard_at > 1000 and list(passes) == [250]
