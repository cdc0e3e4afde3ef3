"""Inverse kinematics: finds a posture for a pose of the tool, or explains why there is none.

Damped least squares (Levenberg-Marquardt) within the limits of the joints. The position is more
important than the orientation: an arm with five joints reaches most positions, but in few
orientations. It starts from the given posture, then from the nearest ones of a table.
"""

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.manipulation.descent import APPROACH, AXES, PLACE, Flags, descend

POSITION_TOLERANCE_M = 1e-4
ORIENTATION_TOLERANCE_RAD = 0.01
ARMS_LENGTH_M = 0.05  # a radian of orientation counts as much as this distance
FIRST_M = 0.001  # the same, where the position comes first
TABLE_POSTURES = 3000
FIRST_STEPS, STEPS = 15, 60  # of a descent: from each start, and to refine a near posture
NEAR_M = 0.001  # largest combined error of a near posture, beyond the goal's tolerance
AT_ONCE = 4  # start postures of one call of `descend`
NEAREST = 6  # postures that are refined if none reaches the goal
NEAR_TRIES, TRIES = 16, 60  # start postures: the nearest of the table, and the total

Cause = Literal["too_far", "joint_limit", "orientation", "collision", "invalid"]
Collides = Callable[[Floats], str]  # names what touches in a posture; empty if nothing does


@dataclass(frozen=True, kw_only=True, eq=False)
class ToolGoal:
    """The wanted pose of the tool, in the frame of the arm's base.

    With `axes`, its full orientation counts; with `approach`, the direction of its x axis; with
    neither, only its position.
    """

    position: Floats  # (3,) [m]
    axes: Floats | None = None  # (3, 3), a rotation
    approach: Floats | None = None  # (3,), of length 1
    orientation_tolerance: float = ORIENTATION_TOLERANCE_RAD  # [rad]

    @functools.cached_property
    def frame(self) -> Floats:
        """Its axes and position (3, 4); zeros for axes that do not count."""
        frame = np.zeros((3, 4))
        frame[:, 3] = self.position
        if self.axes is not None:
            frame[:, :3] = self.axes
        elif self.approach is not None:
            frame[:, 0] = self.approach
        return frame

    @property
    def part(self) -> int:
        """The part of the frame that counts: PLACE, APPROACH or AXES."""
        if self.axes is not None:
            return AXES
        return PLACE if self.approach is None else APPROACH

    @property
    def fault(self) -> str:
        """Return why the goal is invalid; empty for a valid one."""
        given = [self.position, self.axes, self.approach]
        if not all(np.all(np.isfinite(one)) for one in given if one is not None):
            return "the goal has to be finite"
        if self.axes is not None:
            square = np.allclose(self.axes.T @ self.axes, np.eye(3), atol=1e-6)
            return "" if square and np.linalg.det(self.axes) > 0 else "the axes are no rotation"
        if self.approach is not None and abs(math.hypot(*self.approach) - 1.0) > 1e-6:
            return "the approach has to be a direction of length 1"
        return ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Reachable:
    """A posture in which the tool meets its goal."""

    posture: Floats  # (n,) [rad] or [m]
    position_error: float  # [m]
    orientation_error: float  # [rad]


@dataclass(frozen=True, kw_only=True, eq=False)
class OutOfReach:
    """A goal that the tool does not reach: the reason, and the nearest posture."""

    cause: Cause
    reason: str  # for people
    posture: Floats | None  # (n,) [rad] or [m]; None for an invalid goal
    position_error: float = math.inf  # [m]
    orientation_error: float = math.inf  # [rad]


@dataclass(frozen=True, eq=False)
class _DescentEnd:
    """The posture at the end of a descent, and its errors."""

    posture: Floats
    held: Flags  # (n,) joints that their limits keep from moving on
    position_error: float
    orientation_error: float

    def reaches(self, goal: ToolGoal) -> bool:
        at_position = self.position_error < POSITION_TOLERANCE_M
        return at_position and self.orientation_error <= goal.orientation_tolerance

    @property
    def cost(self) -> float:
        """The combined error, as the descent weighs it [m]."""
        return math.hypot(self.position_error, ARMS_LENGTH_M * self.orientation_error)

    def rank(self) -> tuple[float, float]:
        """Sort key: the position error in steps of 1 mm, then the orientation error."""
        steps = round(self.position_error / (10 * POSITION_TOLERANCE_M))
        return steps, round(self.orientation_error, 2)

    def out_of_reach(self, cause: Cause, reason: str) -> OutOfReach:
        return OutOfReach(
            cause=cause, reason=reason, posture=self.posture,
            position_error=self.position_error, orientation_error=self.orientation_error,
        )  # fmt: skip


class InverseKinematics:
    """Deterministic solver for the postures of one arm. Not for two threads at once."""

    def __init__(self, arm: ArmKinematics, spare: float = 0.0) -> None:
        """Take an arm; `spare` is the share of each joint's range to keep free at its ends."""
        self.arm = arm
        free = spare * (arm.upper - arm.lower)
        self._limits = np.stack((arm.lower + free, arm.upper - free))
        self._table = arm.lower + spread(TABLE_POSTURES, len(arm.joints)) * (arm.upper - arm.lower)
        frames = [arm.forward(posture) for posture in self._table]
        self._places = np.array([frame.position for frame in frames])
        self._axes = np.array([frame.axes for frame in frames])

    def solve(
        self,
        goal: ToolGoal,
        start: Floats | None = None,
        collides: Collides | None = None,
        tries: int = TRIES,
    ) -> Reachable | OutOfReach:
        """Return the first posture found, or the reason why there is none.

        Args:
            goal: Wanted pose of the tool.
            start: First start posture (n,), such as the present one; results tend to be near it.
            collides: Returns the forbidden contact of a posture as text; empty if there is none.
            tries: Start postures from the table; a few reach most goals, and fail sooner.
        """
        if fault := goal.fault:
            return OutOfReach(cause="invalid", reason=fault, posture=None)
        found: list[_DescentEnd] = []
        touching: OutOfReach | None = None
        for end in self._descents(goal, start, tries):
            found.append(end)
            if end.reaches(goal):
                touches = collides(end.posture) if collides else ""
                if not touches:
                    return Reachable(
                        posture=end.posture,
                        position_error=end.position_error,
                        orientation_error=end.orientation_error,
                    )
                touching = touching or end.out_of_reach("collision", f"collides: {touches}")
        return touching or self._explain(self._nearest(goal, found))

    def _descents(self, goal: ToolGoal, start: Floats | None, tries: int) -> Iterator[_DescentEnd]:
        """Yield the ends of all descents, a few at a time: an early one often reaches the goal."""
        if start is not None:
            yield from self._descend_and_refine(goal, np.clip(start, *self._limits)[None])
        starts = self._starts(goal, tries)
        for at in range(0, len(starts), AT_ONCE):
            yield from self._descend_and_refine(goal, starts[at : at + AT_ONCE])

    def _descend_and_refine(self, goal: ToolGoal, starts: Floats) -> Iterator[_DescentEnd]:
        near = NEAR_M + ARMS_LENGTH_M * goal.orientation_tolerance
        for end in self._descend(goal, starts, FIRST_STEPS):
            yield self._refine(goal, end) if end.cost < near else end

    def _nearest(self, goal: ToolGoal, found: Sequence[_DescentEnd]) -> _DescentEnd:
        """Return the nearest posture to an unreachable goal; the position comes first."""
        best = sorted(found, key=lambda one: one.cost)[:NEAREST]
        refined = [self._refine(goal, one) for one in best]
        if goal.part != PLACE:
            starts = self._starts(ToolGoal(position=goal.position), NEAREST)[:NEAREST]
            refined += self._descend(goal, starts, STEPS, FIRST_M)
        return min(refined, key=_DescentEnd.rank)

    def _starts(self, goal: ToolGoal, tries: int) -> Floats:
        """Return start postures (k, n) from the table."""
        off = ((self._places - goal.position) ** 2).sum(axis=1)
        if goal.axes is not None:
            off += ARMS_LENGTH_M**2 * ((self._axes - goal.axes) ** 2).sum(axis=(1, 2))
        elif goal.approach is not None:
            off += ARMS_LENGTH_M**2 * ((self._axes[:, :, 0] - goal.approach) ** 2).sum(axis=1)
        near = min(tries, NEAR_TRIES)
        nearest = np.argpartition(off, near)[:near]
        nearest = nearest[np.argsort(off[nearest], kind="stable")]
        return np.concatenate((self._table[nearest], self._table[: tries - near]))

    def _refine(self, goal: ToolGoal, found: _DescentEnd) -> _DescentEnd:
        """Descend to the end; if the orientation pulls the tool away, lower its weight."""
        for weight in (FIRST_M, 0.0):
            if found.position_error >= POSITION_TOLERANCE_M:
                (found,) = self._descend(goal, found.posture[None], STEPS, weight)
        return found

    def _descend(
        self, goal: ToolGoal, starts: Floats, steps: int, weight: float = ARMS_LENGTH_M
    ) -> list[_DescentEnd]:
        """Return the end of the descent from each of `starts` (k, n)."""
        postures, held = starts.copy(), np.zeros(starts.shape, np.bool_)
        errors = np.empty((len(starts), 2))
        frame, part = goal.frame, goal.part
        weight = 0.0 if part == PLACE else weight
        descend(self.arm.chain, self._limits, frame, part, weight, steps, postures, held, errors)
        ends = zip(postures, held, errors.tolist(), strict=True)
        return [_DescentEnd(posture, stopped, *error) for posture, stopped, error in ends]

    def _explain(self, found: _DescentEnd) -> OutOfReach:
        arm = self.arm
        held = " and ".join(
            f"{arm.names[joint]} is at its limit of {arm.show(joint, found.posture[joint])}"
            for joint in np.flatnonzero(found.held).tolist()
        )
        because = f": {held}" if held else ""
        if found.position_error < POSITION_TOLERANCE_M:
            off = f"{math.degrees(found.orientation_error):.0f}°"
            reason = f"the orientation is not possible there, off by {off}{because}"
            return found.out_of_reach("orientation", reason)
        reason = f"too far by {found.position_error * 100:.1f} cm{because}"
        return found.out_of_reach("joint_limit" if held else "too_far", reason)


def spread(count: int, dimensions: int) -> Floats:
    """Return points (count, dimensions) spread evenly over 0 to 1 (Roberts' sequence)."""
    root = 2.0
    for _ in range(60):  # converges to the root of x**(dimensions + 1) = x + 1
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    steps = root ** -np.arange(1.0, dimensions + 1)
    return np.asarray((0.5 + np.outer(np.arange(1, count + 1), steps)) % 1.0)
