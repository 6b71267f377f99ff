"""How far kernels may be from PyTorch."""

import pytest
import torch

from hgn.runtime.parity import OUTPUTS, require_parity
from hgn.schema import ConfigError


@pytest.mark.parametrize("size", [0.0, 0.01, 1.0])
@pytest.mark.parametrize(
    ("precision", "message"),
    [
        ("fp16", "training.precision must be tf32 on this machine, got fp16: its outputs differ"),
        ("tf32", "training.backend must be torch on this machine, got triton: its outputs differ"),
    ],
)
def test_rounding_passes_and_what_is_wrong_does_not(size, precision, message):
    """Half precision differs by 6e-4 however small outputs are; a part that is missing is refused, and so is noise
    where there should be nothing. The setting to change is named."""
    generator = torch.Generator().manual_seed(0)
    direction_N3, noise_N3 = torch.randn(2, 5000, 3, generator=generator)
    expected_N3 = size * direction_N3

    require_parity(expected_N3 + 6e-4 * noise_N3, expected_N3, OUTPUTS, precision)
    for wrong_N3 in (0.8 * expected_N3 if size else 2e-3 * noise_N3, expected_N3 + 0.1 * max(size, 0.1) * noise_N3):
        with pytest.raises(ConfigError, match=message):
            require_parity(wrong_N3, expected_N3, OUTPUTS, precision, "training.")
