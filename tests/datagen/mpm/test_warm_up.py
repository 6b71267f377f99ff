"""The kernels that a solver compiles while makers draw the first scenes are those of its launches."""

import pytest

from datagen.generate import datagen_config
from datagen.mpm import solver
from datagen.mpm.device import Device
from datagen.mpm.launch import Launch
from hgn.command import _compose
from hgn.scene.random_scene import generate_scene


# these numbers of scenes contain all that a launch of several hundred contains
@pytest.mark.parametrize(("experiment", "count"), [("obstacles", 3), ("own_physics", 20)])
def test_a_warm_up_compiles_the_kernels_of_a_launch(experiment, count, monkeypatch):
    kernels = []

    class Compiled(Launch):
        """Collects what chooses a kernel, in place of a launch on a GPU."""

        def __init__(self, team, teams, *batch):
            super().__init__(*batch)
            kernels.append((self.variant, team))

        def _node_array(self, nodes):
            return None

        def _advance(self, frames):
            raise NotImplementedError

        def run(self, *_):
            return [None] * len(self.scenes)

        def release(self):
            pass

    monkeypatch.setattr("sys.argv", ["datagen", f"+experiment={experiment}"])
    config = datagen_config(_compose("datagen")[0])
    gpu = Device("cuda", 1, processors=132)
    monkeypatch.setattr(solver, "initialise", lambda *_: gpu)
    monkeypatch.setattr(solver, "memory_bytes", lambda _: 1e12)
    monkeypatch.setattr(solver, "TeamLaunch", Compiled)
    solver.warm_up(config.scene, config.mpm, 400)
    scenes = [generate_scene(config.scene, 1000 + seed) for seed in range(count)]
    team = solver._team(gpu, [scene.particle_count for scene in scenes] * (400 // count))
    solver.simulate(scenes, config.mpm, 2, 60.0, team=team)
    assert len({*kernels}) == 1, kernels
