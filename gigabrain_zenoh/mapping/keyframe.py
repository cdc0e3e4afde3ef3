"""Keyframes and what joins them."""

from dataclasses import dataclass

from gigabrain_zenoh.geometry.se2 import Floats
from gigabrain_zenoh.mapping.points import Points, Scan, normals


@dataclass(frozen=True, slots=True)
class Edge:
    """Keyframe `second` as seen from keyframe `first`, both by index."""

    first: int
    second: int
    relative: Floats
    covariance: Floats  # (3, 3), of x, y and yaw in the axes of `second`
    doubtful: bool  # may be all wrong, so it counts the less the more it disagrees with others


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A scan that is kept, and the link by which it hangs on an earlier one."""

    points: Points  # as in Scan
    free: Points
    link: Edge  # the first keyframe hangs on itself, `relative` being its pose in the map
    travel: float  # [m], driven until here
    segment: int  # parts of the drive between which the sequence broke

    @property
    def scan(self) -> Scan:
        """The scan; its normals are found anew, as kept they would need as much room as points."""
        return Scan(self.points, normals(self.points), self.free)
