"""Known ground: places that earlier passes have mapped, where the robot need only find its way.

Keyframes are added for the first passes over a place. From then on scans are laid onto those, so
a map grows with the ground and with what changes on it, and not with the time that is driven.
"""

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.geometry.se2 import Floats, wrap
from gigabrain_zenoh.mapping.keyframe import Keyframe

TRAVEL = 12.0  # [m] since, or it is the same pass
NEAR = 0.75  # [m], keyframes so near are of this place
PASSES = 2  # over a place, from then on it is known
REACH = 3.0  # [m], keyframes farther off show other places
SQUARE, SECTOR = 0.4, np.pi / 2  # [m] and [rad]: of keyframes seen from one place one is enough
TURNED = 0.5  # [m] that a keyframe may be farther off, for each rad that it is less turned away
MOST = 16  # keyframes


class Ground:
    """The keyframes of a map by place. Corrections move them, so it is told the poses each time."""

    def __init__(self) -> None:
        self._travel: Floats = np.empty(0)
        self._segments: NDArray[np.int64] = np.empty(0, np.int64)

    def add(self, keyframe: Keyframe) -> None:
        """Add the next keyframe of the map."""
        self._travel = np.append(self._travel, keyframe.travel)
        self._segments = np.append(self._segments, keyframe.segment)

    def round(self, pose: Floats, travel: float, poses: Floats, joined: set[int]) -> list[int]:
        """Return the keyframes that show the ground round `pose` (3,), the nearest last.

        Earlier passes count only, after `travel` [m] now, and segments that are joined to the map.
        Nothing is returned where there were fewer than PASSES of them.
        """
        earlier = np.flatnonzero(travel - self._travel > TRAVEL)
        away = np.hypot(*(poses[earlier, :2] - pose[:2]).T)
        around = away < REACH
        around &= np.isin(self._segments[earlier], list(joined))
        ids, away = earlier[around], away[around]
        if self._passes(ids[away < NEAR]) < PASSES:
            return []
        return _chosen(ids, poses[ids], pose)

    def _passes(self, ids: NDArray[np.intp]) -> int:
        """Return how often the robot has come by these keyframes, which are in their order."""
        passes, last = 0, -np.inf
        for travel in self._travel[ids].tolist():
            if travel - last > TRAVEL:
                passes, last = passes + 1, travel
        return passes


def _chosen(ids: NDArray[np.intp], poses: Floats, pose: Floats) -> list[int]:
    """Return the newest keyframe of each place and direction, of those the nearest MOST."""
    places = np.floor(poses / (SQUARE, SQUARE, SECTOR))
    _, newest = np.unique(places[::-1], axis=0, return_index=True)
    ids, poses = ids[::-1][newest], poses[::-1][newest]
    off = poses - pose
    far = np.hypot(off[:, 0], off[:, 1]) + TURNED * np.abs(wrap(off[:, 2]))
    order = np.lexsort((ids, far))[:MOST]
    return [int(k) for k in ids[order[::-1]]]
