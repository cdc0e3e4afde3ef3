"""Random numbers: one independent stream for each use, all drawn from one seed."""

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """What a stream is for. A new use gets a new number, so that old runs stay the same."""

    LAYOUT = 0
    START = 1
    LIDAR = 2
    IMU = 3


def generator(seed: int, stream: Stream) -> np.random.Generator:
    """The generator of one stream of `seed` (a whole number >= 0)."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream,)))
