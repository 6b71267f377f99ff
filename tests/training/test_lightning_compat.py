"""What hgn.training.lightning_compat takes for granted of Lightning."""

import torch
from lightning.pytorch import LightningModule, Trainer
from torch.utils.data import DataLoader, IterableDataset

from hgn.training import lightning_compat


class Endless(IterableDataset[torch.Tensor]):
    def __iter__(self):
        return iter(lambda: torch.zeros(1), None)


class Manual(LightningModule):
    """Each step makes three updates by itself, as chunks do."""

    def __init__(self):
        super().__init__()
        self.automatic_optimization = False
        self.layer = torch.nn.Linear(1, 1)

    def training_step(self, batch, index):
        lightning_compat.count_updates(self.trainer, 3)
        scheduler = self.lr_schedulers()
        assert isinstance(scheduler, torch.optim.lr_scheduler.LambdaLR)
        lightning_compat.advance_scheduler(scheduler, 1.0, self.global_step)

    def configure_optimizers(self):
        optimizer = torch.optim.Adam(self.layer.parameters(), lr=1.0)
        return [optimizer], [torch.optim.lr_scheduler.LambdaLR(optimizer, lambda update: 0.1**update)]


def test_canary(tmp_path):
    """Updates that kernels made count as Lightning's own: the loop ends after them, the scheduler's next step goes on
    from there, and a checkpoint of another count is gone on with at that count. The hooks that are replaced exist."""
    options = {"accelerator": "cpu", "logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    lightning_compat.quieten()
    trainer, module = Trainer(max_steps=6, max_epochs=-1, enable_model_summary=False, **options), Manual()
    loop = trainer.fit_loop.epoch_loop
    assert callable(loop._broadcast_sigterm_tensor)
    lightning_compat.skip_sigterm_broadcast(trainer)
    data = DataLoader(Endless(), batch_size=None)
    trainer.fit(module, data)
    assert trainer.global_step == 6 and trainer.lr_scheduler_configs[0].scheduler.get_last_lr() == [0.1**6]
    trainer.lr_scheduler_configs[0].scheduler.optimizer.step()
    trainer.lr_scheduler_configs[0].scheduler.step()
    assert trainer.optimizers[0].param_groups[0]["lr"] == 0.1**7
    trainer._signal_connector.received_sigterm = True
    lightning_compat.forget_sigterm(trainer)
    assert not trainer.received_sigterm
    strategies = [lightning_compat.gradient_averaging(path, "fp32") for path in ("torch", "triton")]
    plain, rounding = (type(strategy).configure_ddp for strategy in strategies)
    assert plain is not rounding
    trainer.save_checkpoint(tmp_path / "last.ckpt")
    stored = torch.load(tmp_path / "last.ckpt", weights_only=True)
    lightning_compat.set_stored_updates(stored, 9)
    torch.save(stored, tmp_path / "last.ckpt")
    again = Trainer(max_steps=12, max_epochs=-1, enable_model_summary=False, **options)
    again.fit(Manual(), data, ckpt_path=tmp_path / "last.ckpt", weights_only=True)
    assert again.global_step == 12
