"""python -m hgn.average weights=[a,b] coefficients=[0.7,0.3] out=…: averages the weights of several networks.

Networks that were trained from the same weights can be averaged. The mean network has the size of one network, no
larger error, and parts of the abilities of each (model soups, Wortsman et al. 2022).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hgn.command import run_command
from hgn.config import StoredPrecision
from hgn.schema import ConfigError, FileName, from_mapping, require, require_bounds

if TYPE_CHECKING:
    from hgn.network.base import ParticleNetwork
    from hgn.runtime.weights import WeightsInfo

    Loaded = tuple[ParticleNetwork, WeightsInfo]

SHARED = ("network", "step", "frame_rate_hz", "obstacle_cell_size", "gravity")  # fields that must be equal in all files


@dataclass(frozen=True)
class AverageConfig:
    """`python -m hgn.average`: the mean of several networks."""

    # files of python -m hgn.export or names of shipped weights, as in [a.safetensors,b.safetensors]
    weights: tuple[str, ...]
    out: FileName  # the weights file to write
    coefficients: tuple[float, ...] | None = (
        None  # coefficient of each file, with the sum 1, as in [0.7,0.3]; null: equal ones
    )
    stored_precision: StoredPrecision = "fp32"  # precision of the learned tensors; fp16 makes files half as large

    def __post_init__(self) -> None:
        require_bounds(self)
        require(len(self.weights) >= 2, "weights", "at least two files", len(self.weights))
        if self.coefficients is not None:
            count = f"one for each of the {len(self.weights)} files"
            require(len(self.coefficients) == len(self.weights), "coefficients", count, len(self.coefficients))
            require(abs(sum(self.coefficients) - 1) < 1e-6, "coefficients", "numbers of sum 1", sum(self.coefficients))


def main(mapping: dict[str, Any]) -> int:
    """Writes the weights file. Returns the exit code."""
    config = from_mapping(AverageConfig, mapping)
    average(config)
    print(config.out)
    return 0


def average(config: AverageConfig) -> None:
    """Writes the mean. `updates` is the largest number of the files; `provenance` lists all files.

    Raises ConfigError if a file is missing, or if networks, data or normalisers differ.
    """
    import torch

    from hgn.runtime.weights import find_weights, load_weights, save_weights
    from hgn.system.provenance import provenance

    coefficients = config.coefficients or (1 / len(config.weights),) * len(config.weights)
    files = [find_weights(name, f"weights[{i}]") for i, name in enumerate(config.weights)]
    loaded = [load_weights(file, field=f"weights[{i}]") for i, file in enumerate(files)]
    network, info = loaded[0]
    for i in range(1, len(loaded)):
        _require_same(loaded[0], loaded[i], config.weights, i)
    with torch.no_grad():
        for same in zip(*(each.parameters() for each, _ in loaded), strict=True):
            same[0].copy_(
                sum(coefficient * parameter for coefficient, parameter in zip(coefficients, same, strict=True))
            )
    parts = [
        {"file": file.name, "coefficient": coefficient, "updates": each.updates, "provenance": each.provenance}
        for file, coefficient, (_, each) in zip(files, coefficients, loaded, strict=True)
    ]
    updates = max(each.updates for _, each in loaded)
    mean_info = replace(info, updates=updates, provenance=provenance() | {"average_of": parts})
    save_weights(Path(config.out), network, mean_info, config.stored_precision)


def _require_same(first: Loaded, other: Loaded, names: tuple[str, ...], i: int) -> None:
    import torch

    for field in SHARED:
        expected, other_value = getattr(first[1], field), getattr(other[1], field)
        if expected != other_value:
            raise ConfigError(
                f"weights[{i}] must have the {field} of weights[0] ({names[0]}), {expected}, got {other_value} in "
                f"{names[i]}; average weights of one network and data"
            )
    normalisers = [network.normaliser.state_dict() for network, _ in (first, other)]
    if any(not torch.equal(normalisers[0][name], normalisers[1][name]) for name in normalisers[0]):
        raise ConfigError(
            f"weights[{i}] must have the normaliser of weights[0] ({names[0]}), got another in {names[i]}; average "
            "weights whose training began with the same ones (training.init_weights)"
        )


if __name__ == "__main__":
    run_command(main, "average")
