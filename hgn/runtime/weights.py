"""Inference weights: a safetensors file with the network's parameters and normaliser, and its structure as JSON.

Reading a file neither unpickles nor executes any of its content.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from hgn.config import NetworkConfig, config_directory
from hgn.network.base import ParticleNetwork
from hgn.network.build import build_network
from hgn.renamed import current_names, with_step
from hgn.schema import (
    Bounded,
    ConfigError,
    NonNegative,
    OrdinarySize,
    Range,
    Vector,
    from_mapping,
    near_file,
    near_name,
    no_file,
    require,
    strict_json,
    to_mapping,
)
from hgn.step_config import StepConfig
from hgn.system.claims import Claims
from hgn.system.files import errors_name, make_folder, write_atomically
from hgn.system.hub import hub_weights

FORMAT_VERSION = 1
MOST_BYTES = 2**31  # of a file: 500 million parameters in fp32
NUMBERS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
SUFFIX = ".safetensors"
SHIPPED = Path(__file__).resolve().parents[1] / "weights"  # folder of the shipped files, each with a card NAME.md


@dataclass(frozen=True)
class WeightsInfo(Bounded):
    """The metadata of a weights file."""

    network: NetworkConfig
    frame_rate_hz: OrdinarySize  # frame rate of the data; a step of the network is one frame
    obstacle_cell_size: OrdinarySize
    gravity: Vector = (0.0, -9.8, 0.0)  # gravity of the data; absolute inputs support no other
    # largest initial speed of the data's groups, domain units per second; null: unknown
    maximum_initial_speed: NonNegative[float] | None = None
    # ranges of friction and of materials' parameters in the data (hgn.scene.own_physics.own_ranges)
    own_ranges: dict[str, Range] = field(default_factory=dict)
    materials: tuple[str, ...] = ()  # materials of the data; empty: all of the network's
    format_version: int = FORMAT_VERSION
    step: StepConfig = field(default_factory=StepConfig)  # constraints of each frame
    updates: NonNegative[int] = 0  # number of updates of the training
    provenance: dict[str, Any] = field(default_factory=dict)  # commit, data set, date, versions

    @property
    def data_materials(self) -> tuple[str, ...]:
        return self.materials or self.network.materials


def save_weights(path: Path, network: ParticleNetwork, info: WeightsInfo, stored_precision: str = "fp32") -> None:
    """Writes the file atomically. Structure and constraints are the network's own, not those in `info`.

    With fp16 the parameters are rounded. The normaliser is not rounded. Raises: ConfigError if a number is not finite.
    """
    info = replace(info, network=network.config, step=network.step)
    tensors = {}
    for name, tensor in network.state_dict().items():
        rounded = stored_precision == "fp16" and not name.startswith("normaliser.")
        tensors[name] = tensor.detach().to("cpu", torch.float16 if rounded else torch.float32).contiguous()
    require_finite(tensors, "weights")
    payload = save(tensors, metadata={"hgn": json.dumps(to_mapping(info), sort_keys=True)})
    remedy = "use a smaller network.width"
    require(len(payload) <= MOST_BYTES, "weights", f"a file of at most {MOST_BYTES} bytes", len(payload), remedy=remedy)
    make_folder(path.parent)
    write_atomically(path, payload)


def require_finite(tensors: Mapping[str, torch.Tensor], field: str, path: Path | None = None) -> None:
    """Raises ConfigError naming a tensor with a number that is not finite. `path` is the file that contains it."""
    # a sum takes a tenth of the time of isfinite; the sum of large numbers may be infinite too
    if bool(torch.stack([tensor.sum(dtype=torch.float32) for tensor in tensors.values()]).isfinite().all()):
        return
    remedy = f"{path} is damaged or of a training that diverged; use another" if path else ""
    for name, tensor in tensors.items():
        wrong = tensor[~tensor.isfinite()][:1].tolist()
        precision = "fp16" if tensor.dtype == torch.float16 else "fp32"
        require(not wrong, f"{field} tensor {name}", f"finite in {precision}", sum(wrong), remedy=remedy)


def shipped_weights() -> dict[str, Path]:
    """Returns the shipped files of this package by name."""
    return {path.stem: path for path in sorted(SHIPPED.glob(f"*{SUFFIX}"))}


def find_weights(name: str, field: str = "weights") -> Path:
    """Returns the weights file for a shipped name, a repository (hf://) or a path.

    Raises: ConfigError for a name that is neither shipped nor looks like a path; it names the command that trains such
    weights, if the name is an experiment's.
    """
    shipped = shipped_weights()
    if name in shipped:
        return shipped[name]
    path = Path(name)
    if re.match(r"\w+://|hf(:|//)", name) and not path.exists():  # a mistyped address too, which hub_weights refuses
        return hub_weights(name, field)
    if path.suffix or len(path.parts) > 1 or path.exists():
        return path
    names, remedy = ", ".join(shipped) or "none in this copy", near_name(name, shipped)
    if name in {path.stem for path in (config_directory() / "experiment").glob("*.yaml")}:
        remedy = f"use one of these, or train with python -m hgn.train +experiment={name}"
    require(False, field, f"a file or the name of shipped weights ({names})", name, remedy=remedy)
    raise AssertionError


def load_weights(
    path: Path, device: torch.device | str = "cpu", field: str = "weights"
) -> tuple[ParticleNetwork, WeightsInfo]:
    """Returns the network in evaluation mode, float32, on `device`. `field` names the setting in messages.

    Raises: ConfigError if the file is missing, is not a weights file, has another format version, or contains tensors
    that do not fit its declared structure.
    """
    if not path.is_file():
        of_run, remedy = path / "checkpoints" / "best.ckpt", "write one with python -m hgn.export"
        raise no_file(field, path, f"{remedy} checkpoint={of_run}" if of_run.is_file() else near_file(path) or remedy)
    size, rule = path.stat().st_size, f"a file of at most {MOST_BYTES} bytes"
    require(size <= MOST_BYTES, field, rule, size, remedy=f"export {path} again")
    with errors_name(path):
        data = path.read_bytes()  # not mapped: a file that another program cut would end the process
    try:
        tensors = load(data)
        metadata = strict_json(data[8 : 8 + int.from_bytes(data[:8], "little")]).get("__metadata__") or {}
    except (SafetensorError, LookupError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        remedy = f"python -m hgn.export checkpoint={path} out=…" if path.suffix == ".ckpt" else "export it again"
        raise ConfigError(
            f"{field} must be a safetensors file, got {path}: {str(error).splitlines()[0]}; {remedy}"
        ) from None
    if "hgn" not in metadata:
        raise ConfigError(f"{field} must be a file of python -m hgn.export, got {path} without its structure")
    try:
        mapping = strict_json(metadata["hgn"])
    except ValueError as error:
        raise ConfigError(f"{field} must declare their structure as JSON, got {path}: {error}") from None
    version = mapping.get("format_version") if isinstance(mapping, dict) else None
    if version != FORMAT_VERSION:
        raise ConfigError(f"{field} format_version must be {FORMAT_VERSION}, got {version!r} in {path}; export again")
    info = from_mapping(WeightsInfo, current_names(with_step(mapping)), "weights")
    network = network_with(info.network, info.step, tensors, path=path, field=field)
    require_finite(network.state_dict(), field, path)
    return network.to(device).eval(), info


def network_with(
    config: NetworkConfig, step: StepConfig, tensors: Mapping[str, torch.Tensor], *, path: Path, field: str
) -> ParticleNetwork:
    """Returns the declared network with the tensors of a file in float32.

    Before it allocates the network, it checks that the file has enough tensors and numbers for the declared structure.

    Raises: ConfigError naming the tensor that does not fit.
    """
    claims, numbers = Claims(path), 0
    for name, tensor in tensors.items():
        claims.add(f"{field} tensor {name}", tensor.numel(), 4)
        rule, kind = "of float16, bfloat16, float32 or float64", str(tensor.dtype)
        require(tensor.dtype in NUMBERS, f"{field} tensor {name}", rule, kind, remedy="export again")
        numbers += tensor.numel()
    # message passing has two square matrices per step; a network is not much larger than these
    count = 2 * config.message_passing_steps * (2 * config.levels - 1)
    rule = (
        f"at least {count} with {count * config.width**2} numbers for network.levels, message_passing_steps and width"
    )
    enough = len(tensors) >= count and numbers >= count * config.width**2
    remedy = f"{path} has those of another network"
    require(enough, f"{field} tensors", rule, f"{len(tensors)} with {numbers}", remedy=remedy)
    network = build_network(config, step)
    expected = {name: tensor.shape for name, tensor in network.state_dict().items()}
    for name in sorted(expected.keys() | tensors.keys()):
        shape = tensors[name].shape if name in tensors else None
        if expected.get(name) != shape:
            raise ConfigError(
                f"{field} tensor {name} must have shape {_shape(expected.get(name))} for the declared network, "
                f"got {_shape(shape)} in {path}; these are the weights of another network"
            )
    network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    for name in ("velocity_std", "acceleration_std"):  # NaN: require_finite
        smallest, remedy = float(getattr(network.normaliser, name).min()), f"{path} is damaged; export again"
        require(not smallest < 1e-30, f"{field} tensor normaliser.{name}", "at least 1e-30", smallest, remedy=remedy)
    return network


def require_frame_rate(info: WeightsInfo, frame_rate_hz: float) -> None:
    """Raises ConfigError if data and weights differ in frame rate. A step of a network is a frame of its data."""
    require(
        frame_rate_hz == info.frame_rate_hz,
        "data frame_rate_hz",
        f"the weights' {info.frame_rate_hz}",
        frame_rate_hz,
        remedy="use a data set or weights of the same frame rate",
    )


def _shape(shape: torch.Size | None) -> str:
    return "none" if shape is None else str(tuple(shape))
