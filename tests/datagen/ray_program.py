"""Generates on a Ray cluster of two nodes on loopback, kills one of them midway, and compares what comes out with a
data set made in one process; prints it as JSON.

Run as `python ray_program.py FOLDER`, with this folder on the path and BALLISTIC_FOLDER set.
"""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

from ballistic_dataset import make_dataset
from ballistic_solver import BALLISTIC
from ray.cluster_utils import Cluster
from written_files import differences

from datagen.generate import generate
from datagen.pool.progress import Progress
from hgn.config import DatagenConfig, DatasetConfig

STORE_BYTES = 80 * 2**20


class Killer(Progress):
    """Kills a node once three episodes are there."""

    def __init__(self, cluster, node):
        self.cluster, self.node, self.episodes, self.messages = cluster, node, 0, []

    def episode(self, key):
        self.episodes += 1
        if self.episodes == 3:
            self.cluster.remove_node(self.node, allow_graceful=False)

    def message(self, text):
        self.messages.append(text)


def main(folder):
    cluster = Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": 2, "object_store_memory": STORE_BYTES, "include_dashboard": False},
    )
    second = cluster.add_node(num_cpus=2, object_store_memory=STORE_BYTES)
    try:
        os.environ["RAY_ADDRESS"] = cluster.address
        dataset = DatasetConfig(
            folder=f"{folder}/shared", training_scenes=10, validation_scenes=2, test_scenes=0, frames=6, pool="ray"
        )
        killer = Killer(cluster, second)
        finished = generate(DatagenConfig(dataset=dataset), killer, lambda: False, BALLISTIC)
    finally:
        cluster.shutdown()
    peaceful, shared = Path(folder) / "peaceful", Path(folder) / "shared"
    make_dataset(DatagenConfig(dataset=replace(dataset, folder=str(peaceful), pool="local")))
    report = {
        "finished": finished,
        "episodes": killer.episodes,
        "messages": killer.messages,
        "differences": differences(peaceful, shared),
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main(sys.argv[1])
