"""Runs whole frames of all scenes in a launch, with a team of GPU threads for each scene."""

import gc
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from datagen.mpm.launch import Launch, device_array
from datagen.mpm.layout import BLOCK, BLOCK_NODES, COUNT, FIELD, LIVE, TAG, VARIANT, has_solid
from hgn.schema import ConfigError

import taichi as ti  # isort: skip

from datagen.mpm import team_kernel  # isort: skip
from datagen.mpm.device_memory import address  # isort: skip
from datagen.mpm.host_copy import HostCopy  # isort: skip
from datagen.mpm.team_sync import APART, SEGMENT, SYNC_LENGTH  # isort: skip
from datagen.mpm.team_transfers import LANES  # isort: skip

LAUNCH_SECONDS = 6.0  # target time of a launch; determines its frames. Scenes wait for each other at the launch's end
MAXIMUM_OUTPUT_BYTES = 2**30  # largest size of a launch's positions
MAXIMUM_PARTICLES = (2**31 - 1) // (2 * FIELD.solid)  # largest number of particles whose fields int32 can count
SHARED_BLOCKS = 8  # smallest number of blocks with which `divided` keeps the team's number
LATENCY = 0.5  # time of a substep without particles (30 µs) in units of the time that a particle per thread adds
PAUSE = 0.8  # fraction of a launch's expected time in which the host sleeps
SHORT_SECONDS = 0.1  # launches that are expected to be shorter are awaited without sleep
PATIENCE = (2**31 - 1, 2**22)  # largest number of reads of a counter on a CPU, and on a GPU, where 2^22 take seconds


class Team(NamedTuple):
    """The thread blocks that compute a scene. They wait for each other, so all must run concurrently."""

    threads: int  # threads per block: a multiple of 32 on a GPU, 1 on a CPU; 0: no team, one launch per substep
    blocks: int = 1
    run: int = 8  # number of particles that a thread sums, in the order of their cells, before it adds to nodes


def divided(count_B: np.ndarray, substeps_B: np.ndarray, room: int, team: Team) -> tuple[int, int]:
    """Returns the numbers of teams and of blocks per team that are expected to end a launch first.

    A scene takes substeps * (particles per thread + LATENCY). A launch takes as long as its longest scene, or as all
    scenes divided by the number of teams. If `team` has one block, or SHARED_BLOCKS or more, its number is used.
    Otherwise the `room` blocks that can run concurrently are divided, with at least `team.blocks` for each team.
    """
    most = min(room // team.blocks, len(count_B))
    if team.blocks == 1 or team.blocks >= SHARED_BLOCKS:
        return most, team.blocks
    teams_T = np.arange(most, 0, -1)
    blocks_T = room // teams_T
    time_TB = substeps_B * (count_B / (team.threads * blocks_T[:, None]) + LATENCY)
    best = int(np.maximum(time_TB.max(1), time_TB.sum(1) / teams_T).argmin())
    return int(teams_T[best]), int(blocks_T[best])


class BlocksApartError(Exception):
    """Blocks that wait for each other did not run concurrently."""


class TeamLaunch(Launch):
    """Runs a batch with teams. Particles are in one array, field by field, in two copies."""

    entries_a_node = 2 * LANES

    def __init__(self, team: Team, teams: int, *batch: Any) -> None:
        super().__init__(*batch)
        transfers_each_step = self.config.choices.transfer_speed_m_s is None
        self.variant += VARIANT.each_step * (self.config.fixed_time_step_s is not None or transfers_each_step)
        self.team, self.teams, self.room = team, min(teams, len(self.scenes)), teams * team.blocks
        if self.particles > MAXIMUM_PARTICLES:
            raise ConfigError(
                f"a batch must have at most {MAXIMUM_PARTICLES} particles, got {self.particles} of {len(self.scenes)} "
                "scenes; lower scenes_per_launch"
            )
        fields = FIELD.solid if has_solid(self.variant) else FIELD.fluid
        self.state = ti.ndarray(ti.f32, 2 * fields * self.particles)
        tag = np.zeros((2, TAG.length, self.particles), np.int32)
        order = self._order()
        tag[0, TAG.origin] = order - np.repeat(self.particle_begin[:-1], np.diff(self.particle_begin))
        self.tag = device_array(tag.ravel())
        self.rank, self.column_list = (ti.ndarray(ti.i32, self.particles) for _ in range(2))
        self.cell_count = ti.ndarray(ti.i32, self.all_blocks * BLOCK_NODES)
        self.column_count = ti.ndarray(ti.i32, self.all_blocks * BLOCK_NODES // BLOCK)
        self.strained = device_array(np.full(self.particles, -1, np.float32))
        self.covered = ti.ndarray(ti.f32, self.particles)
        self.spread = ti.ndarray(ti.i32, self.particles)
        self.response = ti.ndarray(ti.f32, 6 * self.particles)
        self.block = ti.ndarray(ti.i32, 8 * self.all_blocks)
        self.turn = ti.ndarray(ti.i32, len(self.scenes))
        self.sync = ti.ndarray(ti.i32, (self.teams + 1) * SYNC_LENGTH + len(self.scenes))
        self.columns = ti.ndarray(ti.i32, SEGMENT * self.room)
        self.host_copy = HostCopy()
        for array in (
            self.cell_count,
            self.column_count,
            self.covered,
            self.spread,
            self.block,
            self.columns,
            self.node,
        ):
            array.fill(0)
        self.live = device_array(np.zeros(len(self.scenes) * LIVE.length, np.int32))
        team_kernel.start_team(
            self.state, self.tag, *(
                device_array(np.concatenate([getattr(scene, name) for scene in self.scenes]).astype(np.float32).ravel())
                for name in ("position_N3", "velocity_N3")
            ), self.label, self.law_row, device_array(order), self.counter, self.law, fields,
        )  # fmt: skip

    def _order(self) -> np.ndarray:
        """Returns the particles in the order in which the kernel sorts them, int32 [P]."""
        keys = []
        for index, scene in enumerate(self.scenes):
            base = np.floor(scene.position_N3 / scene.cell_size - 0.5).astype(np.int32)
            block = self._places(base) // BLOCK_NODES + np.int64(index * self.scene_nodes // BLOCK_NODES)
            column = (block * BLOCK + base[:, 0] % BLOCK) * BLOCK + base[:, 2] % BLOCK
            keys.append(column * BLOCK + base[:, 1] % BLOCK)
        return np.argsort(np.concatenate(keys), kind="stable").astype(np.int32)

    def release(self) -> None:
        self.host_copy.release()
        super().release()

    def _node_array(self, nodes: int) -> ti.ScalarNdarray:
        return ti.ndarray(ti.f32, self.entries_a_node * nodes)

    def _advance(self, frames: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        most = max(1, MAXIMUM_OUTPUT_BYTES // (12 * self.particles))
        done, size, substeps, expected = 0, min(1, frames), np.zeros(len(self.scenes), np.int64), 0.0
        ran = np.ones(len(self.scenes), np.int64)  # substeps in the last launch
        self._launch(0, ran)  # compiles the kernel
        self._require_together()
        begin, output = time.perf_counter(), self._launch(size, ran)
        while size:
            # Taichi keeps the interpreter's lock while it waits for the device; this sleep lets other threads run
            pause = PAUSE * min(expected * size, LAUNCH_SECONDS)
            if pause > SHORT_SECONDS:
                time.sleep(max(0.0, begin + pause - time.perf_counter()))
            woken = time.perf_counter()
            position = self.host_copy.read(output).reshape(size, self.particles, 3)
            taken = time.perf_counter() - begin
            if pause > SHORT_SECONDS and taken < 1.05 * (woken - begin):  # the launch may have ended during the sleep
                taken *= 0.5
            self._require_together()
            total = self.counter.to_numpy()[:, COUNT.substeps]
            completed = self.live.to_numpy().reshape(-1, LIVE.length)[:, LIVE.frames].astype(np.int64)
            ran, substeps = total - substeps, total
            done += size
            expected = taken / size
            size = min(max(1, min(2 * size, int(LAUNCH_SECONDS / expected))), most, frames - done)
            del output  # before the next launch: memory may be freed only while the device is idle
            gc.collect(0)  # frees its reference cycle; see solver: collection is not automatic
            # the device computes while the caller processes these frames
            begin, output = time.perf_counter(), self._launch(size, ran)
            yield position, completed

    def _require_together(self) -> None:
        if self.team.blocks > 1 and self.sync.to_numpy()[APART]:
            raise BlocksApartError

    def _launch(self, frames: int, substeps: np.ndarray) -> ti.ScalarNdarray:
        """Starts `frames` frames of the scenes. Returns the array of their positions, valid when the device is done.

        `substeps` are those of the last launch. Scenes with much work come first, so that few teams idle at the end.
        """
        output = ti.ndarray(ti.f32, 3 * max(frames, 1) * self.particles)
        count = np.diff(self.particle_begin)
        self.turn.from_numpy(np.argsort(-substeps * count, kind="stable").astype(np.int32))
        self.sync.fill(0)
        teams, blocks = divided(count, substeps, self.room, self.team)
        # one frame per turn: with longer turns many teams would have no scene during the last turns
        stretch = 1 if teams < len(self.scenes) else max(frames, 1)
        team_kernel.advance(
            frames, stretch, teams, blocks, PATIENCE[self.team.threads > 1], self.frame_s,
            address(self.state), address(self.node), self.node.shape[0], self.tag, self.rank, self.strained,
            self.covered, self.spread, self.response, self.hidden, self.cell_count, self.column_count,
            self.column_list, self.block, self.live, self.columns, self.sync, self.turn, self.scene_value,
            self.counter, self.setting, self.law, self.shape, self.contact, self.contact_normal, self.pose, output,
            self.variant, self.team.threads, self.team.blocks > 1, self.team.run,
        )  # fmt: skip
        return output
