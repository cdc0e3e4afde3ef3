"""Which scans become keyframes, and which of those the local map holds."""

from dataclasses import dataclass

import numpy as np

from gigabrain_zenoh.geometry.se2 import Floats


@dataclass(frozen=True, slots=True)
class Spacing:
    """When a scan becomes a keyframe, and how many of them the local map holds."""

    travel: float = 0.2  # [m]
    turn: float = 0.26  # [rad]
    fewest: int = 8  # keyframes, however far apart they are
    most: int = 20  # keyframes, however near
    length: float = 4.0  # [m] of travel, between the two

    def first(self, poses: Floats) -> int:
        """The first of the poses (n, 3) that the local map still holds."""
        steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        behind = np.append(np.cumsum(steps[::-1])[::-1], 0.0)  # travel from each to the last
        age = np.arange(len(poses))[::-1]
        held = (age < self.fewest) | ((age < self.most) & (behind <= self.length))
        return int(np.argmax(held))
