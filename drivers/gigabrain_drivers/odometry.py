"""Dead reckoning: where a body has got to, by how its wheels turned."""

import math

from gigabrain_drivers.kinematics import Base, Twist
from gigabrain_schemas.base import Pose


def advanced(pose: Pose, moved: Twist) -> Pose:
    """Where a body is after a small step in its own frame, taken at the mid heading."""
    middle = pose.yaw + moved.angular_z / 2
    cos, sin = math.cos(middle), math.sin(middle)
    return Pose(
        x=pose.x + moved.linear_x * cos - moved.linear_y * sin,
        y=pose.y + moved.linear_x * sin + moved.linear_y * cos,
        yaw=math.remainder(pose.yaw + moved.angular_z, math.tau),
    )


def between(start: Pose, end: Pose) -> Twist:
    """The small step, in the body's own frame, that leads from one pose to another."""
    turn = math.remainder(end.yaw - start.yaw, math.tau)
    middle, x, y = start.yaw + turn / 2, end.x - start.x, end.y - start.y
    cos, sin = math.cos(middle), math.sin(middle)
    return Twist(cos * x + sin * y, cos * y - sin * x, turn)


class Odometry:
    """The pose since the start (REP-103), integrated at the mid heading."""

    def __init__(self, base: Base) -> None:
        self._base = base
        self.pose = Pose(x=0.0, y=0.0, yaw=0.0)

    def add(self, wheels: tuple[float, ...]) -> None:
        """The wheels have turned by so much [rad], in the order of `base.wheels`."""
        self.pose = advanced(self.pose, self._base.to_body(wheels))


class Encoders:
    """Counters that wrap, read as the angles by which wheels turned between two looks."""

    def __init__(self, per_turn: float, bits: int) -> None:
        self._radians, self._range = math.tau / per_turn, 1 << bits
        self._last: tuple[int, ...] | None = None

    def turned(self, counts: tuple[int, ...]) -> tuple[float, ...]:
        """By how much [rad] since the last look; nothing at the first."""
        last, self._last = self._last or counts, counts
        pairs = zip(counts, last, strict=True)
        return tuple(self._radians * self._wrapped(now - before) for now, before in pairs)

    def restart(self) -> None:
        """The counters may have been set anew: what comes next counts from there."""
        self._last = None

    def _wrapped(self, difference: int) -> int:
        half = self._range // 2
        return (difference + half) % self._range - half
