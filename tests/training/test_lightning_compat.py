"""What hgn.training.lightning_compat takes for granted of Lightning."""

from lightning.pytorch import Trainer
from lightning.pytorch.strategies import DDPStrategy

from hgn.training import lightning_compat


def test_canary():
    """The private parts that are replaced exist, and only backend torch is wrapped in DistributedDataParallel."""
    lightning_compat.quieten()
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False)
    loop = trainer.fit_loop.epoch_loop
    assert callable(loop._broadcast_sigterm_tensor)
    lightning_compat.skip_sigterm_broadcast(trainer)
    assert loop._broadcast_sigterm_tensor() is None
    trainer._signal_connector.received_sigterm = True
    lightning_compat.forget_sigterm(trainer)
    assert not trainer.received_sigterm
    torch_strategy, triton_strategy = map(lightning_compat.gradient_averaging, ("torch", "triton"))
    assert type(torch_strategy) is DDPStrategy
    assert type(triton_strategy).configure_ddp is not DDPStrategy.configure_ddp
