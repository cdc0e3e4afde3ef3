"""Motion of joints for scripts: postures and trajectories, streamed at the body's rate."""

import math
import numbers
from bisect import bisect_right
from collections.abc import Mapping, Sequence

from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import BodyDescription, JointDescription, RobotState
from gigabrain_schemas.brain import JointCommand
from gigabrain_zenoh.errors import BodyLost, ConfigError, Unsupported, unknown
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
LOST_TICKS = 3  # by whose motion the joints may be away from where they were sent
ARRIVED = 1e-4  # [rad] or [m], off a goal
SENT = 2e-3  # [rad] or [m], off a goal, as servos round what they are sent
LONGEST_S = 600.0  # of a trajectory
HELD_BACK_TICKS = 100  # without progress, after which joints are not waited for any longer


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
        raise ConfigError(f"expected the position of a joint; known: {', '.join(known)}")
    for name, position in positions.items():
        if name not in known:
            raise unknown("joint", name, known)
        _check_position(known[name], position)
    return {name: float(position) for name, position in positions.items()}


def _check_position(joint: JointDescription, position: float) -> None:
    if isinstance(position, bool) or not isinstance(position, numbers.Real):
        raise ConfigError(f"{joint.name}: expected a number, got {position!r}")
    if not joint.lower <= position <= joint.upper:  # NaN as well
        raise ConfigError(
            f"{joint.name}: expected {joint.lower:g} to {joint.upper:g}, got {position:g}"
        )


def held_posture(body: BodyDescription, state: RobotState) -> tuple[JointPoint, ...]:
    """Return the posture that joints were sent to, or are in. Raises BodyLost where one is missing.

    See `held`.
    """
    posture = held(body, state)
    if not posture:
        raise BodyLost(f"{body.robot_type}: not all of its joints are measured; see `arm state`")
    return posture


class JointPath:
    """Points in time and positions [rad] or [m], from the present posture on."""

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
            if not (math.isfinite(t) and before < t <= LONGEST_S):
                raise ConfigError(
                    f"trajectory: point {number}: expected a time above {before:g} s, "
                    f"up to {LONGEST_S:g} s, got {t:g}"
                )
            row = {**self._rows[-1], **checked_positions(body, positions)}
            self._check_speeds(body, row, t, number)
            self._times.append(t)
            self._rows.append(row)

    @property
    def end(self) -> dict[str, float]:
        """The posture at its end."""
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
        return {name: place + share * (after[name] - place) for name, place in before.items()}

    def _check_speeds(self, body: BodyDescription, row: Positions, t: float, number: int) -> None:
        for joint in body.joints:
            speed = abs(row[joint.name] - self._rows[-1][joint.name]) / (t - self._times[-1])
            if speed > joint.max_speed:
                raise ConfigError(
                    f"trajectory: point {number}: {joint.name} would have to move at {speed:.2f}, "
                    f"more than {joint.max_speed:g}"
                )


class JointStream:
    """Commands for joints, one for each state, from where they were sent to where they should be.

    The joints that are not named stay where they were sent.
    """

    def __init__(self, body: BodyDescription, state: RobotState, source: str) -> None:
        """Start where the joints are. Nothing moves before `go` or `follow`.

        Raises BodyLost where one is not measured.
        """
        self._body, self._source = body, source
        self._now = held_posture(body, state)
        self._tick, self._sent = state.tick, self._now
        self._postures = (self._now, self._now)  # where the gate held the joints, newest last
        self._ends: dict[str, float] = {}
        self._speed: float | None = None
        self._path: JointPath | None = None
        self._path_tick = 0  # when it began
        self._least, self._progress_tick = math.inf, state.tick  # way to the goals, [rad] or [m]

    @property
    def posture(self) -> dict[str, float]:
        """Return the positions that the joints should have by now [rad] or [m]."""
        names = (joint.name for joint in self._body.joints)
        return dict(zip(names, (point.position for point in self._now), strict=True))

    def go(self, positions: Positions, speed: float | None) -> None:
        """Move joints to `positions` [rad] or [m] from now on."""
        self._path, self._speed = None, speed
        self._ends |= positions
        self._least = math.inf

    def follow(self, path: JointPath) -> None:
        """Follow a path from now on."""
        self._path, self._path_tick = path, self._tick
        self._ends, self._speed = path.end, None

    def rest(self) -> None:
        """Brake, and stay where that ends."""
        self._ends, self._path = {}, None

    def give_up(self) -> None:
        """Stay where the gate holds the joints."""
        self._now = self._postures[-1]
        self.rest()

    def step(self, state: RobotState) -> JointCommand | None:
        """Return the command for the tick after that of `state`; None while joints are missing."""
        posture = held(self._body, state)
        if not posture:
            return None
        self._postures = (self._postures[1], posture)
        if self._lost(posture):
            self._now = posture
        passed = max(0, state.tick - self._tick)
        ticks = min(passed, LOST_TICKS)
        self._path_tick += passed - ticks  # it waits, as the gate does without commands
        self._progress_tick += passed - ticks
        self._tick = state.tick
        self._watch_progress(posture)
        if ticks:
            self._now = self._moved(ticks)
        self._sent = self._now
        return JointCommand(
            name=tuple(joint.name for joint in self._body.joints),
            position=tuple(point.position for point in self._now),
            velocity=tuple(point.velocity for point in self._now),
            source=self._source,
        )

    def _moved(self, ticks: int) -> tuple[JointPoint, ...]:
        joints, dt = self._body.joints, ticks * TICK_S
        if self._path:
            t = (self._tick - self._path_tick) * TICK_S
            rows = [self._path.at(t + TICK_S + k * dt) for k in (-1, 0, 1)]
            path = [[row[joint.name] for joint in joints] for row in rows]
            return along(self._now, path, joints, dt)
        goals = [
            JointGoal(self._ends[joint.name], max_speed=self._speed)
            if joint.name in self._ends
            else REST
            for joint in joints
        ]
        return ramp(self._now, goals, joints, dt)

    def _lost(self, posture: tuple[JointPoint, ...]) -> bool:
        """Return whether the gate holds the joints elsewhere: then they start from there."""
        return any(
            abs(sent.position - point.position) > LOST_TICKS * TICK_S * joint.max_speed
            for sent, point, joint in zip(self._sent, posture, self._body.joints, strict=True)
        )

    def _watch_progress(self, posture: tuple[JointPoint, ...]) -> None:
        places = zip(self._body.joints, posture, strict=True)
        left = sum(abs(p.position - self._ends.get(j.name, p.position)) for j, p in places)
        if not self._over or left < self._least - ARRIVED:
            self._least, self._progress_tick = left, self._tick

    @property
    def _over(self) -> bool:
        """Return whether the time of the path is over, or there is none."""
        return self._path is None or (self._tick - self._path_tick) * TICK_S >= self._path.seconds

    @property
    def held_back(self) -> bool:
        """Return whether the gate has not sent the joints nearer to their goals for a while."""
        return not self.arrived and self._tick - self._progress_tick > HELD_BACK_TICKS

    @property
    def arrived(self) -> bool:
        """Return whether all joints have been sent to their goals."""
        return self._over and all(
            abs(self.posture[name] - place) < ARRIVED for name, place in self._ends.items()
        )

    def reached(self, state: RobotState) -> bool:
        """Return whether all joints are where they should get, as sent and as measured.

        They were sent there twice: in passing, they would go on when the commands end.
        """
        here = measured(self._body, state)
        if not (here and self.arrived):
            return False
        return all(
            abs(before.position - end) <= SENT
            and abs(now.position - end) <= SENT
            and abs(point.position - end) <= (joint.goal_tolerance or math.inf)
            for joint, before, now, point in zip(
                self._body.joints, *self._postures, here, strict=True
            )
            if (end := self._ends.get(joint.name)) is not None
        )
