"""Shards and manifest: the same input gives the same bytes, and no interruption leaves anything half-written."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import io
import json
import os
import subprocess
import tarfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from threading import Event, Lock, current_thread
from typing import Any

import ballistic_solver
import numpy as np
import pytest
import webdataset

import datagen.shard
import datagen.writer
from datagen.plan import ShardRange, scene_seed
from datagen.shard import locate_members
from datagen.writer import MAXIMUM_REPLACEMENTS, DatasetWriter
from hgn.config import DatagenConfig, DatasetConfig, MpmConfig, SceneConfig
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.data.statistics import Moments
from hgn.schema import ConfigError

MakeConfig = Callable[..., DatagenConfig]
MakeDataset = Callable[[DatagenConfig], Path]
Stage = Callable[[DatasetWriter, str, int], None]


def hashes(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.glob("*.tar"))}


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != ".lock"
    }


def test_dataset_is_complete_and_in_order(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """Every episode is published in shards of growing size; the manifest's last revision lists them all."""
    folder = make_dataset(make_config())
    manifest = Manifest.load(folder)
    assert manifest.complete and manifest.revision == len(manifest.shards)
    assert [shard.name for shard in manifest.shards] == [
        "train-000000-000001.tar",
        "validation-000000-000001.tar",
        "train-000001-000002.tar",
        "validation-000001-000002.tar",
        "train-000002-000004.tar",
        "train-000004-000005.tar",
        "test-000000-000001.tar",
    ]
    assert {path.name for path in folder.iterdir()} == {*hashes(folder), "manifest.json", ".lock"}


def test_same_input_gives_same_bytes(make_config: MakeConfig, make_dataset: MakeDataset, tmp_path: Path) -> None:
    """Two folders made from one config are bitwise equal, manifest included."""
    folders = [make_dataset(make_config(folder=str(tmp_path / name))) for name in ("one", "other")]
    assert hashes(folders[0]) == hashes(folders[1])
    assert (folders[0] / "manifest.json").read_bytes() == (folders[1] / "manifest.json").read_bytes()


def test_headers_tell_nothing_of_the_machine(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """Tar headers hold no time, owner or umask."""
    folder = make_dataset(make_config())
    with tarfile.open(folder / "train-000002-000004.tar") as tar:
        for info in tar:
            assert (info.mtime, info.uid, info.gid, info.uname, info.gname, info.mode) == (0, 0, 0, "", "", 0o644)


# WebDataset leaves the file it iterated over to the garbage collector
@pytest.mark.filterwarnings("ignore:Exception ignored in. <_io.FileIO:pytest.PytestUnraisableExceptionWarning")
def test_plain_tar_and_webdataset_read_shards(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """Any tar program and a plain WebDataset pipeline read a shard without this project."""
    folder = make_dataset(make_config())
    shard = folder / "train-000002-000004.tar"
    names = subprocess.run(["tar", "-tf", shard], capture_output=True, text=True, check=True).stdout.split()
    assert names[:6] == [
        f"train-000002.{name}"
        for name in (
            "position.npy",
            "velocity.npy",
            "material.npy",
            "obstacle_cell.npy",
            "obstacle_normal.npy",
            "json",
        )
    ]
    samples = list(webdataset.WebDataset(str(shard), shardshuffle=False).decode())
    stored = EpisodeStore(folder, "train").episodes[2:4]
    assert [sample["__key__"] for sample in samples] == ["train-000002", "train-000003"]
    for sample, episode in zip(samples, stored, strict=True):
        assert np.array_equal(sample["position.npy"], episode.position_TN3)
        assert np.array_equal(sample["material.npy"], episode.material_N)
        assert sample["json"]["seed"] == episode.seed


def test_offsets_lead_to_the_data(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """The manifest's offsets hold a whole .npy file each, so a window of frames can be read alone."""
    folder = make_dataset(make_config())
    for shard in Manifest.load(folder).shards:
        content = (folder / shard.name).read_bytes()
        for entry in shard.episodes:
            offset, size = entry.members["position.npy"]
            position = np.load(io.BytesIO(content[offset : offset + size]), allow_pickle=False)
            assert position.shape == (entry.frames, entry.particles, 3)


def test_manifest_statistics_equal_direct_ones(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """Statistics over all shards of a split equal those computed from all its episodes at once."""
    folder = make_dataset(make_config())
    statistics = Manifest.load(folder).statistics("train")
    positions = [np.asarray(episode.position_TN3, np.float64) for episode in EpisodeStore(folder, "train").episodes]
    for moments, order in ((statistics.velocity, 1), (statistics.acceleration, 2)):
        values = np.concatenate([np.diff(position, n=order, axis=0).reshape(-1, 3) for position in positions])
        assert moments.count == len(values)
        np.testing.assert_allclose(moments.mean, values.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(moments.std, values.std(axis=0), rtol=1e-9)
    assert Manifest.load(folder).statistics("test").velocity != Moments()


class InterruptionError(Exception):
    """A stand-in for a crash."""


@pytest.mark.parametrize("call", [1, 2, 3, 4, 5, 8, 13, 18, 23])
def test_resume_after_a_crash_makes_the_same_shards(
    make_config: MakeConfig,
    make_dataset: MakeDataset,
    stage: Stage,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    control: Path,
    call: int,
) -> None:
    """Wherever a run stops, running again gives bitwise the same shards and simulates no staged episode twice."""
    whole = make_dataset(make_config(folder=str(tmp_path / "whole")))
    (control / "simulated.log").unlink()
    config = make_config(folder=str(tmp_path / "cut"))
    calls = 0

    def crash(path: Path) -> None:
        nonlocal calls
        calls += 1
        if calls == call:
            raise InterruptionError

    stage_parts = datagen.shard.stage_parts

    def stage_and_crash(folder: Path, key: str, parts: Iterable[bytes]) -> None:
        stage_parts(folder, key, parts)
        crash(folder)

    with monkeypatch.context() as patch:
        # the last step of each staging and of each shard, so a crash there is a crash between files
        patch.setattr(datagen.shard, "stage_parts", stage_and_crash)
        patch.setattr(datagen.writer, "sync_folder", crash)
        patch.setattr("hgn.files.sync_folder", crash)
        try:
            make_dataset(config)
        except InterruptionError:
            assert Path(config.dataset.folder).exists()
    make_dataset(config)
    assert hashes(Path(config.dataset.folder)) == hashes(whole)
    assert Manifest.load(config.dataset.folder).complete
    seeds = (control / "simulated.log").read_text().split()
    assert len(seeds) == len(set(seeds)) == 8


def test_growth_keeps_what_is_there(
    make_config: MakeConfig, make_dataset: MakeDataset, tmp_path: Path, control: Path
) -> None:
    """Asking for more scenes later adds just those; shards that were published keep their bytes and places."""
    small, large = (make_config(training_scenes=count, folder=str(tmp_path / "grown")) for count in (3, 9))
    folder = make_dataset(small)
    before, published = hashes(folder), Manifest.load(folder).shards
    make_dataset(large)
    after = Manifest.load(folder)
    assert after.shards[: len(published)] == published
    assert before.items() <= hashes(folder).items()
    assert [(shard.first, shard.stop) for shard in after.shards_of("train")] == [
        (0, 1),
        (1, 2),
        (2, 3),
        (3, 4),
        (4, 8),
        (8, 9),
    ]
    assert after.requested["train"] == 9 and after.complete
    seeds = (control / "simulated.log").read_text().split()
    assert len(seeds) == len(set(seeds)) == 9 + 2 + 1
    direct = make_dataset(make_config(training_scenes=9, folder=str(tmp_path / "direct")))
    for grown, made in zip(EpisodeStore(folder, "train").episodes, EpisodeStore(direct, "train").episodes, strict=True):
        assert np.array_equal(grown.position_TN3, made.position_TN3) and grown.seed == made.seed


@pytest.mark.parametrize("count", [5, 3])
def test_complete_folder_stays_untouched(make_config: MakeConfig, make_dataset: MakeDataset, count: int) -> None:
    """Asking again for what is there, or for less of it, changes no file."""
    folder = make_dataset(make_config())
    before = snapshot(folder)
    with DatasetWriter(make_config(training_scenes=count)) as writer:
        assert writer.complete and writer.claim_next() is None
    assert snapshot(folder) == before


def test_asking_for_less_ends_an_unfinished_dataset(make_config: MakeConfig, stage: Stage) -> None:
    """A folder begun for five episodes and asked for one is complete when that one is there."""
    with DatasetWriter(make_config()) as writer:
        stage(writer, "train", 0)
        writer.publish_next()
    with DatasetWriter(make_config(training_scenes=1, validation_scenes=0, test_scenes=0)) as writer:
        assert writer.complete
    assert Manifest.load(writer.folder).complete


OTHER_CONFIGS: list[tuple[dict[str, Any], str]] = [
    ({"scene": SceneConfig(obstacle_count=3)}, "scene.obstacle_count is 5 there, 3 is asked for"),
    ({"mpm": MpmConfig(snow_hardening=5.0)}, "mpm.snow_hardening is 10.0 there, 5.0 is asked for"),
]


@pytest.mark.parametrize(("changes", "message"), OTHER_CONFIGS)
def test_other_settings_are_refused(
    make_config: MakeConfig, make_dataset: MakeDataset, changes: dict[str, Any], message: str
) -> None:
    """A folder takes no episodes of another distribution, and the message names the keys and the remedy."""
    config = make_config()
    folder = make_dataset(config)
    before = snapshot(folder)
    with (
        pytest.raises(ConfigError, match=f"holds another data set: {message}; choose another folder"),
        DatasetWriter(dataclasses.replace(config, **changes)),
    ):
        pass
    assert snapshot(folder) == before


@pytest.mark.parametrize("changes", [{"seed": 1}, {"frames": 7}, {"frame_rate_hz": 30.0}])
def test_other_dataset_settings_are_refused(
    make_config: MakeConfig, make_dataset: MakeDataset, changes: dict[str, Any]
) -> None:
    """Seed, length and frame rate belong to the data set's identity."""
    make_dataset(make_config())
    with pytest.raises(ConfigError, match=next(iter(changes))), DatasetWriter(make_config(**changes)):
        pass


def test_where_and_how_fast_is_no_identity(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """Device, launch size, workers, attempts and shard size may change between runs of one data set."""
    config = make_config()
    make_dataset(config)
    dataset = dataclasses.replace(config.dataset, workers=3, maximum_attempts=1, episodes_per_shard=2)
    mpm = MpmConfig(device="gpu", scenes_per_launch=64)
    with DatasetWriter(DatagenConfig(dataset=dataset, mpm=mpm)) as writer:
        assert writer.complete


def test_data_of_another_schema_is_refused(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """A manifest of another version is refused with the remedy, and stays as it is."""
    folder = make_dataset(make_config())
    mapping = json.loads((folder / "manifest.json").read_text()) | {"schema_version": 99}
    (folder / "manifest.json").write_text(json.dumps(mapping))
    with pytest.raises(ConfigError, match=r"schema_version must be 1, got 99; .* or use the version that made it"):
        make_dataset(make_config())


def claim_all(writer: DatasetWriter) -> list[tuple[str, int]]:
    while writer.claim_next():
        pass
    return writer.remaining()


def test_generators_share_a_folder(
    make_config: MakeConfig, make_dataset: MakeDataset, stage: Stage, tmp_path: Path, control: Path
) -> None:
    """Each of two generators makes the shards that it claims; what one leaves behind the other makes; each sees what
    the other published."""
    whole = make_dataset(make_config(folder=str(tmp_path / "whole")))
    (control / "simulated.log").unlink()
    with DatasetWriter(make_config()) as other:
        with DatasetWriter(make_config()) as writer:
            first, second = writer.claim_next(), other.claim_next()
            assert first and second and not set(writer.remaining()) & set(other.remaining())
            stage(writer, first.split, first.first)
            partial = writer.folder / f".{second.name}.77.partial"
            partial.touch()
            assert writer.publish_next()
            assert claim_all(writer) and other.claim_next() is None and not other.complete
        assert partial.exists() and (other.folder / ".staging").exists()
        other.refresh()
        assert other.done == 1
        for split, index in claim_all(other):
            stage(other, split, index)
        while other.publish_next():
            pass
        assert other.complete
    assert not partial.exists() and not (other.folder / ".staging").exists()
    assert hashes(other.folder) == hashes(whole) and Manifest.load(other.folder).complete
    seeds = (control / "simulated.log").read_text().split()
    assert len(seeds) == len(set(seeds)) == 8


def test_first_writer_wins(make_config: MakeConfig, stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where locks do not hold, two generators make a shard; the second copy is dropped, and it is listed once."""
    monkeypatch.setattr("datagen.claims.Claims.take", lambda self, shard: True)
    messages: list[str] = []
    with DatasetWriter(make_config()) as writer, DatasetWriter(make_config(), messages.append) as other:
        assert writer.claim_next() == other.claim_next()
        stage(writer, "train", 0)
        stage(other, "train", 0)
        assert writer.publish_next()
        before = snapshot(writer.folder)
        assert other.publish_next() == writer.manifest.shards[0]
        assert snapshot(writer.folder) == before
    assert messages == ["train-000000-000001.tar was published by another generator; this copy is dropped"]
    assert len(Manifest.load(writer.folder).shards) == 1


def test_array_tasks_make_one_dataset(
    make_config: MakeConfig, make_dataset: MakeDataset, tmp_path: Path, control: Path
) -> None:
    """Three tasks of an array make all shards once between them, each knowing nothing of the others."""
    whole = make_dataset(make_config(folder=str(tmp_path / "whole")))
    (control / "simulated.log").unlink()
    for task in range(3):
        folder = make_dataset(make_config(array_task=task, array_tasks=3))
        assert Manifest.load(folder).complete == (task == 2)
    assert hashes(folder) == hashes(whole)
    seeds = (control / "simulated.log").read_text().split()
    assert len(seeds) == len(set(seeds)) == 8


@pytest.mark.parametrize("seconds", [0, 2**33])
def test_no_clock_is_asked(
    make_config: MakeConfig, make_dataset: MakeDataset, stage: Stage, tmp_path: Path, seconds: int
) -> None:
    """Machines whose clocks stand in 1970 or far in the future, beside others', make the same data set: no time of a
    file says whether it is whole, left behind or new."""
    whole = make_dataset(make_config(folder=str(tmp_path / "whole")))

    def turn_back(folder: Path) -> None:
        for path in (*folder.rglob("*"), folder):
            os.utime(path, (seconds, seconds))

    with DatasetWriter(make_config()) as writer:
        store = None
        for index in range(2):
            with DatasetWriter(make_config()) as other:
                stage(other, "train", index)
                (writer.folder / ".staging" / f".train-00000{index}.tar.77.partial").touch()
                turn_back(writer.folder)
                other.publish_next()
                turn_back(writer.folder)
            store = store or EpisodeStore(writer.folder, "train")
            store.refresh()
            writer.refresh()
            assert len(store) == len(store.episodes[:]) == writer.done == index + 1
    make_dataset(make_config())
    turn_back(writer.folder)
    assert hashes(make_dataset(make_config())) == hashes(whole)
    assert not list(writer.folder.rglob("*.partial"))


def test_manifest_is_rebuilt_from_the_shards(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """A lost manifest costs nothing: published shards are verified and listed again."""
    folder = make_dataset(make_config())
    before = {shard.name: shard for shard in Manifest.load(folder).shards}
    (folder / "manifest.json").unlink()
    with DatasetWriter(make_config()) as writer:
        assert writer.complete
    assert {shard.name: shard for shard in Manifest.load(folder).shards} == before


def test_shards_of_another_dataset_are_not_adopted(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """Without a manifest a shard of other settings is still recognised and refused."""
    folder = make_dataset(make_config())
    (folder / "manifest.json").unlink()
    config = dataclasses.replace(make_config(), scene=SceneConfig(obstacle_count=3))
    with pytest.raises(ConfigError, match="belongs to another data set; move the file out"), DatasetWriter(config):
        pass


def test_missing_shard_is_made_again(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """A shard that was deleted, the remedy for an altered one, is made again and listed."""
    folder = make_dataset(make_config())
    before = hashes(folder)
    (folder / "train-000002-000004.tar").unlink()
    messages: list[str] = []
    with DatasetWriter(make_config(), messages.append) as writer:
        assert claim_all(writer) == [("train", 2), ("train", 3)]
    assert "train-000002-000004.tar is listed in the manifest but missing" in messages[0]
    make_dataset(make_config())
    assert hashes(folder) == before


def test_unlisted_shard_that_was_cut_is_refused(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """A shard is adopted only when it holds its whole range; a cut at a member boundary does not pass."""
    folder = make_dataset(make_config())
    shard = folder / "train-000002-000004.tar"
    located = locate_members(shard)
    start = located["train-000003"]["position.npy"][0] - 512
    shard.write_bytes(shard.read_bytes()[:start])
    (folder / "manifest.json").unlink()
    with (
        pytest.raises(ConfigError, match="must hold train-000002, train-000003, got train-000002; delete it"),
        DatasetWriter(make_config()),
    ):
        pass


def test_broken_staged_file_is_made_again(make_config: MakeConfig, make_dataset: MakeDataset, stage: Stage) -> None:
    """A staged file that does not read back is dropped and its episode made again."""
    with DatasetWriter(make_config()) as writer:
        stage(writer, "train", 1)
    staged = writer.folder / ".staging" / "train-000001.tar"
    staged.write_bytes(staged.read_bytes()[:2000])
    messages: list[str] = []
    with DatasetWriter(make_config(), messages.append) as writer:
        assert ("train", 1) in claim_all(writer)
    assert "the episode is made again" in messages[0]
    make_dataset(make_config())


def test_quarantined_seed_is_replaced(make_config: MakeConfig, stage: Stage) -> None:
    """The next attempt's seed takes the place, the manifest keeps seed and cause, and a later run goes on there."""
    config = make_config()
    with DatasetWriter(config) as writer:
        replacement = writer.quarantine(writer.task("train", 0), "diverged")
        assert replacement.seed == scene_seed(0, "train", 0, attempt=1)
    with DatasetWriter(config) as writer:
        assert writer.task("train", 0) == replacement
        stage(writer, "train", 0)
        writer.publish_next()
    manifest = Manifest.load(writer.folder)
    (failure,) = manifest.quarantined
    assert (failure.key, failure.seed, failure.cause) == (
        "train-000000",
        scene_seed(0, "train", 0, attempt=0),
        "diverged",
    )
    (entry,) = manifest.shards[0].episodes
    assert (entry.attempt, entry.seed) == (1, replacement.seed)


def test_scenes_that_never_work_end_in_an_error(make_config: MakeConfig) -> None:
    """A distribution none of whose scenes can be simulated ends with the cause, not in an endless loop."""
    with DatasetWriter(make_config()) as writer:
        task = writer.task("train", 0)
        with pytest.raises(ConfigError, match=r"train-000000 could not be simulated with 20 seeds, .*: too stiff;"):
            for _ in range(MAXIMUM_REPLACEMENTS):
                task = writer.quarantine(task, "too stiff")


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
    """After the given number of further syncs the disk is full."""
    real = os.fsync
    left = -1
    counting = Lock()

    def fsync(descriptor: int) -> None:
        nonlocal left
        with counting:
            left -= 1
            full = left == -1
        if full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(descriptor)

    def fill(after: int) -> None:
        nonlocal left
        left = after

    monkeypatch.setattr(os, "fsync", fsync)
    yield fill
    left = -1


@pytest.mark.parametrize("after", range(5))
def test_full_disk_leaves_nothing_half_written(
    make_config: MakeConfig, make_dataset: MakeDataset, stage: Stage, full_disk: Callable[[int], None], after: int
) -> None:
    """A full disk at any step keeps what was there and leaves no partial file; with space the run goes on."""
    with DatasetWriter(make_config()) as writer:
        stage(writer, "train", 0)
        writer.publish_next()
        before = hashes(writer.folder)
    with (
        pytest.raises(OSError, match=r"No space left on device: .*data"),
        DatasetWriter(make_config()) as writer,
    ):
        full_disk(after)
        for index in (1, 2, 3):
            stage(writer, "train", index)
            writer.publish_next()
    assert before.items() <= hashes(writer.folder).items()
    assert not list(writer.folder.rglob("*.partial"))
    assert len(Manifest.load(writer.folder).shards) in (1, 2)
    make_dataset(make_config())
    assert Manifest.load(writer.folder).complete


def test_dataset_without_some_splits(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """Splits may be empty."""
    folder = make_dataset(make_config(validation_scenes=0, test_scenes=0, training_scenes=1))
    assert Manifest.load(folder).complete and len(EpisodeStore(folder, "test")) == 0


def test_partial_files_are_removed(make_config: MakeConfig, make_dataset: MakeDataset) -> None:
    """What a killed run was writing is removed by the next."""
    config = make_config()
    folder = Path(config.dataset.folder)
    (folder / ".staging").mkdir(parents=True)
    for path in (folder / ".train-000000-000001.tar.77.partial", folder / ".staging" / ".train-000001.tar.77.partial"):
        path.write_bytes(b"half")
    make_dataset(config)
    assert not list(folder.rglob("*.partial"))


def test_default_dataset_is_the_papers() -> None:
    """800 training, 5 validation and 20 test scenes."""
    assert [DatasetConfig().scenes(split) for split in ("train", "validation", "test")] == [800, 5, 20]
    assert ballistic_solver.simulate([], MpmConfig(), 2, 60.0) == []


def test_packing_is_not_waited_for(make_config: MakeConfig, stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pool goes on listening to its workers while shards are packed, and publishes what is packed first."""
    with DatasetWriter(make_config(validation_scenes=0, test_scenes=0)) as writer:
        shards = list(iter(writer.claim_next, None))
        for split, index in writer.remaining():
            stage(writer, split, index)
        going_on = Event()

        def pack(shard: ShardRange, own: Callable[[ShardRange], Any] = writer._pack) -> Any:
            assert shard != shards[0] or going_on.wait(60)
            return own(shard)

        monkeypatch.setattr(writer, "_pack", pack)
        published: list[str] = []
        while len(published) < len(shards):
            entry = writer.publish_next(wait=False)
            published += [entry.name] if entry else []
            if len(published) == len(shards) - 1:
                assert shards[0].name not in published and writer.packing and not writer.complete
                going_on.set()
        assert published[-1] == shards[0].name and writer.complete and not writer.packing


def test_shards_that_wait_are_packed_together(
    make_config: MakeConfig, stage: Stage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where several shards are ready they are packed side by side, published in order, and are the same files."""
    with DatasetWriter(make_config()) as writer:
        while writer.claim_next():
            pass
        for split, index in writer.remaining():
            stage(writer, split, index)
        packed_by = []
        monkeypatch.setattr(
            writer, "_pack", lambda shard, pack=writer._pack: (packed_by.append(current_thread()), pack(shard))[1]
        )
        while writer.publish_next():
            pass
        assert writer.complete and len(set(packed_by)) > 1
        together = hashes(writer.folder)
    with DatasetWriter(make_config(folder=str(tmp_path / "alone"))) as alone:
        while alone.claim_next():
            pass
        for split, index in alone.remaining():
            stage(alone, split, index)
            alone.publish_next()
        assert {name: digest for name, digest in hashes(alone.folder).items() if name.endswith(".tar")} == {
            name: digest for name, digest in together.items() if name.endswith(".tar")
        }


@pytest.mark.parametrize("after", range(0, 12, 2))
def test_full_disk_while_several_are_packed(
    make_config: MakeConfig, make_dataset: MakeDataset, stage: Stage, full_disk: Callable[[int], None], after: int
) -> None:
    """A full disk in any of several packers ends the run with its message and no partial file; then it goes on."""
    with (
        pytest.raises(OSError, match=r"No space left on device: .*data"),
        DatasetWriter(make_config()) as writer,
    ):
        while writer.claim_next():
            pass
        for split, index in writer.remaining():
            stage(writer, split, index)
        full_disk(after)
        while writer.publish_next():
            pass
    assert not list(writer.folder.rglob("*.partial"))
    make_dataset(make_config())
    assert Manifest.load(writer.folder).complete
