"""Where a scan lies, and how that was found."""

from dataclasses import dataclass
from typing import Literal

from gigabrain_zenoh.geometry.se2 import Floats

Kind = Literal["matched", "searched", "recovered", "odometry", "broken"]


@dataclass(frozen=True, slots=True)
class Match:
    """Where the front end puts a scan, and how it came to that.

    matched: by ICP. searched: by search alone. recovered: far from where odometry had it.
    odometry: by odometry alone. broken: no longer joined to what was before.
    """

    pose: Floats  # in the front end's own frame
    covariance: Floats  # (3, 3), of x, y and yaw in that frame, against the local map
    kind: Kind
    score: float  # 0 to 1, of the search
    inliers: float  # share of the points that ICP laid onto lines
    guided: bool = False  # by odometry whose covariance is known, and does not speak against it
