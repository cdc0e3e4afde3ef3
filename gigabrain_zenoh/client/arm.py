"""Motion of joints for scripts: postures and trajectories, streamed at the body's rate."""

import math
import numbers
from bisect import bisect_right
from collections.abc import Mapping, Sequence

from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import BodyDescription, JointDescription, RobotState
from gigabrain_schemas.brain import JointCommand
from gigabrain_zenoh.errors import BodyLost, ConfigError, Unsupported, listed, unknown
from gigabrain_zenoh.geometry.joint_ramp import (
    REST,
    JointGoal,
    JointPoint,
    along,
    held,
    measured,
    prepare,
    ramp,
)

Positions = Mapping[str, float]  # [rad] or [m] by joint
MAX_LAG_TICKS = 3  # joints may lag behind their commands by this time at full speed
ARRIVED_TOLERANCE = 1e-4  # [rad] or [m], of the command from a goal
HELD_TOLERANCE = 2e-3  # [rad] or [m], of the held position from a goal: servos round it
MAX_DURATION_S = 600.0  # of a trajectory
HELD_BACK_TICKS = 100  # without progress; then motions no longer wait for the joints


def check_joints(body: BodyDescription) -> None:
    """Raise Unsupported for a body without joints."""
    if not body.joints:
        raise Unsupported(f"{body.robot_type} has no joint that can be positioned")


def checked_positions(body: BodyDescription, positions: Positions) -> dict[str, float]:
    """Return positions [rad] or [m]. Raises Unsupported, UnknownName and ConfigError."""
    check_joints(body)
    prepare(len(body.joints))
    known = {joint.name: joint for joint in body.joints}
    if not positions:
        raise ConfigError(f"expected the position of a joint; known: {listed(known)}")
    for name, position in positions.items():
        if name not in known:
            raise unknown("joint", name, known)
        _check_position(known[name], position)
    return {name: float(position) for name, position in positions.items()}


def _check_position(joint: JointDescription, position: float) -> None:
    if isinstance(position, bool) or not isinstance(position, numbers.Real):
        raise ConfigError(f"{joint.name}: expected a number, got {position!r}")
    if not joint.lower <= position <= joint.upper:  # also true for NaN
        raise ConfigError(
            f"{joint.name}: expected {joint.lower:g} to {joint.upper:g}, got {position:g}"
        )


def held_posture(body: BodyDescription, state: RobotState) -> tuple[JointPoint, ...]:
    """Return the posture in which the gate holds the joints, see `held`.

    Raises BodyLost where a joint is not measured.
    """
    posture = held(body, state)
    if not posture:
        raise BodyLost(f"{body.robot_type}: not all of its joints are measured; see `arm state`")
    return posture


class JointPath:
    """Points, each a time [s] and positions [rad] or [m], that begin at a given posture."""

    def __init__(
        self, body: BodyDescription, points: Sequence[tuple[float, Positions]], start: Positions
    ) -> None:
        """Check the points. Raises Unsupported, UnknownName and ConfigError."""
        if not points:
            raise ConfigError("trajectory: expected at least one point, (seconds, positions)")
        names = set(points[0][1])
        self._times, self._rows = [0.0], [dict(start)]
        for number, (t, positions) in enumerate(points):
            if set(positions) != names:
                raise ConfigError(f"trajectory: point {number} has other joints than the first")
            before = self._times[-1]
            if not (math.isfinite(t) and before < t <= MAX_DURATION_S):
                raise ConfigError(
                    f"trajectory: point {number}: expected a time above {before:g} s, "
                    f"up to {MAX_DURATION_S:g} s, got {t:g}"
                )
            row = {**self._rows[-1], **checked_positions(body, positions)}
            self._check_speeds(body, row, t, number)
            self._times.append(t)
            self._rows.append(row)

    @property
    def end(self) -> dict[str, float]:
        """Return the last posture."""
        return self._rows[-1]

    @property
    def seconds(self) -> float:
        """Return the duration [s]."""
        return self._times[-1]

    def at(self, t: float) -> dict[str, float]:
        """Return the posture after `t` seconds."""
        i = bisect_right(self._times, t)
        if i == len(self._times):
            return self.end
        share = (t - self._times[i - 1]) / (self._times[i] - self._times[i - 1])
        before, after = self._rows[i - 1], self._rows[i]
        return {name: start + share * (after[name] - start) for name, start in before.items()}

    def _check_speeds(self, body: BodyDescription, row: Positions, t: float, number: int) -> None:
        for joint in body.joints:
            speed = abs(row[joint.name] - self._rows[-1][joint.name]) / (t - self._times[-1])
            if speed > joint.max_speed:
                raise ConfigError(
                    f"trajectory: point {number}: {joint.name} would have to move at {speed:.2f}, "
                    f"more than {joint.max_speed:g}; give it more time"
                )


class JointStream:
    """Commands for joints, one for each state, from the held posture to the goals.

    Joints without a goal are held.
    """

    def __init__(self, body: BodyDescription, state: RobotState, source: str) -> None:
        """Start at the held posture. Nothing moves before `go` or `follow`.

        Raises BodyLost where a joint is not measured.
        """
        self._body, self._source = body, source
        self._now = held_posture(body, state)
        self._tick, self._sent = state.tick, self._now
        self._held_postures = (self._now, self._now)  # held by the gate, newest last
        self._goals: dict[str, float] = {}
        self._speed: float | None = None
        self._path: JointPath | None = None
        self._path_tick = 0  # of its start
        # smallest sum of the distances to the goals, [rad] or [m], and its tick
        self._least_left, self._progress_tick = math.inf, state.tick

    @property
    def posture(self) -> dict[str, float]:
        """Return the newest commanded positions [rad] or [m]."""
        names = (joint.name for joint in self._body.joints)
        return dict(zip(names, (point.position for point in self._now), strict=True))

    def go(self, positions: Positions, speed: float | None) -> None:
        """Move joints to `positions` [rad] or [m] from now on."""
        self._path, self._speed = None, speed
        self._goals |= positions
        self._least_left = math.inf

    def follow(self, path: JointPath) -> None:
        """Follow a path from now on."""
        self._path, self._path_tick = path, self._tick
        self._goals, self._speed = path.end, None

    def rest(self) -> None:
        """Brake to rest, and stay there."""
        self._goals, self._path = {}, None

    def give_up(self) -> None:
        """Stay in the posture in which the gate holds the joints."""
        self._now = self._held_postures[-1]
        self.rest()

    def step(self, state: RobotState) -> JointCommand | None:
        """Return the command for the tick after that of `state`; None while joints are missing."""
        posture = held(self._body, state)
        if not posture:
            return None
        self._held_postures = (self._held_postures[1], posture)
        if self._lags(posture):
            self._now = posture
        passed = max(0, state.tick - self._tick)
        ticks = min(passed, MAX_LAG_TICKS)
        self._path_tick += passed - ticks  # the path pauses, as the gate does without commands
        self._progress_tick += passed - ticks
        self._tick = state.tick
        self._watch_progress(posture)
        if ticks:
            self._now = self._next(ticks)
        self._sent = self._now
        return JointCommand(
            name=tuple(joint.name for joint in self._body.joints),
            position=tuple(point.position for point in self._now),
            velocity=tuple(point.velocity for point in self._now),
            source=self._source,
        )

    def _next(self, ticks: int) -> tuple[JointPoint, ...]:
        joints, dt = self._body.joints, ticks * TICK_S
        if self._path:
            t = (self._tick - self._path_tick) * TICK_S
            rows = [self._path.at(t + TICK_S + k * dt) for k in (-1, 0, 1)]
            path = [[row[joint.name] for joint in joints] for row in rows]
            return along(self._now, path, joints, dt)
        goals = [
            JointGoal(self._goals[joint.name], max_speed=self._speed)
            if joint.name in self._goals
            else REST
            for joint in joints
        ]
        return ramp(self._now, goals, joints, dt)

    def _lags(self, posture: tuple[JointPoint, ...]) -> bool:
        """Return whether the held posture is too far from the commands; then restart from it."""
        return any(
            abs(sent.position - point.position) > MAX_LAG_TICKS * TICK_S * joint.max_speed
            for sent, point, joint in zip(self._sent, posture, self._body.joints, strict=True)
        )

    def _watch_progress(self, posture: tuple[JointPoint, ...]) -> None:
        joints = zip(self._body.joints, posture, strict=True)
        left = sum(abs(p.position - self._goals.get(j.name, p.position)) for j, p in joints)
        if not self._path_ended or left < self._least_left - ARRIVED_TOLERANCE:
            self._least_left, self._progress_tick = left, self._tick

    @property
    def _path_ended(self) -> bool:
        """Return whether the duration of the path has passed, or there is no path."""
        return self._path is None or (self._tick - self._path_tick) * TICK_S >= self._path.seconds

    @property
    def held_back(self) -> bool:
        """Return whether the held posture makes no progress towards the goals."""
        return not self.arrived and self._tick - self._progress_tick > HELD_BACK_TICKS

    @property
    def arrived(self) -> bool:
        """Return whether the newest command has all joints at their goals."""
        return self._path_ended and all(
            abs(self.posture[name] - goal) < ARRIVED_TOLERANCE for name, goal in self._goals.items()
        )

    def reached(self, state: RobotState) -> bool:
        """Return whether all joints are at their goals, as held and as measured.

        The last two held postures must be there: after only one, joints may still be moving.
        """
        now = measured(self._body, state)
        if not (now and self.arrived):
            return False
        return all(
            abs(older.position - goal) <= HELD_TOLERANCE
            and abs(newer.position - goal) <= HELD_TOLERANCE
            and abs(point.position - goal) <= (joint.goal_tolerance or math.inf)
            for joint, older, newer, point in zip(
                self._body.joints, *self._held_postures, now, strict=True
            )
            if (goal := self._goals.get(joint.name)) is not None
        )
