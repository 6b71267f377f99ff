"""Our GNS against the public PyTorch Geometric code, where PUBLIC_GNS names a copy of github.com/geoelements/gns."""

import importlib.util
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from hgn.config import NetworkConfig
from hgn.runtime.parity import relative_error
from hgn.schema import ConfigError
from tools.bench.public_gns import PublicFrame, PublicGns, PublicTrain, load_public
from tools.bench.states import Workload

COPY = os.environ.get("PUBLIC_GNS")
CPU = torch.device("cpu")
SMALL = NetworkConfig(kind="gns", levels=1, width=32, message_passing_steps=3)
needs_copy = pytest.mark.skipif(
    COPY is None or importlib.util.find_spec("torch_geometric") is None,
    reason="needs PUBLIC_GNS=<a copy of github.com/geoelements/gns> and PyTorch Geometric",
)


@needs_copy
@pytest.mark.parametrize("config", [SMALL, replace(SMALL, obstacle_features=False)])
def test_our_gns_with_their_weights_is_their_function(config):
    """In float32 both give the same output to 1e-5, several scenes at once, and the same loss."""
    assert COPY is not None
    public = PublicGns(Path(COPY), config, Workload(300, 2), CPU)
    with torch.no_grad():
        theirs, _ = public.output(public.batch.window_WN3)
        ours = public.network.normalised_acceleration(public.batch.state())
    assert theirs.abs().max() > 0.1
    assert relative_error(ours, theirs) < 1e-5
    assert PublicFrame(Path(COPY), config, Workload(100, 1), CPU).check("fp32") == "pass"
    train = PublicTrain(Path(COPY), config, Workload(100, 2), CPU)
    assert train.check("fp32") == "pass"
    before = train.simulator.state_dict()["_particle_type_embedding.weight"].clone()
    train.run()
    assert not torch.equal(train.simulator.state_dict()["_particle_type_embedding.weight"], before)


def test_a_folder_without_the_code(tmp_path):
    """A wrong folder is named, with where to get the code."""
    with pytest.raises(ConfigError, match=r"public_gns must be a local copy.*geoelements/gns"):
        load_public(tmp_path)
