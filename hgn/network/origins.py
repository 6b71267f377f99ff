"""Grid origins of simulations, which differ from frame to frame.

The error of a frame depends on how the cells of the grid lie in the scene. With one origin for all frames the error
repeats and adds up as creep. In training, each update draws origins uniform in [-R, 0]^3 (hgn.training.noise), where R
is the size of the finest cells. Simulations take origins from the R3 sequence (Roberts 2018, "The unreasonable
effectiveness of quasirandom sequences"), which covers this cube evenly. Frame k has the origin

    -R frac(k / g^a)    on axis a = 1, 2, 3,    with g^4 = g + 1

Integer arithmetic gives the fraction, so that all backends have the same origins bitwise. The origin of frame 0 is 0.
Networks with the rest constraint have the origin 0 in all frames (`HierarchicalGraphNetwork.origin_range`).
"""

import torch

ROOT = 1.22074408460575947536  # g
STEPS = tuple(int(2**32 / ROOT**axis) for axis in (1, 2, 3))  # change of the fraction in a frame, in units of 2^-32
FRACTION_BITS = 24  # float32 represents fractions of this many bits exactly


def frame_origin(frame_S: torch.Tensor, origin_range: float, dimensions: int) -> torch.Tensor:
    """Returns the grid origins of scenes at these frames, float32 [S, 3] in (-origin_range, 0]; 0 on unused axes."""
    step_3 = torch.tensor([step if axis < dimensions else 0 for axis, step in enumerate(STEPS)], device=frame_S.device)
    fraction_S3 = (frame_S[:, None] * step_3 & 2**32 - 1) >> 32 - FRACTION_BITS
    return fraction_S3.float() * (-origin_range / 2**FRACTION_BITS)
