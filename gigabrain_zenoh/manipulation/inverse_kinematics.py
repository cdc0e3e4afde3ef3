"""Inverse kinematics: the posture in which the tool is where it should be, or why there is none.

Damped least squares (Levenberg and Marquardt) within the limits of the joints. The place goes
before the orientation: an arm with five joints has few of the orientations, but can be in most
places. It starts from the given posture, then from those of a table that come nearest to the goal.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.manipulation.descent import APPROACH, AXES, PLACE, descend

POSITION_TOLERANCE_M = 1e-4
ORIENTATION_TOLERANCE_RAD = 0.01
ARMS_LENGTH_M = 0.05  # a radian of orientation counts as much as this distance
FIRST_M = 0.001  # the same, where orientation has to stand back
TABLE_POSTURES = 3000
NEAR_TRIES, TRIES = 16, 60  # postures of the table: those nearest to the goal, then any others

Cause = Literal["too_far", "joint_limit", "orientation", "collision", "invalid"]
Collides = Callable[[Floats], str]  # of a posture: what touches what, empty for nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class ToolGoal:
    """The wanted pose of the tool, in the frame of the arm's base.

    With `axes` its whole orientation counts, with `approach` alone only the direction of its
    x axis, with neither its place only.
    """

    position: Floats  # (3,) [m]
    axes: Floats | None = None  # (3, 3), a rotation
    approach: Floats | None = None  # (3,), of length 1
    orientation_tolerance: float = ORIENTATION_TOLERANCE_RAD  # [rad]

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
    """A posture in which the tool is where it should be."""

    posture: Floats  # (n,) [rad] or [m]
    position_error: float  # [m]
    orientation_error: float  # [rad]


@dataclass(frozen=True, kw_only=True, eq=False)
class OutOfReach:
    """A goal that the tool does not reach: why, and the posture that comes nearest to it."""

    cause: Cause
    reason: str  # for people
    posture: Floats | None  # (n,) [rad] or [m]; None for a goal that is none
    position_error: float = math.inf  # [m]
    orientation_error: float = math.inf  # [rad]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Found:
    """The posture in which a descent has ended, and its errors."""

    posture: Floats
    position_error: float
    orientation_error: float
    held: tuple[int, ...]  # joints that would go on, were they not at their limits

    def reaches(self, goal: ToolGoal) -> bool:
        near = self.position_error < POSITION_TOLERANCE_M
        return near and self.orientation_error <= goal.orientation_tolerance

    @property
    def rank(self) -> tuple[float, float]:
        """The place first, in steps within which the orientation decides."""
        steps = round(self.position_error / (10 * POSITION_TOLERANCE_M))
        return steps, round(self.orientation_error, 2)

    def out_of_reach(self, cause: Cause, reason: str) -> OutOfReach:
        return OutOfReach(
            cause=cause, reason=reason, posture=self.posture,
            position_error=self.position_error, orientation_error=self.orientation_error,
        )  # fmt: skip


class InverseKinematics:
    """Solves for postures of one arm, deterministically. Not for two threads at once."""

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
        """Return the first posture that is found, or why there is none.

        Args:
            goal: Where the tool should be.
            start: A posture (n,) to begin with, as the present one; results tend to be near it.
            collides: Says what a posture touches that it must not.
            tries: Postures of the table to begin with; few find most goals, and fail sooner.
        """
        if fault := goal.fault:
            return OutOfReach(cause="invalid", reason=fault, posture=None)
        found: list[_Found] = []
        touching: OutOfReach | None = None
        for begin in self._starts(goal, start, tries):
            found.append(now := self._descend(goal, begin))
            if now.reaches(goal):
                touches = collides(now.posture) if collides else ""
                if not touches:
                    return Reachable(
                        posture=now.posture,
                        position_error=now.position_error,
                        orientation_error=now.orientation_error,
                    )
                touching = touching or now.out_of_reach("collision", f"collides: {touches}")
        return touching or self._explain(min(found, key=lambda one: one.rank))

    def _starts(self, goal: ToolGoal, start: Floats | None, tries: int) -> Iterator[Floats]:
        if start is not None:
            yield np.clip(start, *self._limits)
        off = ((self._places - goal.position) ** 2).sum(axis=1)
        if goal.axes is not None:
            off += ARMS_LENGTH_M**2 * ((self._axes - goal.axes) ** 2).sum(axis=(1, 2))
        elif goal.approach is not None:
            off += ARMS_LENGTH_M**2 * ((self._axes[:, :, 0] - goal.approach) ** 2).sum(axis=1)
        near = min(tries, NEAR_TRIES)
        nearest = np.argpartition(off, near)[:near]
        yield from self._table[nearest[np.argsort(off[nearest], kind="stable")]]
        yield from self._table[: tries - near]

    def _descend(self, goal: ToolGoal, posture: Floats) -> _Found:
        frame, part = np.zeros((3, 4)), PLACE
        frame[:, 3] = goal.position
        if goal.axes is not None:
            frame[:, :3], part = goal.axes, AXES
        elif goal.approach is not None:
            frame[:, 0], part = goal.approach, APPROACH
        posture, held, error = posture.copy(), np.zeros(len(posture), np.bool_), np.zeros(6)
        for weight in (ARMS_LENGTH_M, FIRST_M, 0.0):
            descend(self.arm.chain, self._limits, frame, part, weight, posture, held, error)
            place, turn = math.hypot(*error[:3]), math.hypot(*error[3:])
            if place < POSITION_TOLERANCE_M:
                break  # else the orientation has pulled it away
        return _Found(
            posture=posture, position_error=place, orientation_error=turn,
            held=tuple(np.flatnonzero(held).tolist()),
        )  # fmt: skip

    def _explain(self, found: _Found) -> OutOfReach:
        arm = self.arm
        held = " and ".join(
            f"{arm.names[joint]} is at its limit of {arm.show(joint, found.posture[joint])}"
            for joint in found.held
        )
        because = f": {held}" if held else ""
        if found.position_error < POSITION_TOLERANCE_M:
            off = f"{math.degrees(found.orientation_error):.0f}°"
            reason = f"the orientation is not possible there, off by {off}{because}"
            return found.out_of_reach("orientation", reason)
        reason = f"too far by {found.position_error * 100:.1f} cm{because}"
        return found.out_of_reach("joint_limit" if held else "too_far", reason)


def spread(count: int, dimensions: int) -> Floats:
    """Return points (count, dimensions) in 0 to 1 that cover it evenly (Roberts' sequence)."""
    root = 2.0
    for _ in range(60):  # towards the root of x**(dimensions + 1) = x + 1
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    steps = root ** -np.arange(1.0, dimensions + 1)
    return np.asarray((0.5 + np.outer(np.arange(1, count + 1), steps)) % 1.0)
