"""python -m tools.studies.large [--json FILE]: one frame of a scene of 10 million particles with backend triton.

The scene is one block of particles over and over, so far apart that blocks do not meet, and by whole cells of the
coarsest level. So each block must get the accelerations of one alone, which are compared with PyTorch's; then memory
and times are told.
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from hgn.command import run_command
from hgn.config import NetworkConfig, Precision
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.parity import relative_error
from hgn.runtime.precompile import precompile_frames
from hgn.schema import Positive, from_mapping, require, require_bounds
from hgn.system.files import write_json
from hgn.system.provenance import provenance
from tools.bench.contenders import BOUNDS, bench_network, verdict
from tools.bench.states import Workload, state_of
from tools.report import EXIT_RED, PASS
from tools.timing import once

GAP_CELLS = 4  # of the coarsest level between two blocks, and around all
FRAMES = 3  # that are timed


@dataclass(frozen=True)
class LargeConfig:
    """`python -m tools.studies.large`: how many particles, and at which precision."""

    particles: Positive[int] = 10_000_000
    block: Positive[int] = 100_000  # particles of it
    precision: Precision = "fp16"
    network: NetworkConfig = field(default_factory=NetworkConfig)
    json: str | None = None

    def __post_init__(self) -> None:
        require_bounds(self)
        require(self.particles % self.block == 0, "particles", f"a multiple of block ({self.block})", self.particles)


def main(mapping: dict[str, Any]) -> int:
    """Prints and stores one row; the exit code is 1 where a block's accelerations are not those of one alone."""
    config = from_mapping(LargeConfig, mapping)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    row = measured(config, device)
    print(json.dumps(row))
    if config.json is not None:
        write_json(config.json, {"meta": provenance(device.type), "rows": [row]})
    return 0 if row["check"] == PASS else EXIT_RED


def measured(config: LargeConfig, device: torch.device) -> dict[str, Any]:
    """The scene's row: check, and where that passes milliseconds of a frame and gigabytes of the GPU's memory."""
    # Triton, which backend torch does without, is loaded here.
    from hgn.runtime.triton_rollout import TritonRollout

    network = bench_network(config.network, device)
    assert isinstance(network, HierarchicalGraphNetwork)
    ahead = precompile_frames([config.network], [config.precision], device, [config.block, config.particles])
    block, scene = states(config, device)
    if ahead is not None:
        with ahead:
            print(ahead.wait(), file=sys.stderr)
    alone = TritonRollout(network, block, config.precision)
    alone.frame_launches()
    expected_N3 = alone.fused.output[: config.block, :3].clone()
    with torch.no_grad():
        reference_N3 = network.normalised_acceleration(block)
    check = verdict("one block's output", relative_error(expected_N3, reference_N3), BOUNDS[config.precision])
    del alone, reference_N3
    rollout = TritonRollout(network, scene, config.precision)
    rollout._network_pass()
    found_BN3 = rollout.fused.output[:, :3].view(-1, config.block, 3)
    worst = max(relative_error(found_N3, expected_N3) for found_N3 in found_BN3)
    if check == PASS:
        check = verdict("a block among others", worst, BOUNDS[config.precision])
    row = {
        "case": "large", "particles": config.particles, "precision": config.precision, "check": check,
        "cells": int(rollout.grid.needed_L[0]), "relative_error": worst, "ms": None, "memory_gb": None,
    }  # fmt: skip
    graph = rollout.graph
    if check == PASS and graph is not None:  # on a GPU

        def frame() -> None:
            rollout.frame.zero_()
            graph.replay()

        times = [once(frame, device) for _ in range(FRAMES)]
        row |= {"ms": min(times), "memory_gb": torch.cuda.max_memory_allocated(device) / 1e9}
    return row


def states(config: LargeConfig, device: torch.device) -> tuple[ParticleState, ParticleState]:
    """One block alone, and all of them."""
    network, count = config.network, config.particles // config.block
    block = state_of(Workload(config.block, 1), network, device)
    coarsest = network.cell_size * 2 ** (network.levels - 1)
    gap = GAP_CELLS * coarsest
    pitch = coarsest * math.ceil((float(block.domain_S3[0, 0]) + gap) / coarsest)
    side = math.ceil(count ** (1 / 3) - 1e-9)
    place_B3 = torch.cartesian_prod(*[torch.arange(side, device=device)] * 3).view(-1, 3)[:count]
    position_N3 = block.position_N3 + gap
    everywhere_N3 = (position_N3[None] + (pitch * place_B3.double()).float()[:, None]).view(-1, 3)
    one_S3, all_S3 = (torch.full_like(block.domain_S3, blocks * pitch + gap) for blocks in (1, side))
    scene = ParticleState(
        everywhere_N3, block.velocity_NM3.repeat(count, 1, 1), block.material_N.repeat(count),
        block.scene_N.repeat(count), all_S3, block.gravity_S3, None,
    )  # fmt: skip
    return replace(block, position_N3=position_N3, domain_S3=one_S3), scene


if __name__ == "__main__":
    run_command(main, "large")
