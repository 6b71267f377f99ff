"""Whole data sets of the ballistic stand-in, made in this process."""

from concurrent.futures import wait

import ballistic_solver

from datagen.pool.shard import stage_episode
from datagen.pool.worker import MadeScene, Parcel, make_episode
from datagen.pool.writer import DatasetWriter


def stage(writer, split, index):
    """Simulates one episode in this process and stages it; the writer claims what comes before it too."""
    while (split, index) not in writer.remaining():
        assert writer.claim_next()
    config, task = writer.config, writer.task(split, index)
    scene = ballistic_solver.generate_scene(config.scene, task.seed)
    grid = ballistic_solver.build_obstacle_grid((), scene.cell_size, 0, scene.domain_size)
    (result,) = ballistic_solver.simulate([scene], config.mpm, config.dataset.frames_of(index), 60.0)
    episode = make_episode(MadeScene(task, Parcel(scene), grid), result, config, writer.config_hash)
    stage_episode(writer.folder, episode)
    writer.add_staged(split, index)


def publish(writer):
    """Waits until shards are packed; publishes the first of these, and returns its entry, or None without one."""
    if (entry := writer.publish_next()) is None:
        wait(writer._packing.values())
        entry = writer.publish_next()
    return entry


def make_dataset(config):
    """Makes a whole data set, or what is missing of it, without any worker process."""
    with DatasetWriter(config) as writer:
        while writer.claim_next():
            for split, index in writer.remaining():
                stage(writer, split, index)
            publish(writer)
        assert writer.complete
    return writer.folder
