"""The path that a car follows, and the remaining distance from poses near it."""

import math

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import lean_kernel

AHEAD_M = 4.0  # length of path in a track
REVERSE_WEIGHT = 1.5  # of a metre in reverse, relative to one forwards
OFF_WEIGHT = 2.5  # metres of path per metre off it, as a car returns by a longer way
TURN_WEIGHT = 1.5  # metres of path per metre of the arc by which the car is turned away


def no_track() -> Floats:
    """Return the empty track of other bodies."""
    return np.empty((0, 4))


def track_of(
    path: Floats, headings: Floats, pose: tuple[float, float, float], radius: float
) -> Floats:
    """Return the track (n, 4) along a path: x, y [m], yaw [rad], remaining distance [m].

    For `path` (k, 2) [m] and `headings` (k, 2) see `Path`. The track begins at the pose of the path
    nearest to the car's.
    """
    turn = headings[:, 0] - pose[2]
    turn -= math.tau * np.floor(turn / math.tau + 0.5)
    off = np.hypot(path[:, 0] - pose[0], path[:, 1] - pose[1]) + radius * np.abs(turn)
    first = min(int(off.argmin()), len(path) - 1)
    steps = np.hypot(*np.diff(path[first:], axis=0).T)
    gone = np.concatenate(([0.0], np.cumsum(steps)))
    counts = np.where(headings[first + 1 :, 1] < 0.0, REVERSE_WEIGHT * steps, steps)
    left = np.append(np.cumsum(counts[::-1])[::-1], 0.0)
    count = max(1, int(np.searchsorted(gone, AHEAD_M)))
    rest = slice(first, first + count)
    return np.column_stack((path[rest], headings[rest, 0], left[:count]))


@lean_kernel
def remaining_track(track: Floats, radius: float, x: float, y: float, yaw: float) -> float:
    """Return the remaining distance from a pose, by the best pose of the track [m]."""
    least = math.inf
    for n in range(len(track)):
        dx, dy = track[n, 0] - x, track[n, 1] - y
        turn = (track[n, 2] - yaw) / math.tau
        turn = math.tau * abs(turn - math.floor(turn + 0.5))
        off = OFF_WEIGHT * math.sqrt(dx * dx + dy * dy) + TURN_WEIGHT * radius * turn
        least = min(least, track[n, 3] + off)
    return least
