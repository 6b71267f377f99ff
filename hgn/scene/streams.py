"""Random streams of a scene. Each kind of draw has its own stream, so draws of different kinds are independent."""

from enum import IntEnum, unique

import numpy as np


@unique
class Stream(IntEnum):
    """Keys of the streams of a scene's seed. Data sets depend on the numbers. Layouts as in the paper have no key."""

    LONE_PARTICLES = 1
    MOTION = 2
    FUNNEL = 3
    FINER_PARTICLES = 4  # datagen.fine
    KIND = 5
    PHYSICS = 6  # friction and parameters
    ELASTIC = 7
    MOVING = 8


def stream(seed: int, key: Stream) -> np.random.Generator:
    """Returns the generator of a stream, the same on every machine."""
    return np.random.Generator(np.random.PCG64([seed, key]))
