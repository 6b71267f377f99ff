"""Gradients that travel in bfloat16: what rounding leaves out is sent later, so the loss falls as with float32."""

import pytest
import torch
import torch.distributed as dist
from torch.nn.parallel import DistributedDataParallel

from hgn.training.distributed import RoundedSum, averaging_options, rounded_average


@pytest.fixture
def alone(tmp_path):
    """A group of this process alone."""
    dist.init_process_group("gloo", init_method=f"file://{tmp_path / 'store'}", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


def test_nothing_is_lost(alone):
    """Over many updates the sums that come out are those that went in, to one rounding of the last one; each alone is
    as far off as bfloat16 is. Updates that are void, or not finite, come and go without a trace."""
    generator = torch.Generator().manual_seed(0)
    sums, went_in, came_out, apart = RoundedSum(-1), torch.zeros(1000), torch.zeros(1000), 0.0
    for update in range(200):
        gradient = torch.cat([1e-3 + 1e-6 * torch.randn(1000, generator=generator), torch.zeros(1)])
        expected = gradient[:-1].clone()
        if update % 10 == 3:
            void = torch.cat([torch.full((1000,), 7.7), torch.ones(1)])
            sums(void)
            sums(torch.full((1001,), float("nan")))
        sums(gradient)
        went_in += expected
        came_out += gradient[:-1]
        apart = max(apart, float((gradient[:-1] - expected).abs().max()))
    assert apart > 1e-6
    assert float((came_out - went_in).abs().max()) < 1e-5  # 200 roundings of 2e-6 one way would be 4e-4


@pytest.mark.parametrize("ranks", [1, 3])
def test_average(alone, monkeypatch, ranks):
    """A message is half as long, and its sum becomes an average."""
    sent: list[torch.Tensor] = []
    original = dist.all_reduce

    def several(tensor, **options):
        sent.append(tensor)
        return original(tensor.mul_(ranks), **options)

    monkeypatch.setattr(dist, "all_reduce", several)
    monkeypatch.setattr(dist, "get_world_size", lambda: ranks)
    layer = torch.nn.Linear(4, 3, bias=False)
    model = DistributedDataParallel(layer, **averaging_options())
    model.register_comm_hook(RoundedSum(), rounded_average)
    x = torch.randn(8, 4)
    model(x).sum().backward()
    assert sent[-1].dtype == torch.bfloat16 and sent[-1].numel() == 12
    assert layer.weight.grad is not None
    torch.testing.assert_close(layer.weight.grad, x.sum(0).expand(3, 4), rtol=1e-2, atol=1e-3)


def test_loss(alone):
    """A fit whose gradients are far apart in size ends at float32's loss; without feedback it stays above it."""

    def loss(hook):
        torch.manual_seed(0)
        x = torch.randn(64, 16, dtype=torch.float32) * torch.logspace(0, -2, 16)
        target = x @ torch.randn(16, 1)
        layer = torch.nn.Linear(16, 1, bias=False)
        model = DistributedDataParallel(layer, **averaging_options())
        if hook is not None:
            model.register_comm_hook(hook, rounded_average)
        optimizer = torch.optim.SGD(layer.parameters(), lr=0.5)
        for _ in range(400):
            optimizer.zero_grad()
            error = (model(x) - target).square().mean()
            error.backward()
            optimizer.step()
        return float(error.detach())

    assert loss(RoundedSum()) == pytest.approx(loss(None), rel=1e-2)
