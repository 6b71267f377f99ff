"""Checkpoints on disk: reading, comparison with a configuration, and their network.

This module needs no Lightning, because checkpoints consist of plain containers and tensors.
"""

import os
import re
import zipfile
import zlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch.nn import functional

from hgn.config import PRECISIONS, NetworkConfig, TrainConfig
from hgn.data.sampler import SamplerState
from hgn.network.base import ParticleNetwork
from hgn.network.build import build_network
from hgn.network.own_physics import physics_widths
from hgn.renamed import current_names, with_step
from hgn.runtime.weights import WeightsInfo, find_weights, load_weights, network_with
from hgn.schema import (
    Bounded,
    ConfigError,
    NonNegative,
    OrdinarySize,
    Range,
    Vector,
    from_stored,
    near_file,
    no_file,
    require,
    to_mapping,
)
from hgn.step_config import StepConfig
from hgn.system.claims import Claims, require_few_items, require_plain_pickle
from hgn.system.files import opened

SECTION = "hgn"  # key of this project's entries in a checkpoint
LAST_NAMES = ("last.ckpt", "last-1.ckpt", "last-2.ckpt")  # newest first
SAVED = ".saved"  # file in the run's folder after its first checkpoint: only a run without it may begin anew
BEST_NAME = "best.ckpt"  # network with the lowest one-step validation error; no such file before a measurement
_CALLED = re.compile(
    r"collections OrderedDict|torch (\w+Storage|[a-z]\w+|Size)|torch\._utils _rebuild_(tensor_v2|parameter)"
)
NETWORK, AVERAGED = "network.", "averaged."  # prefixes of the names of trained tensors, and of their moving average


class DamagedError(ConfigError):
    """A file is not a whole checkpoint: it was cut or altered, cannot be read, or never was a checkpoint."""


@dataclass(frozen=True)
class DataInfo(Bounded):
    """Facts about the training data. They are stored with the network."""

    config_hash: str
    frame_rate_hz: OrdinarySize
    obstacle_cell_size: OrdinarySize
    gravity: Vector = (0.0, -9.8, 0.0)
    maximum_initial_speed: NonNegative[float] | None = None  # of the groups, domain units per second; None: unknown
    # ranges of friction and of materials' parameters in the data (hgn.scene.own_physics.own_ranges)
    own_ranges: dict[str, Range] = field(default_factory=dict)
    materials: tuple[str, ...] = ()  # materials of the data; empty: all of the network's


@dataclass(frozen=True)
class Progress:
    """The progress of a run when a checkpoint was written."""

    updates: int
    skipped: int  # number of updates skipped because of a gradient that was not finite
    sampler_state: SamplerState  # position in the order of samples
    precision: str | None = None  # precision of the updates; missing in checkpoints of 0.2.0 and before

    @staticmethod
    def of(checkpoint: dict[str, Any]) -> "Progress":
        section = current_names(checkpoint[SECTION])
        remedy = "export a checkpoint of release 0.1.0 with 0.2.0"
        require("sampler_state" in section, "checkpoint sampler_state", "given", None, remedy=remedy)
        state = from_stored(SamplerState, section["sampler_state"], "sampler_state")
        counts = section.get("updates"), section.get("skipped", 0)
        whole = all(type(count) is int and 0 <= count < 2**63 for count in counts)
        require(whole, "checkpoint updates, skipped", "whole numbers", counts)
        precision = section.get("precision")
        require(precision in (None, *PRECISIONS), "checkpoint precision", f"one of {', '.join(PRECISIONS)}", precision)
        return Progress(*counts, state, precision)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Resume:
    """The checkpoint that a run resumes from."""

    path: Path
    progress: Progress
    materials: tuple[str, ...]  # of the data, as in DataInfo


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Returns the content of a checkpoint. Only plain containers and tensors are loaded.

    CRCs are compared, because torch does not detect changed bits. Raises: ConfigError if there is no file, or if its
    content is not that of a checkpoint of this project; DamagedError if it cannot be read as one whole, plain archive;
    OSError of the disk.
    """
    if not path.is_file():  # reading a pipe would wait for ever
        last, remedy = path.parent / LAST_NAMES[0], near_file(path) or "hgn.train writes one"
        of_run = [file for name in (BEST_NAME, *LAST_NAMES) if (file := path / "checkpoints" / name).is_file()]
        if path.name == BEST_NAME and last.is_file():
            remedy = f"no validation scene was measured, so use {last}"
        elif of_run:
            remedy = f"use {of_run[0]}"
        raise no_file("checkpoint", path, remedy)
    with opened(path) as content:
        checkpoint = _read(path, content)
    state = checkpoint.get("state_dict") if isinstance(checkpoint, dict) else None
    plain = isinstance(state, dict) and all(
        isinstance(name, str) and isinstance(tensor, torch.Tensor) for name, tensor in state.items()
    )
    if not plain or not isinstance(checkpoint.get(SECTION), dict):
        raise ConfigError(f"checkpoint must be a file of python -m hgn.train, got {path}")
    for name, tensor in checkpoint["state_dict"].items():
        # updates with other numbers would be skipped; an expanded tensor stands for any number of them
        if tensor.nbytes > tensor.untyped_storage().nbytes() or not tensor.isfinite().all():
            raise DamagedError(f"checkpoint must have finite numbers, each stored, got {path}: {name} has others")
    return checkpoint


def _read(path: Path, file: BinaryIO) -> Any:
    claims, names = Claims(path), set[str]()
    try:
        with zipfile.ZipFile(file) as records:
            _require_one_reading(file, records.start_dir)
            for record in records.infolist():
                claims.add(record.filename, record.file_size)
                if (name := record.filename.lower()) in names:  # torch ignores the case of names
                    raise ValueError(f"it has {record.filename} twice")
                names.add(name)
                if record.compress_type != zipfile.ZIP_STORED:
                    raise ValueError(f"{record.filename} is compressed")
                if name.endswith("/data.pkl"):
                    require_plain_pickle(records.read(record), claims, _CALLED)
            if (damaged := records.testzip()) is not None:
                raise zlib.error(f"{damaged} has a wrong CRC")
        file.seek(0)
        checkpoint = torch.load(file, map_location="cpu", weights_only=True)
        require_few_items(checkpoint)
    except Exception as error:  # torch raises any kind of error for damaged files
        reason = str(error).strip().split("\n")[0]
        raise DamagedError(f"checkpoint must be a complete checkpoint file, got {path}: {reason}") from error
    return checkpoint


def _require_one_reading(file: BinaryIO, directory: int) -> None:
    """Raises ValueError if torch could read another directory of the archive than zipfile did.

    It could if bytes precede the archive, or if the file has a second end record.
    """
    file.seek(0)
    # the zip64 end record (56 bytes), its locator (20) and the end record (22)
    begin, tail_at, tail = file.read(4), file.seek(-98, os.SEEK_END), file.read()
    wide = tail[56:60] == b"PK\6\7"
    named = int.from_bytes(tail[48:56] if wide else tail[92:96], "little")
    fits = begin == b"PK\3\4" and tail[76:80] == b"PK\5\6" and named == directory
    if not fits or (wide and int.from_bytes(tail[64:72], "little") != tail_at):
        raise ValueError("more than one archive")


def check_checkpoint(checkpoint: dict[str, Any], config: TrainConfig, config_hash: str, path: Path) -> None:
    """Compares a checkpoint with the configuration of the run that resumes it.

    Raises: ConfigError naming the first key that differs.
    """
    remedy = "use that value, or choose another run=FOLDER"
    # NetworkConfig and StepConfig add the defaults of keys that the checkpoint does not have.
    stored, section = _network_config(checkpoint, path), checkpoint[SECTION]
    pairs = _pairs("network", stored, config.network) + _pairs("step", _step_config(checkpoint), config.step)
    noise_std, data = section.get("noise_std"), data_of_checkpoint(checkpoint)
    pairs.append(("training.noise_std", noise_std, config.training.noise_std))  # part of the normaliser
    _require_equal(pairs, f" to resume {path}", remedy)
    if data.config_hash != config_hash:
        raise ConfigError(
            f"dataset.folder must contain the data set that {path} was trained on, got another one (config hash "
            f"{config_hash[:12]} instead of {data.config_hash[:12]}); {remedy}"
        )


def _pairs(section: str, stored: NetworkConfig | StepConfig, wanted: Any) -> list[tuple[str, Any, Any]]:
    """Returns each key of a section with the stored and the configured value."""
    theirs, ours = to_mapping(stored), to_mapping(wanted)
    return [(f"{section}.{key}", theirs[key], ours[key]) for key in sorted(theirs)]


def _require_equal(pairs: list[tuple[str, Any, Any]], why: str, remedy: str) -> None:
    for name, theirs, ours in pairs:
        if theirs != ours:
            raise ConfigError(f"{name} must be {theirs!r}{why}, got {ours!r}; {remedy}")


# settings in which a network of relative inputs may differ from training.init_weights
FREE = ("network.inputs", "network.obstacle_distance")


def network_of_weights(config: TrainConfig) -> tuple[ParticleNetwork, WeightsInfo]:
    """Returns the network of training.init_weights with its normaliser, as the initial state of a new run.

    Also returns the metadata of the file.

    Constraints may differ from those of the weights, and so may settings of FREE, which do not change tensors. If the
    weights lack inputs of own physics, the parameters of these inputs begin at 0: outputs without friction stay the
    same. If they lack the material `elastic`, its embedding begins as the mean of the others.
    Raises: ConfigError for a file without weights, another network or data.
    """
    assert config.training.init_weights is not None
    path = find_weights(config.training.init_weights, "training.init_weights")
    weights, info = load_weights(path, field="training.init_weights")
    remedy = "use that value, or other training.init_weights"
    theirs, ours = info.network, config.network
    same: dict[str, Any] = {}
    if theirs.relative and set(theirs.own_physics) <= set(ours.own_physics) and _begin(theirs, ours):
        same["own_physics"] = ours.own_physics
        if "elastic" in ours.own_physics and (*theirs.materials, "elastic") == ours.materials:
            same["materials"] = ours.materials
    theirs = replace(theirs, **same)
    pairs = _pairs("network", theirs, ours)
    if info.network.relative and config.network.relative:
        pairs = [pair for pair in pairs if pair[0] not in FREE]
    pairs.append(("dataset.frame_rate_hz", info.frame_rate_hz, config.dataset.frame_rate_hz))
    if info.network.obstacle_features:
        pairs.append(("scene.cell_size", info.obstacle_cell_size, config.scene.cell_size))
    _require_equal(pairs, f", as in training.init_weights {path}", remedy)
    network, tensors = build_network(config.network, config.step), weights.state_dict()
    added = (0, sum(physics_widths(ours)) - sum(physics_widths(info.network)))
    tensors["encode.first.weight"] = functional.pad(tensors["encode.first.weight"], added)
    row_MH = tensors["embedding.weight"]
    mean_1H = row_MH.mean(0, keepdim=True).expand(len(ours.materials) - len(row_MH), -1)
    tensors["embedding.weight"] = torch.cat([row_MH, mean_1H])
    network.load_state_dict(tensors)
    return network, info


def _begin(theirs: NetworkConfig, ours: NetworkConfig) -> bool:
    """Returns whether the columns of own physics of `ours` begin with those of `theirs`. More can then be appended."""
    pairs = [pair for pair in zip(physics_widths(theirs), physics_widths(ours), strict=True) if any(pair)]
    used = [width for width, _ in pairs if width]
    return used == [width for _, width in pairs][: len(used)]


def network_of_checkpoint(checkpoint: dict[str, Any], path: Path) -> ParticleNetwork:
    """Returns a checkpoint's network with its normaliser, in evaluation mode. A moving average replaces the parameters.

    Raises: ConfigError for a network that this version cannot build.
    """
    state = checkpoint["state_dict"]
    prefix = AVERAGED if any(name.startswith(AVERAGED) for name in state) else NETWORK
    tensors = {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}
    config = _network_config(checkpoint, path)
    try:
        return network_with(config, _step_config(checkpoint), tensors, path=path, field="checkpoint").eval()
    except ConfigError as error:
        raise ConfigError(_other_version(path, str(error))) from None


def _network_config(checkpoint: dict[str, Any], path: Path) -> NetworkConfig:
    try:
        return from_stored(NetworkConfig, with_step(checkpoint[SECTION]).get("network"), "network")
    except ConfigError as error:
        raise ConfigError(_other_version(path, str(error))) from None


def _step_config(checkpoint: dict[str, Any]) -> StepConfig:
    return from_stored(StepConfig, with_step(checkpoint[SECTION]).get("step"), "step")


def _other_version(path: Path, reason: str) -> str:
    return f"checkpoint must contain a network of this version, got {path}: {reason}; export it with its own version"


def data_of_checkpoint(checkpoint: dict[str, Any]) -> DataInfo:
    """Returns the facts about the training data."""
    return from_stored(DataInfo, checkpoint[SECTION].get("data"), "data")
