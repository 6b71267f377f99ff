"""Checkpoints on disk: reading, checking against a configuration, and taking the network out.

Nothing here needs Lightning: export and resume checks read plain containers and tensors.
"""

from __future__ import annotations

import pickle
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from hgn.config import NetworkConfig, TrainConfig
from hgn.data.sampler import SamplerState
from hgn.network.base import ParticleNetwork
from hgn.network.build import build_network
from hgn.renamed import current_names
from hgn.runtime.weights import find_weights, load_weights
from hgn.schema import ConfigError, from_stored, to_mapping

SECTION = "hgn"  # the checkpoint's key for what is ours
LAST_NAMES = ("last.ckpt", "last-1.ckpt", "last-2.ckpt")  # newest first
BEST_NAME = "best.ckpt"  # of the lowest one-step validation error; none where no validation scene was measured
_ZIP_FAULTS = (zipfile.BadZipFile, zlib.error, NotImplementedError)
NETWORK, AVERAGED = "network.", "averaged."  # prefixes of the tensors: as trained, and their moving average


class DamagedError(ConfigError):
    """A checkpoint's bytes are not those that were written."""


@dataclass(frozen=True)
class DataInfo:
    """What a network must remember of the data it was trained on."""

    config_hash: str
    frame_rate_hz: float
    obstacle_cell_size: float
    gravity: tuple[float, float, float] = (0.0, -9.8, 0.0)
    maximum_initial_speed: float | None = None  # of the groups, domain units per second; null: not known


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint's content; only plain containers and tensors are ever loaded.

    Raises: DamagedError when it is cut or any bit of it changed, which torch would not notice; ConfigError when the
    file is missing, or no checkpoint of this project.
    """
    try:
        with zipfile.ZipFile(path) as records:
            if (damaged := records.testzip()) is not None:
                raise zlib.error(f"{damaged} has another CRC")
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        last, remedy = path.with_name(LAST_NAMES[0]), "hgn.train writes one"
        if path.name == BEST_NAME and last.is_file():
            remedy = f"no validation scene was measured, so take {last}"
        raise ConfigError(f"checkpoint must be an existing file, got {path}; {remedy}") from None
    except (RuntimeError, EOFError, ValueError, KeyError, OSError, pickle.UnpicklingError, *_ZIP_FAULTS) as error:
        reason = str(error).strip().split("\n")[0]
        raise DamagedError(f"checkpoint must be a whole checkpoint file, got {path}: {reason}") from None
    if not isinstance(checkpoint, dict) or SECTION not in checkpoint:
        raise ConfigError(f"checkpoint must be one of python -m hgn.train, got {path}")
    return checkpoint


def check_checkpoint(checkpoint: dict[str, Any], config: TrainConfig, config_hash: str, path: Path) -> None:
    """Refuses to resume a checkpoint of another configuration.

    Raises: ConfigError naming the first key that differs.
    """
    remedy = "set it so, or choose another run=FOLDER"
    # Through the dataclass: a key that is younger than the checkpoint has its default in it.
    stored, section = _network_config(checkpoint, path), checkpoint[SECTION]
    pairs = _network_pairs(stored, config)
    pairs.append(("training.noise_std", section["noise_std"], config.training.noise_std))  # is in the normaliser
    _require_equal(pairs, f" to resume {path}", remedy)
    if section["data"]["config_hash"] != config_hash:
        raise ConfigError(
            f"dataset.folder must hold the data set that {path} was trained on, got another one (config hash "
            f"{config_hash[:12]} instead of {section['data']['config_hash'][:12]}); {remedy}"
        )


def _network_pairs(network: NetworkConfig, config: TrainConfig) -> list[tuple[str, Any, Any]]:
    """Each key of the networks' settings: its name, the value there, and the one that is asked for."""
    stored, wanted = to_mapping(network), to_mapping(config.network)
    return [(f"network.{key}", stored[key], wanted[key]) for key in sorted(stored)]


def _require_equal(pairs: list[tuple[str, Any, Any]], why: str, remedy: str) -> None:
    for name, theirs, ours in pairs:
        if theirs != ours:
            raise ConfigError(f"{name} must be {theirs!r}{why}, got {ours!r}; {remedy}")


def network_of_weights(config: TrainConfig) -> ParticleNetwork:
    """The network of training.init_weights, normaliser included, for a new run to begin with. Rest, walls and
    obstacles' clearance may differ from those of the weights: they change no tensor.

    Raises: ConfigError for a file that is none, and where the run wants another network or has other data.
    """
    assert config.training.init_weights is not None
    path = find_weights(config.training.init_weights, "training.init_weights")
    weights, info = load_weights(path, field="training.init_weights")
    remedy = "set it so, or take other training.init_weights"
    free = ("rest_threshold", "wall_clearance", "obstacle_clearance")
    pairs = [pair for pair in _network_pairs(info.network, config) if pair[0].removeprefix("network.") not in free]
    pairs.append(("dataset.frame_rate_hz", info.frame_rate_hz, config.dataset.frame_rate_hz))
    if info.network.obstacle_features:
        pairs.append(("scene.cell_size", info.obstacle_cell_size, config.scene.cell_size))
    _require_equal(pairs, f", as in training.init_weights {path}", remedy)
    network = build_network(config.network)
    network.load_state_dict(weights.state_dict())
    return network


def network_of_checkpoint(checkpoint: dict[str, Any], path: Path) -> ParticleNetwork:
    """The network of a checkpoint, normaliser included, in evaluation mode: the moving average where there is one.

    Raises: ConfigError where this version builds other networks.
    """
    network, state = build_network(_network_config(checkpoint, path)), checkpoint["state_dict"]
    prefix = AVERAGED if any(name.startswith(AVERAGED) for name in state) else NETWORK
    try:
        network.load_state_dict({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
    except RuntimeError as error:
        raise ConfigError(_other_version(path, str(error).split("\n")[1].strip())) from None
    network.eval()
    return network


def _network_config(checkpoint: dict[str, Any], path: Path) -> NetworkConfig:
    try:
        return from_stored(NetworkConfig, checkpoint[SECTION]["network"], "network")
    except ConfigError as error:
        raise ConfigError(_other_version(path, str(error))) from None


def _other_version(path: Path, reason: str) -> str:
    return f"checkpoint must hold a network as this version builds it, got {path}: {reason}; export it with its version"


def sampler_state_of_checkpoint(checkpoint: dict[str, Any]) -> SamplerState:
    """Where in the order of samples the run stood."""
    return from_stored(SamplerState, current_names(checkpoint[SECTION])["sampler_state"], "sampler_state")


def data_of_checkpoint(checkpoint: dict[str, Any]) -> DataInfo:
    """The data set that the network was trained on."""
    return from_stored(DataInfo, checkpoint[SECTION]["data"], "data")


def updates_of_checkpoint(checkpoint: dict[str, Any]) -> int:
    """Updates made when the checkpoint was written."""
    return int(checkpoint[SECTION]["updates"])
