"""Tests the assumptions of hgn.training.lightning_compat about Lightning."""

import logging

import pytest
from lightning.fabric.utilities import distributed
from lightning.pytorch import Trainer
from lightning.pytorch.plugins.environments import LightningEnvironment, SLURMEnvironment, TorchElasticEnvironment
from lightning.pytorch.strategies import DDPStrategy

from hgn.training import lightning_compat


def test_canary():
    """The private parts that are replaced exist, and only backend torch is wrapped in DistributedDataParallel. The
    module that prints each process's rank is silent."""
    lightning_compat.quieten()
    assert distributed.log.isEnabledFor(logging.WARNING) and not distributed.log.isEnabledFor(logging.INFO)
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


SRUN = {f"SLURM_{name}": "0" for name in ("STEP_ID", "PROCID", "LOCALID", "NODEID")}
SRUN |= {"SLURM_NTASKS": "2", "SLURM_NNODES": "1", "SLURM_JOB_NAME": "x"}
JSRUN = {f"JSM_NAMESPACE_{name}": "1" for name in ("SIZE", "LOCAL_SIZE")} | {"JSM_NAMESPACE_LOCAL_RANK": "0"}
JSRUN |= {"LSB_JOBID": "1", "LSB_DJOB_RANKFILE": "/dev/null", "JSM_NAMESPACE_RANK": "0"}
BY_HAND = {"RANK": "1", "LOCAL_RANK": "0", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "1"}


@pytest.mark.parametrize(
    ("variables", "environment", "rank"),
    [
        (SRUN, SLURMEnvironment, 0),  # srun --ntasks 2
        (SRUN | {"SLURM_PROCID": "1", "SLURM_NTASKS_PER_NODE": "4"}, SLURMEnvironment, 1),  # in a job of 4 tasks
        (BY_HAND, TorchElasticEnvironment, 1),
        (SRUN | BY_HAND, TorchElasticEnvironment, 1),
        (SRUN | {"RANK": "0", "WORLD_SIZE": "1"}, LightningEnvironment, 0),
        ({"SLURM_NTASKS": "4", "SLURM_JOB_NAME": "x"}, LightningEnvironment, 0),
        (JSRUN, LightningEnvironment, 0),
        ({}, LightningEnvironment, 0),
    ],
)
def test_launchers(monkeypatch, variables, environment, rank):
    """Lightning takes the ranks of the launcher that `layout` recognised, however many tasks a machine has."""
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    strategy, launcher = lightning_compat.gradient_averaging("torch"), lightning_compat.own_launcher()
    quiet = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar"), False)
    trainer = Trainer(accelerator="cpu", devices=2, strategy=strategy, plugins=launcher, **quiet)
    own = trainer.strategy.cluster_environment
    own.validate_settings(2, 1)
    assert isinstance(own, environment) and trainer.global_rank == rank
