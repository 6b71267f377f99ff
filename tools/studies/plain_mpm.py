"""The honest floor of the solver's times: explicit MLS-MPM as plainly as Taichi lets one write it.

A dense grid, one launch each to clear it, to scatter, to update and to gather; no obstacles, no counters, no output.
Water, sand (Drucker and Prager) and snow as in Taichi Elements. The method is that of Hu et al. 2018.
"""

import time

import numpy as np
import taichi as ti

from hgn.scene.material import SAND, SNOW, WATER
from hgn.scene.scene import Scene

WALL = 3  # nodes
MODULUS, RATIO, DENSITY = 1e6, 0.2, 1000.0
MU, LAMBDA = MODULUS / (2 * (1 + RATIO)), MODULUS * RATIO / ((1 + RATIO) * (1 - 2 * RATIO))
SINE = float(np.sin(np.deg2rad(45.0)))
SLOPE = float(np.sqrt(2 / 3)) * 2 * SINE / (3 - SINE)
HARDENING, COMPRESSION, STRETCH = 10.0, 0.025, 0.0045


@ti.data_oriented
class PlainMpm:
    """The same scene `copies` times side by side; positions float32 [copies N, 3], in units of the domain."""

    def __init__(self, scene: Scene, copies: int, substeps: int, step_s: float) -> None:
        self.nodes, self.cell = round(scene.domain_size[0] / scene.cell_size), scene.cell_size
        self.substeps, self.step = substeps, step_s
        self.gravity, self.of_scene = scene.gravity, scene.particle_count
        count = copies * scene.particle_count
        self.x, self.v = ti.Vector.field(3, ti.f32, count), ti.Vector.field(3, ti.f32, count)
        self.C, self.F = ti.Matrix.field(3, 3, ti.f32, count), ti.Matrix.field(3, 3, ti.f32, count)
        self.volume, self.material = ti.field(ti.f32, count), ti.field(ti.i32, count)
        self.grid = ti.Vector.field(4, ti.f32, (copies, self.nodes, self.nodes, self.nodes))
        self.x.from_numpy(np.tile(scene.position_N3, (copies, 1)).astype(np.float32))
        self.v.from_numpy(np.tile(scene.velocity_N3, (copies, 1)).astype(np.float32))
        self.material.from_numpy(np.tile(scene.material_N, copies).astype(np.int32))
        self.F.from_numpy(np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)))
        self.volume.from_numpy(np.tile(np.where(np.asarray(scene.material_N) == SAND, 0, 1), copies).astype(np.float32))

    def frame(self) -> None:
        for _ in range(self.substeps):
            self.substep()

    @ti.func
    def stress(self, p: ti.i32):
        out = ti.Matrix.zero(ti.f32, 3, 3)
        if self.material[p] == WATER:
            self.volume[p] *= 1 + self.step * self.C[p].trace()
            J = self.volume[p]
            out = ti.Matrix.identity(ti.f32, 3) * LAMBDA * J * (J - 1)
        else:
            U, S, V = ti.svd((ti.Matrix.identity(ti.f32, 3) + self.step * self.C[p]) @ self.F[p])
            if self.material[p] == SNOW:
                h = ti.min(ti.exp(HARDENING * (1 - self.volume[p])), 100.0)
                J = 1.0
                for d in ti.static(range(3)):
                    bounded = ti.min(ti.max(S[d, d], 1 - COMPRESSION), 1 + STRETCH)
                    self.volume[p] *= S[d, d] / bounded
                    S[d, d] = bounded
                    J *= bounded
                R = U @ V.transpose()
                F = U @ S @ V.transpose()
                self.F[p] = F
                out = 2 * MU * h * (F - R) @ F.transpose() + ti.Matrix.identity(ti.f32, 3) * LAMBDA * h * J * (J - 1)
            else:
                strain = ti.Vector([ti.log(ti.max(S[d, d], 1e-4)) for d in range(3)])
                trace = strain.sum() + self.volume[p]
                deviator = strain - trace / 3
                if trace >= 0:
                    self.volume[p] = trace
                    strain *= 0
                else:
                    self.volume[p] = 0
                    size = deviator.norm() + 1e-20
                    excess = size + (3 * LAMBDA + 2 * MU) / (2 * MU) * trace * SLOPE
                    strain -= deviator * ti.max(excess, 0.0) / size
                tension = 2 * MU * strain + LAMBDA * strain.sum()
                for d in ti.static(range(3)):
                    S[d, d] = ti.exp(strain[d])
                self.F[p] = U @ S @ V.transpose()
                out = (
                    U @ ti.Matrix([[tension[i] if i == j else 0.0 for j in range(3)] for i in range(3)]) @ U.transpose()
                )
        return out

    @ti.kernel
    def substep(self):
        for node in ti.grouped(self.grid):
            self.grid[node] = ti.Vector([0.0, 0.0, 0.0, 0.0])
        for p in self.x:
            base = ti.floor(self.x[p] / self.cell - 0.5, ti.i32)
            fx = self.x[p] / self.cell - base
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            A = self.C[p] - self.step * 4 / (self.cell**2 * DENSITY) * self.stress(p)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                v = self.v[p] + A @ ((ti.Vector([i, j, k]) - fx) * self.cell)
                share = w[i][0] * w[j][1] * w[k][2] * ti.Vector([v[0], v[1], v[2], 1.0])
                self.grid[p // self.of_scene, base[0] + i, base[1] + j, base[2] + k] += share
        for s, i, j, k in self.grid:
            mass = self.grid[s, i, j, k][3]
            if mass > 0:
                for d, index in ti.static(((0, i), (1, j), (2, k))):
                    v = self.grid[s, i, j, k][d] / mass + self.step * self.gravity[d]
                    if index < WALL:
                        v = ti.max(v, 0.0)
                    if index >= self.nodes - WALL:
                        v = ti.min(v, 0.0)
                    self.grid[s, i, j, k][d] = v
        for p in self.x:
            base = ti.floor(self.x[p] / self.cell - 0.5, ti.i32)
            fx = self.x[p] / self.cell - base
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            v = ti.Vector([0.0, 0.0, 0.0])
            C = ti.Matrix.zero(ti.f32, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                whole = self.grid[p // self.of_scene, base[0] + i, base[1] + j, base[2] + k]
                share = w[i][0] * w[j][1] * w[k][2] * ti.Vector([whole[0], whole[1], whole[2]])
                v += share
                C += 4 / self.cell * share.outer_product(ti.Vector([i, j, k]) - fx)
            self.v[p], self.C[p] = v, C
            self.x[p] += self.step * v


def plain_milliseconds(
    scene: Scene, copies: int, substeps: int, step_s: float, frames: int
) -> tuple[float, np.ndarray]:
    """Milliseconds a frame of the second half of so many, and where particles of the first copy end, float32 [N, 3]."""
    solver = PlainMpm(scene, copies, substeps, step_s)
    begin = 0.0
    for frame in range(frames):
        if frame == frames // 2:
            ti.sync()
            begin = time.perf_counter()
        solver.frame()
    ti.sync()
    taken = 1e3 * (time.perf_counter() - begin) / (frames - frames // 2)
    return taken, solver.x.to_numpy()[: scene.particle_count]
