"""Times a path of postures within the limits of speed, acceleration and jerk, by Ruckig.

Ruckig's community edition plans from one state to the next; intermediate waypoints need its cloud
service. So states at the corners of a path are chosen here: where all joints go on in the direction
in which they came, they pass through with a speed, as monotone cubic interpolation does; where the
path bends back they stop. A curve through corners strays from the straight lines that were
found free, so its postures are looked at once more: where one is not free, it passes more slowly,
and at last stops, which is a straight line again.

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
SPEEDS = (1.0, 0.7, 0.5, 0.35, 0.2, 0.1, 0.0)  # shares of the speed at corners that are tried
FAST = 0.5  # of the joints' speeds
ACCELERATION_SHARE = 0.5
MAX_STRAY = 0.02  # of a part's longest move
SPARE = 1e-9
MARGIN_SHARE = 0.5  # of the checker's margin, that is kept where corners are cut


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTrajectory:
    """The motion of joints over time. It begins with the present state and ends at rest."""

    names: tuple[str, ...]
    times: Floats  # (k,) [s] from the start, rising
    positions: Floats  # (k, n) [rad] or [m]
    velocities: Floats  # (k, n) [rad/s] or [m/s]
    accelerations: Floats  # (k, n) [rad/s2] or [m/s2]

    @property
    def duration(self) -> float:
        """Return the duration [s]."""
        return float(self.times[-1])


def eased(
    joints: Sequence[JointDescription], speed: float, acceleration: float = ACCELERATION_SHARE
) -> list[JointDescription]:
    """Return joints with shares of the speed, and of the acceleration and jerk, that they can.

    What is left is for control: a joint that lags is sent ahead by its speed, and corrected.
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
    """Makes trajectories within the limits of some joints."""

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
            checker: Says where the arm may be.

        Raises:
            Refused: The start is so fast that limits or the checker's margin would be broken.
        """
        rest = np.zeros(postures.shape[1])
        start = rest if velocity is None else velocity
        distinct = np.abs(np.diff(postures, axis=0)).max(axis=1) > SPARE
        postures = postures[np.concatenate(([True], distinct))]
        speeds = self._corner_speeds(postures)
        shares = np.zeros(len(speeds), int)  # of SPEEDS, of each posture
        while True:
            states = [start, *(speeds[k] * SPEEDS[shares[k]] for k in range(1, len(speeds)))]
            parts, bad = self._parts(postures, states, checker)
            if not bad:
                break
            for corner in bad:  # pass both ends of a part more slowly
                shares[corner] = min(shares[corner] + 1, len(SPEEDS) - 1)
        stops, _ = self._parts(postures, [start, *(rest for _ in speeds[1:])], checker)
        return self._sampled(postures[0], min(parts, stops, key=_duration))

    def _corner_speeds(self, postures: Floats) -> list[Floats]:
        """Return the velocity (n,) at each posture: 0 at the ends and where a joint turns back."""
        moves = np.diff(postures, axis=0)
        times = (np.abs(moves) / self._speeds).max(axis=1, initial=SPARE)
        slopes = moves / times[:, None]
        rest = np.zeros(postures.shape[1])
        found = [rest]
        for before, after in pairwise(slopes):
            onward = before * after > 0
            mean = 2 * before * after / np.where(onward, before + after, 1.0)
            mean = np.clip(mean, -self._speeds, self._speeds)  # it may be beyond by rounding
            found.append(np.where(onward, mean, 0.0))
        return [*found, rest] if len(postures) > 1 else found

    def _parts(
        self, postures: Floats, states: Sequence[Floats], checker: CollisionChecker | None
    ) -> tuple[list[ruckig.Trajectory], list[int]]:
        """Return the trajectories between postures, and corners that were passed too fast."""
        parts, bad = [], set()
        for k in range(len(postures) - 1):
            part = self._part(postures[k], states[k], postures[k + 1], states[k + 1])
            parts.append(part)
            corners = [c for c in (k, k + 1) if 0 < c < len(postures) - 1 and np.any(states[c])]
            moving = k == 0 and bool(np.any(states[0]))  # it may have to turn back first
            strays = not moving and _strays(part, postures[k : k + 2])
            if (corners or moving) and (strays or not self._is_clear(part, checker)):
                if not corners:
                    raise Refused("the arm moves too fast to turn into the path without a contact")
                bad.update(corners)
        return parts, sorted(bad)

    def _part(
        self, start: Floats, velocity: Floats, goal: Floats, goal_velocity: Floats
    ) -> ruckig.Trajectory:
        count = len(start)
        given, result = ruckig.InputParameter(count), ruckig.Trajectory(count)
        given.current_position, given.current_velocity = start.tolist(), velocity.tolist()
        given.current_acceleration = given.target_acceleration = [0.0] * count
        given.target_position, given.target_velocity = goal.tolist(), goal_velocity.tolist()
        given.max_velocity = [one.max_speed for one in self.joints]
        given.max_acceleration = [one.max_acceleration for one in self.joints]
        given.max_jerk = [one.max_jerk for one in self.joints]
        given.synchronization = ruckig.Synchronization.Phase  # a straight line from rest to rest
        try:
            self._otg.calculate(given, result)
        except ruckig.RuckigError as error:
            why = str(error).strip()
            raise Refused(f"no trajectory within the limits of the joints: {why}") from None
        return result

    def _is_clear(self, part: ruckig.Trajectory, checker: CollisionChecker | None) -> bool:
        """Return whether a part touches nothing."""
        if checker is None:
            return True
        times = np.append(np.arange(0.0, part.duration, self.period), part.duration)
        postures = [np.array(part.at_time(time)[0]) for time in times]
        return all(checker.is_line_free(a, b, MARGIN_SHARE) for a, b in pairwise(postures))

    def _sampled(self, start: Floats, parts: Sequence[ruckig.Trajectory]) -> JointTrajectory:
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


def _strays(part: ruckig.Trajectory, ends: Floats) -> bool:
    """Return whether a part leaves the box between its ends (2, n)."""
    spare = MAX_STRAY * np.abs(ends[1] - ends[0]).max()
    low, high = ends.min(axis=0) - spare, ends.max(axis=0) + spare
    extremes = zip(part.position_extrema, low, high, strict=True)
    return any(one.min < lower or one.max > upper for one, lower, upper in extremes)
