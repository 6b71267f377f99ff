"""Tests the errors of cells' means in the loss."""

import pytest
import torch
from kernels.test_update import episode, updates_of
from network.states import network_of

from hgn.network.grid import build_hierarchy
from hgn.training.cell_means import with_means

pytestmark = pytest.mark.usefixtures("large_tiles")


def test_an_error_that_all_share_counts_once_more_on_each_level():
    """Errors in common are multiplied by 1 + weight times the number of levels. Opposite errors at one place are not
    weighted, and those of two bodies far apart are those of each alone. K is symmetric."""
    generator = torch.Generator().manual_seed(0)
    place_N3 = 0.3 * torch.rand(40, 3, dtype=torch.float64, generator=generator)
    twice_N3 = place_N3.repeat(2, 1)
    grid = build_hierarchy(twice_N3, torch.zeros(80, dtype=torch.long), torch.zeros(1, 3).double(), 0.035, 4)
    error_3 = torch.tensor([0.3, -1.0, 2.0]).double()
    common_N3 = error_3.expand(80, 3)
    torch.testing.assert_close(with_means(common_N3, grid, 0.5), 3 * common_N3)
    opposite_N3 = torch.randn(40, 3, dtype=torch.float64, generator=generator)
    opposite_N3 = torch.cat([opposite_N3, -opposite_N3])
    torch.testing.assert_close(with_means(opposite_N3, grid, 0.5), opposite_N3)
    a_N3, b_N3 = torch.randn(2, 80, 3, dtype=torch.float64, generator=generator)
    products = ((x * with_means(y, grid, 0.5)).sum() for x, y in ((a_N3, b_N3), (b_N3, a_N3)))
    assert next(products) == pytest.approx(float(next(products)), rel=1e-12)


@pytest.mark.parametrize("bodies", [False, True])
def test_the_kernels_have_the_loss_and_the_gradient_of_the_reference(bodies, monkeypatch):
    """Two scenes with loss weights. Without the sums above the finest level loss and gradient differ."""
    network = network_of(torch.float32, inputs="local" if bodies else "absolute")
    made = [episode(1, 40, False)[0], episode(2, 25, False)[0]]
    updates = updates_of(network, 2, cell_mean_weight=3.0)
    updates.predict([(made[0], 1, 3), (made[1], 0, 4, 0.5)])
    monkeypatch.setattr(updates.fused, "backward", lambda: None)  # it writes over the gradient
    updates.launches_before_reduction()
    count = 65
    output_N3 = updates.fused.output[:count, :3].detach().cpu().double().requires_grad_()
    buffers = updates.buffers
    position_N3, scene_N = buffers.position_N3[:count].cpu(), buffers.scene_N[:count].long().cpu()
    grid = build_hierarchy(
        position_N3, scene_N, buffers.origin_S3.cpu(), updates.config.cell_size, updates.config.levels, bodies
    )
    error_N3 = output_N3 - updates.target_N3[:count].cpu()
    loss_weight_N = updates.loss_weight_N[:count].cpu().double()
    loss = ((error_N3 * with_means(error_N3, grid, 3.0)).mean(-1) * loss_weight_N).sum()
    (expected_N3,) = torch.autograd.grad(loss, output_N3)
    found_N3 = updates.fused.output_gradient[:count, :3].cpu().double() * updates.fused.unscale
    torch.testing.assert_close(found_N3, expected_N3, rtol=1e-4, atol=1e-6 * float(expected_N3.abs().max()))
    assert float(updates.loss) == pytest.approx(float(loss.detach()), rel=1e-4)
