"""Checks that a robot's odometry arrives, is possible, and does not jump. Pure.

A jump is removed from the pose, so that the map stays correct. The link still counts as lost for
a moment, because the robot may have restarted.
"""

import math
from typing import NamedTuple

import numpy as np
from msgspec import structs

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_zenoh.geometry import se2

LOST_PERIODS = 2.5  # the link is lost after this many periods without odometry,
MIN_TIMEOUT_NS = 100_000_000  # but not before this time
SETTLE_NS = 300_000_000  # a fault is over after this time of valid odometry
PUSHED_FACTOR = 1.5  # a pushed body may reach this multiple of its maximum speed
MAX_RATE_FACTOR = 3.0  # a reported turn rate above this multiple of the maximum is impossible
JUMP_M, JUMP_RAD = 0.1, 0.3  # a motion beyond the possible one by more than this is a jump
RESTARTED_M, RESTARTED_RAD = 0.05, 0.1  # odometry that restarted at rest is within this of zero
MAX_BACK_NS = 20_000_000  # a stamp may be this much older than the last, if there are two threads


class OdometrySample(NamedTuple):
    """One odometry message."""

    stamp_ns: int  # by the robot's clock
    pose: Floats  # (3,), in the robot's odometry frame
    velocity: Velocity


class OdometryWatch:
    """Keeps the newest odometry, and the problem that it has."""

    def __init__(self, topic: str, hz: float, max_speed: float, max_turn: float) -> None:
        """`max_speed` [m/s] and `max_turn` [rad/s] are the body's limits."""
        self.timeout_ns = max(round(LOST_PERIODS / hz * 1e9), MIN_TIMEOUT_NS)
        self.errors = 0  # rejected messages
        self.velocity = Velocity()
        self._topic, self._max_speed, self._max_turn = topic, max_speed, max_turn
        self._pose: Floats = se2.IDENTITY  # without jumps
        self._last: OdometrySample | None = None
        self._received_ns: int | None = None  # arrival of the last valid message
        self._fault, self._fault_ns = "", 0  # the newest fault, and its newest time

    @property
    def pose(self) -> Pose:
        """The pose relative to the start of odometry."""
        x, y, yaw = map(float, self._pose)
        return Pose(x=x, y=y, yaw=yaw)

    def age_ns(self, now_ns: int) -> int | None:
        """Return the age of the newest valid message; None before the first."""
        return None if self._received_ns is None else now_ns - self._received_ns

    def refuse(self, reason: str, now_ns: int) -> None:
        """Record an unusable message."""
        self.errors += 1
        self._fault, self._fault_ns = f"{self._topic}: {reason}", now_ns

    def restart(self) -> None:
        """Forget the last arrival, because the transport is new."""
        self._received_ns = None

    def add(self, sample: OdometrySample, now_ns: int) -> None:
        """Add a message."""
        values = (*sample.pose, *_speeds(sample.velocity))
        if not all(map(math.isfinite, values)):
            self.refuse(
                "its pose or velocity is NaN or infinite: restart the node that sends it", now_ns
            )
            return
        last = self._last
        if last is None:
            self._pose = se2.wrapped(sample.pose)
        elif sample.stamp_ns == last.stamp_ns:
            self.refuse("its stamps stand still: the same message again", now_ns)
            return
        elif sample.stamp_ns < last.stamp_ns - MAX_BACK_NS:
            back = (last.stamp_ns - sample.stamp_ns) / 1e9
            self.refuse(
                f"its stamps went back by {back:.3g} s: restarted, or two publishers?", now_ns
            )
            self._last = sample  # accept odometry again from here
            return
        else:
            self._continue_pose(last, sample, now_ns)
            velocity = self._plausible_velocity(last, sample)
            self._last, self._received_ns, self.velocity = sample, now_ns, velocity
            return
        self._last, self._received_ns, self.velocity = sample, now_ns, sample.velocity

    def problem(self, now_ns: int) -> str:
        """Return why the odometry is unreliable; empty if it is reliable."""
        age_ns = self.age_ns(now_ns)
        if self._fault and now_ns - self._fault_ns < SETTLE_NS:
            return self._fault
        self._fault = ""
        if age_ns is None:
            return f"{self._topic}: no message yet"
        if age_ns > self.timeout_ns:
            return f"{self._topic}: no message for {age_ns / 1e6:.0f} ms"
        return ""

    def _plausible_velocity(self, last: OdometrySample, sample: OdometrySample) -> Velocity:
        """Return the velocity; an impossible turn rate is replaced by the one between the poses.

        A TurtleBot3 reports -125 rad/s when its heading passes half a turn.
        """
        velocity = sample.velocity
        if abs(velocity.angular_z) <= MAX_RATE_FACTOR * self._max_turn:
            return velocity
        passed_s = max(sample.stamp_ns - last.stamp_ns, 1) / 1e9
        turned = float(se2.between(last.pose, sample.pose)[2])
        return structs.replace(velocity, angular_z=turned / passed_s)

    def _continue_pose(self, last: OdometrySample, sample: OdometrySample, now_ns: int) -> None:
        moved = se2.between(last.pose, sample.pose)
        passed_s = max(sample.stamp_ns - last.stamp_ns, 0) / 1e9
        if self._received_ns is not None:  # stamps may jump ahead, arrival times cannot
            passed_s = min(passed_s, max((now_ns - self._received_ns) / 1e9, 0.0) + 0.5)
        distance, turned = math.hypot(moved[0], moved[1]), abs(float(moved[2]))
        x, y, yaw = np.abs(sample.pose)
        restarted = math.hypot(x, y) < RESTARTED_M and yaw < RESTARTED_RAD
        moved_s = 0.0 if restarted and passed_s * 1e9 > self.timeout_ns else passed_s
        if (
            distance > PUSHED_FACTOR * self._max_speed * moved_s + JUMP_M
            or turned > PUSHED_FACTOR * self._max_turn * moved_s + JUMP_RAD
        ):
            self.refuse(
                f"it jumped by {distance:.2f} m and {math.degrees(turned):.0f} degrees in "
                f"{passed_s * 1e3:.0f} ms: was the robot restarted, or its odometry reset?",
                now_ns,
            )
            return
        self._pose = se2.compose(self._pose, moved)


def _speeds(velocity: Velocity) -> tuple[float, float, float]:
    return velocity.linear_x, velocity.linear_y, velocity.angular_z
