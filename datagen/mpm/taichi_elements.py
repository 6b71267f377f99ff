"""python -m datagen.mpm.taichi_elements FOLDER INPUT OUTPUT THREADS: runs a local copy of Taichi Elements, timed.

A process of its own, with Taichi's default options, so that neither solver changes the other's. FOLDER is a checkout of
github.com/taichi-dev/taichi_elements; INPUT an .npz with position_N3, velocity_N3, material_N (ours), frames and
frame_s; OUTPUT an .npz with position_TN3 and seconds_T of each frame after the first state; THREADS those of a CPU,
or 0 for a GPU.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
import time

import numpy as np

OWN_MATERIAL = (0, 3, 2)  # its numbers of water, sand and snow
MAXIMUM_PARTICLES = 2**20
GPU_MEMORY_GB = 8  # its default of 1 is too little for its grid


def main(folder: str, source: str, target: str, threads: str) -> None:
    """Simulates what `source` holds and writes `target`."""
    import taichi as ti

    sys.path.insert(0, folder)
    given = np.load(source)
    with contextlib.redirect_stdout(io.StringIO()):
        if int(threads) == 0:
            ti.init(arch=ti.cuda, device_memory_GB=GPU_MEMORY_GB, log_level=ti.ERROR)
        else:
            ti.init(arch=ti.cpu, cpu_max_num_threads=int(threads), log_level=ti.ERROR)
        module = importlib.import_module("engine.mpm_solver")
        solver = module.MPMSolver(res=(64, 64, 64), use_voxelizer=False, max_num_particles=MAXIMUM_PARTICLES)
        solver.set_gravity((0, -9.8, 0))
        material = np.array(OWN_MATERIAL, np.int32)[given["material_N"]]
        count = len(material)
        solver.read_restart(count, given["position_N3"], given["velocity_N3"], material, np.zeros(count, np.int32))
        positions, seconds = [given["position_N3"]], []
        for _ in range(int(given["frames"]) - 1):
            begin = time.perf_counter()
            solver.step(float(given["frame_s"]))
            ti.sync()
            seconds.append(time.perf_counter() - begin)
            positions.append(solver.particle_info()["position"])
    np.savez(target, position_TN3=np.stack(positions), seconds_T=np.array(seconds))


if __name__ == "__main__":
    main(*sys.argv[1:])
