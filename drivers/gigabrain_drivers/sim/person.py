"""A person who walks round and round, and gives way to the robot."""

from collections.abc import Callable

from gigabrain_drivers.sim.geometry import ClosedPath, Pose
from gigabrain_drivers.sim.tick import TICK_S

RADIUS_M = 0.25
SPEED = 0.8  # [m/s]
KEEP_AWAY_M = 0.5  # from the person's side to the robot's outer edge
ANEW_M = 1.0  # walked since it last stood: standing again is another meeting


class Person:
    """Walks a closed path at 0.8 m/s, and stands while one more step would come too close."""

    def __init__(self, path: ClosedPath, start: float) -> None:
        self._path = path
        self._walked = start
        self.pose = path.at(start)
        self.stood = 0  # how often it had to, for the robot
        self._since_m = ANEW_M

    def advance(self, robot_distance: Callable[[float, float], float]) -> Pose:
        """Walk for one tick; `robot_distance(x, y)` is from a point to the robot's edge [m]."""
        walked = (self._walked + SPEED * TICK_S) % self._path.length
        ahead = self._path.at(walked)
        gap = robot_distance(ahead.x, ahead.y)
        if gap >= KEEP_AWAY_M + RADIUS_M or gap > robot_distance(self.pose.x, self.pose.y):
            self._walked, self.pose = walked, ahead
            self._since_m += SPEED * TICK_S
        else:
            self.stood += self._since_m >= ANEW_M
            self._since_m = 0.0
        return self.pose
