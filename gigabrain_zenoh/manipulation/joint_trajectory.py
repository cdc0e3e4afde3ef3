"""Times a path of postures within the limits of speed, acceleration and jerk, by Ruckig.

Ruckig's community edition plans from one state to the next; intermediate waypoints need its cloud
service. So this module chooses the states at the corners of a path. A joint that goes on in the
same direction passes a corner with a speed, as in monotone cubic interpolation. A joint that turns
back stops there. A curve through corners leaves the straight lines that were checked, so its
postures are checked again. Where one is not free, the arm passes the corner more slowly, and at
last stops there, which gives a straight line again.

Berscheid and Kröger, Jerk-limited real-time trajectory generation with arbitrary target states,
RSS 2021.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import ruckig
from msgspec.structs import replace

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import JointDescription
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.manipulation.collision import CollisionChecker

PERIOD_S = 0.02  # between points
SPEEDS = (1.0, 0.7, 0.5, 0.35, 0.2, 0.1, 0.0)  # shares of a corner's speed, in the order of tries
FAST = 0.5  # share of the joints' top speeds
ACCELERATION_SHARE = 0.5  # of the joints' largest acceleration and jerk
MAX_STRAY = 0.02  # share of a part's longest joint motion
MIN_MOVE = 1e-9  # [rad] or [m]; smaller moves are left out
MARGIN_SHARE = 0.5  # of the checker's margin, which is kept where corners are cut


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTrajectory:
    """Motion of joints over time. It begins at the present state and ends at rest."""

    names: tuple[str, ...]
    times: Floats  # (k,) [s] from the start, rising
    positions: Floats  # (k, n) [rad] or [m]
    velocities: Floats  # (k, n) [rad/s] or [m/s]
    accelerations: Floats  # (k, n) [rad/s2] or [m/s2]

    @property
    def duration(self) -> float:
        """The time from the start to the end [s]."""
        return float(self.times[-1])


def eased(
    joints: Sequence[JointDescription], speed: float, acceleration: float = ACCELERATION_SHARE
) -> list[JointDescription]:
    """Return joints with lower limits: shares of their speed, and of their acceleration and jerk.

    The rest is for control, which corrects joints that lag.
    """
    return [
        replace(
            joint,
            max_speed=speed * joint.max_speed,
            max_acceleration=acceleration * joint.max_acceleration,
            max_jerk=acceleration * joint.max_jerk,
        )
        for joint in joints
    ]


class TimeParametrization:
    """Makes trajectories within the limits of the given joints."""

    def __init__(self, joints: Sequence[JointDescription], period: float = PERIOD_S) -> None:
        """Take the joints' limits; points are `period` [s] apart."""
        self.joints, self.period = tuple(joints), period
        self._otg = ruckig.Ruckig(len(joints))
        self._speeds = np.array([one.max_speed for one in joints])

    def trajectory(
        self,
        postures: Floats,
        *,
        velocity: Floats | None = None,
        checker: CollisionChecker | None = None,
    ) -> JointTrajectory:
        """Return the trajectory through `postures` (k, n).

        Args:
            postures: From the start to the goal, with straight lines between them.
            velocity: Of the joints at the start (n,); at rest otherwise.
            checker: Checks the trajectory for collisions; without it, none are looked for.

        Raises:
            Refused: The start is too fast for the limits or the checker's margin.
        """
        rest = np.zeros(postures.shape[1])
        start = rest if velocity is None else velocity
        distinct = np.abs(np.diff(postures, axis=0)).max(axis=1) > MIN_MOVE
        postures = postures[np.concatenate(([True], distinct))]
        speeds = self._corner_speeds(postures)
        shares = np.zeros(len(speeds), int)  # index into SPEEDS for each posture
        while True:
            states = [start, *(speeds[k] * SPEEDS[shares[k]] for k in range(1, len(speeds)))]
            parts, bad = self._parts(postures, states, checker)
            if not bad:
                break
            for corner in bad:  # pass both ends of a part more slowly
                shares[corner] = min(shares[corner] + 1, len(SPEEDS) - 1)
        stops, _ = self._parts(postures, [start, *(rest for _ in speeds[1:])], checker)
        return self._sample(postures[0], min(parts, stops, key=_duration))

    def _corner_speeds(self, postures: Floats) -> list[Floats]:
        """Return the velocity (n,) at each posture: 0 at the ends, and where a joint turns back."""
        moves = np.diff(postures, axis=0)
        times = (np.abs(moves) / self._speeds).max(axis=1, initial=MIN_MOVE)
        slopes = moves / times[:, None]
        rest = np.zeros(postures.shape[1])
        found = [rest]
        for before, after in pairwise(slopes):
            onward = before * after > 0
            mean = 2 * before * after / np.where(onward, before + after, 1.0)
            mean = np.clip(mean, -self._speeds, self._speeds)  # rounding may exceed the limit
            found.append(np.where(onward, mean, 0.0))
        return [*found, rest] if len(postures) > 1 else found

    def _parts(
        self, postures: Floats, states: Sequence[Floats], checker: CollisionChecker | None
    ) -> tuple[list[ruckig.Trajectory], list[int]]:
        """Return the trajectories between postures, and the corners that are passed too fast."""
        parts, bad = [], set()
        for k in range(len(postures) - 1):
            part = self._part(postures[k], states[k], postures[k + 1], states[k + 1])
            parts.append(part)
            corners = [c for c in (k, k + 1) if 0 < c < len(postures) - 1 and np.any(states[c])]
            moving = k == 0 and bool(np.any(states[0]))  # it may have to turn round first
            strays = not moving and _leaves_box(part, postures[k : k + 2])
            if (corners or moving) and (strays or not self._is_clear(part, checker)):
                if not corners:
                    raise Refused("the arm moves too fast to turn into the path without a contact")
                bad.update(corners)
        return parts, sorted(bad)

    def _part(
        self, start: Floats, velocity: Floats, goal: Floats, goal_velocity: Floats
    ) -> ruckig.Trajectory:
        count = len(start)
        request, result = ruckig.InputParameter(count), ruckig.Trajectory(count)
        request.current_position, request.current_velocity = start.tolist(), velocity.tolist()
        request.current_acceleration = request.target_acceleration = [0.0] * count
        request.target_position, request.target_velocity = goal.tolist(), goal_velocity.tolist()
        request.max_velocity = [one.max_speed for one in self.joints]
        request.max_acceleration = [one.max_acceleration for one in self.joints]
        request.max_jerk = [one.max_jerk for one in self.joints]
        request.synchronization = ruckig.Synchronization.Phase  # a straight line from rest to rest
        try:
            self._otg.calculate(request, result)
        except ruckig.RuckigError as error:
            problem = str(error).strip()
            raise Refused(f"no trajectory within the limits of the joints: {problem}") from None
        return result

    def _is_clear(self, part: ruckig.Trajectory, checker: CollisionChecker | None) -> bool:
        """Return whether a part touches nothing."""
        if checker is None:
            return True
        times = np.append(np.arange(0.0, part.duration, self.period), part.duration)
        postures = [np.array(part.at_time(time)[0]) for time in times]
        return all(checker.is_line_free(a, b, MARGIN_SHARE) for a, b in pairwise(postures))

    def _sample(self, start: Floats, parts: Sequence[ruckig.Trajectory]) -> JointTrajectory:
        rest = np.zeros(len(start))
        ends = np.cumsum([0.0, *(part.duration for part in parts)])
        times = np.append(np.arange(0.0, ends[-1], self.period), ends[-1])
        rows = []
        for time in times:
            part = min(int(np.searchsorted(ends, time, "right")) - 1, len(parts) - 1)
            state = parts[part].at_time(time - ends[part]) if parts else (start, rest, rest)
            rows.append(np.array(state))
        states = np.array(rows)
        return JointTrajectory(
            names=tuple(one.name for one in self.joints), times=times,
            positions=states[:, 0], velocities=states[:, 1], accelerations=states[:, 2],
        )  # fmt: skip


def _duration(parts: Sequence[ruckig.Trajectory]) -> float:
    return float(sum(part.duration for part in parts))


def _leaves_box(part: ruckig.Trajectory, ends: Floats) -> bool:
    """Return whether a part leaves the box in joint space between its `ends` (2, n)."""
    tolerance = MAX_STRAY * np.abs(ends[1] - ends[0]).max()
    low, high = ends.min(axis=0) - tolerance, ends.max(axis=0) + tolerance
    extremes = zip(part.position_extrema, low, high, strict=True)
    return any(one.min < lower or one.max > upper for one, lower, upper in extremes)
