"""Checks joint trajectories from ROS, and interpolates them. Pure.

Interpolation and tolerances are those of ros2_control's joint trajectory controller: linear for
positions only, cubic with velocities, quintic with accelerations. A path begins at the present
setpoint and speed of the joints.
"""

from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import BodyDescription, JointDescription
from gigabrain_zenoh.errors import Refused, listed
from gigabrain_zenoh.gateway.conversions.frames import stamp_ns
from gigabrain_zenoh.geometry.joint_ramp import OVER, JointPoint

MAX_DURATION_S = 600.0  # of a trajectory
MAX_DELAY_S = 10.0  # until its start, by its stamp
ROUNDING = 1e-4  # [rad] or [m], of positions at a limit
AT_REST = 1e-3  # [rad/s] or [m/s], of the last point
UNCHECKED = -1.0  # value of a tolerance that is not checked; 0 means the default
SAMPLES = np.linspace(0.0, 1.0, 17)  # of a segment, to check its limits
POWERS = np.arange(6)


class Code(IntEnum):
    """Error codes of control_msgs/action/FollowJointTrajectory."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


class Unfit(Refused):
    """A trajectory that cannot be followed, with its error code."""

    def __init__(self, code: Code, text: str) -> None:
        super().__init__(text)
        self.code = code


class Points(NamedTuple):
    """Points of a trajectory of n joints."""

    times: Floats  # (k,) [s] from the start, rising
    positions: Floats  # (k, n) [rad] or [m]
    velocities: Floats | None = None  # (k, n)
    accelerations: Floats | None = None  # (k, n)

    def after(self, seconds: float) -> "Points":
        """Return the points after this time, with times relative to it."""
        late = self.times > seconds
        rows = (None if one is None else one[late] for one in self[1:])
        return Points(self.times[late] - seconds, *rows)  # type: ignore[arg-type]


class JointPath:
    """Polynomials of time from point to point."""

    def __init__(self, names: tuple[str, ...], start: Points, points: Points) -> None:
        """Join the single point of `start`, at 0 s, and the later `points`."""
        self.names = names  # n
        self._times = np.concatenate((start.times, points.times))  # (k + 1,) [s]
        self._end = np.concatenate((start.positions, points.positions))[-1]
        lengths = np.diff(self._times)[:, None]
        p0, p1 = _ends(start.positions, points.positions)
        rows = np.zeros((len(lengths), len(POWERS), len(names)))
        rows[:, 0], rows[:, 1] = p0, (p1 - p0) / lengths
        if points.velocities is not None and start.velocities is not None:
            v0, v1 = _ends(start.velocities, points.velocities)
            if points.accelerations is None or start.accelerations is None:
                rows[:, 1:4] = _cubic(p1 - p0, v0, v1, lengths)
            else:
                a0, a1 = _ends(start.accelerations, points.accelerations)
                rows[:, 1:] = _quintic(p1 - p0, v0, v1, a0, a1, lengths)
        self._rows = rows  # (k, 6, n): factors of the powers of time since the segment's start

    @property
    def seconds(self) -> float:
        """Return the duration [s]."""
        return float(self._times[-1])

    def at(self, t: float) -> tuple[Floats, Floats]:
        """Return positions [rad] or [m] and velocities, (n,) each, after `t` seconds."""
        if t >= self.seconds:
            return self._end, np.zeros(len(self.names))
        segment = max(0, int(np.searchsorted(self._times, t, "right")) - 1)
        since = max(0.0, t - self._times[segment])
        position, velocity = _powers(np.array(since)) @ self._rows[segment]
        return position, velocity

    def check(self, joints: Sequence[JointDescription]) -> None:
        """Raise Unfit if a joint would leave its range, or be too fast."""
        times = np.diff(self._times)[:, None] * SAMPLES  # (k, 17)
        found = np.einsum("ksdp,kpn->dksn", _powers(times), self._rows)  # (2, k, 17, n)
        positions, speeds = found[0].reshape(-1, len(joints)), np.abs(found[1])
        speeds = speeds.reshape(-1, len(joints))
        for column, joint in enumerate(joints):
            fastest = speeds[:, column].max(initial=0.0)
            if not fastest <= OVER * joint.max_speed:  # also for NaN
                text = f"{joint.name} would have to move at {fastest:.3g}, more than"
                raise Unfit(Code.INVALID_GOAL, f"{text} {joint.max_speed:g}")
            _check_range(joint, positions[:, column])


def _ends(start: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Return the values at the start and at the end of each segment."""
    rows = np.concatenate((start, points))
    return rows[:-1], rows[1:]


def _powers(times: Floats) -> Floats:
    """Return the powers of times for positions, and their derivatives, as (..., 2, 6)."""
    position = times[..., None] ** POWERS
    velocity = np.zeros_like(position)
    velocity[..., 1:] = POWERS[1:] * position[..., :-1]
    return np.stack((position, velocity), axis=-2)


def _cubic(way: Floats, v0: Floats, v1: Floats, t: Floats) -> Floats:
    """Return the factors of t, t² and t³, as (k, 3, n)."""
    second = (3 * way / t - 2 * v0 - v1) / t
    third = (v0 + v1 - 2 * way / t) / t**2
    return np.stack((v0, second, third), axis=1)


def _quintic(way: Floats, v0: Floats, v1: Floats, a0: Floats, a1: Floats, t: Floats) -> Floats:
    """Return the factors of t to t to the power of 5, as (k, 5, n)."""
    mean = way / t
    third = (20 * mean - 8 * v1 - 12 * v0 - (3 * a0 - a1) * t) / (2 * t**2)
    fourth = (-30 * mean + 14 * v1 + 16 * v0 + (3 * a0 - 2 * a1) * t) / (2 * t**3)
    fifth = (12 * mean - 6 * (v1 + v0) - (a0 - a1) * t) / (2 * t**4)
    return np.stack((v0, a0 / 2, third, fourth, fifth), axis=1)


def judged(
    body: BodyDescription, message: Any, now: Sequence[JointPoint], ros_ns: int
) -> tuple[JointPath, float]:
    """Return a trajectory_msgs/JointTrajectory as a path, and the seconds until its start.

    `now` is the setpoint of all joints of the body. Raises Unfit, before anything moves.
    """
    joints = _joints(body, message.joint_names)
    with np.errstate(all="ignore"):  # overflows are refused below
        points = _points(joints, message.points)
        waits_s, stamp = 0.0, stamp_ns(message.header.stamp)
        if stamp:
            waits_s = (stamp - ros_ns) / 1e9
            points = points.after(max(0.0, -waits_s))
            if not len(points.times):
                text = f"it ended {-waits_s - _seconds(message.points[-1]):.2f} s ago by its stamp"
                raise Unfit(Code.OLD_HEADER_TIMESTAMP, f"{text}; compare the clocks")
            if waits_s > MAX_DELAY_S:
                text = f"it begins in {waits_s:.0f} s; expected {MAX_DELAY_S:g} s at most"
                raise Unfit(Code.INVALID_GOAL, text)
        start, points = _started(body, joints, now, points)
        path = JointPath(tuple(joint.name for joint in joints), start, points)
        path.check(joints)
    return path, max(0.0, waits_s)


def _joints(body: BodyDescription, names: Sequence[str]) -> tuple[JointDescription, ...]:
    known = {joint.name: joint for joint in body.joints}
    if not names:
        raise Unfit(Code.INVALID_JOINTS, f"it names no joint; known: {listed(known)}")
    for name in names:
        if name not in known:
            text = f"no joint {name[:60]!r}; known: {listed(known)}"
            raise Unfit(Code.INVALID_JOINTS, text)
    if len(set(names)) < len(names):
        raise Unfit(Code.INVALID_JOINTS, "it names a joint twice")
    return tuple(known[name] for name in names)


def _points(joints: Sequence[JointDescription], given: Sequence[Any]) -> Points:
    """Return the points, checked one by one."""
    if not given:
        raise Unfit(Code.INVALID_GOAL, "it has no points")
    times = np.array([_seconds(point) for point in given])
    rising = np.diff(times, prepend=-1e-9) > 0
    if times[0] < 0 or not rising.all() or times[-1] > MAX_DURATION_S:
        text = f"times of points have to rise, from 0 to {MAX_DURATION_S:g} s at most"
        raise Unfit(Code.INVALID_GOAL, text)
    if any(len(point.effort) for point in given):
        raise Unfit(Code.INVALID_GOAL, "efforts cannot be followed; leave them out")
    positions = _rows("positions", joints, given)
    velocities, accelerations = (_rows(f, joints, given) for f in ("velocities", "accelerations"))
    if positions is None:
        raise Unfit(Code.INVALID_GOAL, "positions are missing")
    for joint, places in zip(joints, positions.T, strict=True):
        _check_range(joint, places)
    if velocities is None:
        return Points(times, positions)
    if np.abs(velocities[-1]).max() > AT_REST:
        raise Unfit(Code.INVALID_GOAL, "the last point has a velocity; expected 0")
    if accelerations is not None:
        for joint, values in zip(joints, np.abs(accelerations).T, strict=True):
            if values.max() > OVER * joint.max_acceleration:
                text = f"{joint.name} would have to accelerate by {values.max():.3g}, more than"
                raise Unfit(Code.INVALID_GOAL, f"{text} {joint.max_acceleration:g}")
    return Points(times, positions, velocities, accelerations)


def _seconds(point: Any) -> float:
    at = point.time_from_start
    return float(at.sec + at.nanosec / 1e9)


def _rows(field: str, joints: Sequence[JointDescription], given: Sequence[Any]) -> Floats | None:
    """Return a field of all points, (k, n); None if none has it."""
    lengths = {len(getattr(point, field)) for point in given}
    if lengths == {0}:
        return None
    if lengths != {len(joints)}:
        text = f"{field}: expected {len(joints)} in each point, got {min(lengths)}"
        raise Unfit(Code.INVALID_GOAL, text if len(lengths) == 1 else f"{text} to {max(lengths)}")
    rows = np.array([getattr(point, field) for point in given], float)
    if not np.isfinite(rows).all():
        raise Unfit(Code.INVALID_GOAL, f"{field}: expected finite numbers")
    return rows


def _check_range(joint: JointDescription, places: Floats) -> None:
    for place in (places.min(initial=joint.upper), places.max(initial=joint.lower)):
        if not joint.lower - ROUNDING <= place <= joint.upper + ROUNDING:
            text = f"{joint.name}: expected {joint.lower:g} to {joint.upper:g}, got {place:.6g}"
            raise Unfit(Code.INVALID_GOAL, text)


def _started(
    body: BodyDescription,
    joints: Sequence[JointDescription],
    now: Sequence[JointPoint],
    points: Points,
) -> tuple[Points, Points]:
    """Return the start and the later points; a point at 0 s must be the present setpoint."""
    every = {joint.name: point for joint, point in zip(body.joints, now, strict=True)}
    here = [every[joint.name] for joint in joints]
    fields = ([getattr(p, f) for p in here] for f in ("position", "velocity", "acceleration"))
    start = Points(np.zeros(1), *(np.array([values]) for values in fields))
    if points.times[0] > 0:
        return start, points
    first = Points(*(None if rows is None else rows[:1] for rows in points))  # type: ignore[arg-type]
    off = np.abs(first.positions - start.positions)[0]
    for joint, way in zip(joints, off, strict=True):
        if joint.path_tolerance and way > joint.path_tolerance:
            text = f"it starts {way:.3g} from where {joint.name} is; plan from /joint_states"
            raise Unfit(Code.INVALID_GOAL, text)
    return first, points.after(0.0)


class Tolerances(NamedTuple):
    """The tolerances of a goal: of joint positions [rad] or [m], and of speeds."""

    body: BodyDescription
    path_speeds: Mapping[str, float]  # [rad/s] or [m/s], by joint with a checked speed
    goal_speeds: Mapping[str, float]


def tolerances(body: BodyDescription, goal: Any = None) -> Tolerances:
    """Return the tolerances of a FollowJointTrajectory goal, or the body's. Raises Unfit.

    Tolerances of accelerations are ignored, because they are not measured.
    """
    if goal is None:
        return Tolerances(body, {}, {})
    assert body.arm
    known = {joint.name for joint in body.joints}
    path, goals = ({one.name: one for one in each} for each in (goal.path_tolerance,
                                                                goal.goal_tolerance))  # fmt: skip
    for name in (*path, *goals):
        if name not in known:
            raise Unfit(Code.INVALID_JOINTS, f"a tolerance names no joint: {name[:60]!r}")
    joints = tuple(
        replace(
            joint,
            path_tolerance=_resolved(path, joint.name, joint.path_tolerance),
            goal_tolerance=_resolved(goals, joint.name, joint.goal_tolerance),
        )
        for joint in body.joints
    )
    time = goal.goal_time_tolerance
    goal_time = _tolerance(time.sec + time.nanosec / 1e9, body.arm.goal_time)
    arm = replace(body.arm, goal_time=goal_time or MAX_DURATION_S)
    speeds = (_speeds(each.values()) for each in (path, goals))
    return Tolerances(replace(body, joints=joints, arm=arm), *speeds)


def _resolved(given: Mapping[str, Any], name: str, default: float) -> float:
    return _tolerance(given[name].position, default) if name in given else default


def _speeds(given: Iterable[Any]) -> dict[str, float]:
    found = {one.name: _tolerance(one.velocity, 0.0) for one in given}
    return {name: speed for name, speed in found.items() if speed}


def _tolerance(value: float, default: float) -> float:
    """Return a tolerance; 0 means not checked."""
    if value == UNCHECKED:
        return 0.0
    if not 0.0 <= value < float("inf"):
        raise Unfit(Code.INVALID_GOAL, f"a tolerance is {value:g}; expected -1, 0 or more")
    return value or default
