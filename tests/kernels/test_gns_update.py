"""GNS's training updates on the device against the reference network under torch's Adam and Muon."""

import copy

import pytest
import torch
from kernels.engines import device
from kernels.test_update import episode, one_with_obstacles, parameters_of, plain_updates
from kernels.test_update import updates_of as hgn_updates_of
from network.states import gns_of

from hgn.kernels.gns.update import GnsUpdates
from hgn.schema import ConfigError
from hgn.training.muon import Muon
from hgn.training.parity import require_parity

PRECISION = "fp32" if device().type == "cpu" else "fp16"


def updates_of(network, scenes, edges=0, **changes):
    return hgn_updates_of(network, scenes, (edges,) if edges else (), GnsUpdates, PRECISION, **changes)


@pytest.mark.parametrize("optimizer", ["adam", "muon"])
def test_updates_are_those_of_torch(optimizer):
    """Three updates of two scenes, with and without obstacles, weighted, of fewer particles after more: losses and
    parameters are those of autograd in float64 with torch's Adam or with Muon; an update that needs more room for edges
    than there is gets it, and is repeated."""
    network = gns_of(message_passing_steps=2, cell_size=0.1)
    small, grid = episode(1, 5, True)
    open_space, none = episode(2, 3, False)
    dense, other = episode(3, 9, True, spread=0.05)
    chunk = [
        [(small, 0, 1, 0.3), (open_space, 1, 2)],
        [(dense, 2, 3), (open_space, 0, 4, 1.7)],
        [(small, 1, 5), (open_space, 2, 6)],
    ]
    rates = [1e-3, 3e-4, 1e-3]
    updates = updates_of(network, 2, edges=48, optimizer=optimizer)
    updates.run(chunk, rates)
    assert updates.growths == 1 and updates.capacities[0] >= 1.5 * 90
    reference = copy.deepcopy(network)
    muon = Muon(reference, 1.0) if optimizer == "muon" else None
    losses = plain_updates(reference, chunk, [[grid, none], [other, none], [grid, none]], rates, muon)
    total, count = updates.loss_sum.tolist()
    exact = PRECISION == "fp32"
    assert count == 3 and total == pytest.approx(sum(losses), rel=1e-5 if exact else 1e-2)
    expected = torch.cat([p.detach().flatten() for p in reference.parameters()])
    before = torch.cat([p.detach().flatten() for p in network.parameters()])
    error = float((parameters_of(updates) - expected).norm() / (expected - before).norm())
    assert error < (1e-3 if exact else 0.6)  # Adam turns small gradients into signs
    assert int(updates.step) == 3 and updates.counters[1] == 3 and updates.counters[2] == 0


def test_wrong_kernels_are_refused():
    """Before the first update outputs and gradients are compared with the reference network's on the noisy batch, under
    symmetries: they agree to rounding, and what computes another network is refused with the remedy."""
    network = gns_of(message_passing_steps=1, cell_size=0.1)
    samples, episodes = one_with_obstacles()
    updates = updates_of(network, 2, noise_std=1e-3)
    updates.predict(samples)
    assert max(require_parity(updates, episodes)) < (1e-3 if PRECISION == "fp32" else 0.1)
    updates.values.mul_(1.3)
    updates.predict(samples)
    with pytest.raises(ConfigError, match=r"must be torch on this machine.*set training.backend=torch"):
        require_parity(updates, episodes)


def test_what_is_left_of_other_updates_does_no_harm():
    """Rows beyond the particles may hold anything, NaN too: the same losses, the same gradients."""
    network = gns_of(message_passing_steps=1, cell_size=0.1)
    made, _ = episode(1, 5, True)
    found = []
    for rest in (0.0, float("nan")):
        updates = updates_of(network, 1, edges=64)
        updates.predict([(made, 0, 1)])
        for tensor in (updates.position_N3, updates.velocity_NV, updates.fused.output_gradient, updates.feature_NF):
            tensor[5:] = rest
        updates.run([[(made, 0, 1)]], [1e-3])
        found.append((updates.loss_sum.tolist(), parameters_of(updates)))
    assert found[0][0] == found[1][0] and found[0][0][1] == 1 and torch.equal(found[0][1], found[1][1])


def test_positions_must_be_within_reach():
    """Positions that are not finite, or too far away for a cell's key, end the training with what is wrong."""
    network = gns_of(message_passing_steps=1, cell_size=0.1)
    for wild, message in ((float("nan"), "must be finite"), (1e5, "must be within 3277 domain units")):
        made, _ = episode(1, 4, False)
        made.position_TN3[:, 2, 0] = wild
        with pytest.raises(ConfigError, match=message):
            updates_of(network, 1, edges=64).run([[(made, 0, 1)]], [1e-3])
