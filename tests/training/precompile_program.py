"""Lists the launches of a small update twice, and compiles one kernel, under a driver that needs no GPU."""

from dataclasses import replace

from no_gpu import use_h100

from hgn.config import NetworkConfig
from hgn.kernels.update.op import UpdateSettings
from hgn.runtime.precompile_program import FrameJob, PrecompileJob, compile_part, launches_of
from hgn.step_config import StepConfig

use_h100()
settings = UpdateSettings(2, 1e-3, True, 1 / 64)
network = NetworkConfig(width=16, levels=2, message_passing_steps=2)
job = PrecompileJob(network, settings, "fp16", True, True, 300, (200, 60), 90)
expected = set(launches_of(job, "cpu"))
assert set(launches_of(job)) == expected and len(expected) > 30, len(expected)
last = len(expected) - 1
rolling = replace(job, pushforward_scenes=(3,))
with_frames = set(launches_of(rolling, "cpu"))
assert set(launches_of(rolling)) == with_frames > expected, len(with_frames)
assert compile_part(job, last, len(expected)) == 1
# frames: of two precisions each has kernels of its own, and a network with fewer levels only tables of its own
frames = FrameJob(((network, StepConfig(), "fp16"),), ((300, 200), (40_000, 20_000)), 90)
both = replace(frames, networks=(*frames.networks, (network, StepConfig(), "tf32")))
shallow = replace(frames, networks=(*frames.networks, (replace(network, levels=1), StepConfig(), "fp16")))
found = set(launches_of(frames, "cpu"))
assert set(launches_of(frames)) == found and len(found) > len(set(launches_of(replace(frames, sizes=frames.sizes[:1]))))
held = replace(frames, networks=(*frames.networks, (network, StepConfig(obstacle_clearance=1e-3), "fp16")))
assert set(launches_of(held)) == set(launches_of(held, "cpu")) and len(set(launches_of(held)) - found) == 1
assert set(launches_of(both)) > found and len(set(launches_of(shallow)) - found) < 8
