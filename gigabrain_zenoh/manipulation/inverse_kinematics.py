"""Inverse kinematics: the posture in which the tool is where it should be, or why there is none.

Damped least squares (Levenberg and Marquardt) within the limits of the joints. The place goes
before the orientation: an arm with five joints has few of the orientations, but can be in most
places. It starts from the given posture, then from those of a table that come nearest to the goal.
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
FIRST_M = 0.001  # the same, where orientation has to stand back
TABLE_POSTURES = 3000
FIRST_STEPS, STEPS = 15, 60  # of a descent: from each start, and from where it comes near
NEAR_M = 0.001  # of both errors together, beyond those that the goal allows
AT_ONCE = 4  # descents from postures of the table
NEAREST = 6  # where no posture reaches the goal: those from which it is tried in earnest
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

    @functools.cached_property
    def frame(self) -> Floats:
        """Its axes and place (3, 4); zeros for what does not count."""
        frame = np.zeros((3, 4))
        frame[:, 3] = self.position
        if self.axes is not None:
            frame[:, :3] = self.axes
        elif self.approach is not None:
            frame[:, 0] = self.approach
        return frame

    @property
    def part(self) -> int:
        """Which part of the frame counts."""
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


@dataclass(frozen=True, eq=False)
class _Found:
    """The posture in which a descent has ended, and its errors."""

    posture: Floats
    held: Flags  # (n,) joints that would go on, were they not at their limits
    position_error: float
    orientation_error: float

    def reaches(self, goal: ToolGoal) -> bool:
        near = self.position_error < POSITION_TOLERANCE_M
        return near and self.orientation_error <= goal.orientation_tolerance

    @property
    def cost(self) -> float:
        """Both errors together, as the descent weighs them [m]."""
        return math.hypot(self.position_error, ARMS_LENGTH_M * self.orientation_error)

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
        for now in self._found(goal, start, tries):
            found.append(now)
            if now.reaches(goal):
                touches = collides(now.posture) if collides else ""
                if not touches:
                    return Reachable(
                        posture=now.posture,
                        position_error=now.position_error,
                        orientation_error=now.orientation_error,
                    )
                touching = touching or now.out_of_reach("collision", f"collides: {touches}")
        return touching or self._explain(self._nearest(goal, found))

    def _found(self, goal: ToolGoal, start: Floats | None, tries: int) -> Iterator[_Found]:
        """Yield the ends of all descents, few at a time: an early one often reaches the goal."""
        if start is not None:
            yield from self._ends(goal, np.clip(start, *self._limits)[None])
        starts = self._starts(goal, tries)
        for at in range(0, len(starts), AT_ONCE):
            yield from self._ends(goal, starts[at : at + AT_ONCE])

    def _ends(self, goal: ToolGoal, starts: Floats) -> Iterator[_Found]:
        near = NEAR_M + ARMS_LENGTH_M * goal.orientation_tolerance
        for now in self._descend(goal, starts, FIRST_STEPS):
            yield self._refined(goal, now) if now.cost < near else now

    def _nearest(self, goal: ToolGoal, found: Sequence[_Found]) -> _Found:
        """Return what comes nearest to a goal that is out of reach, the place before the rest."""
        best = sorted(found, key=lambda one: one.cost)[:NEAREST]
        refined = [self._refined(goal, one) for one in best]
        if goal.part != PLACE:
            starts = self._starts(ToolGoal(position=goal.position), NEAREST)[:NEAREST]
            refined += self._descend(goal, starts, STEPS, FIRST_M)
        return min(refined, key=_Found.rank)

    def _starts(self, goal: ToolGoal, tries: int) -> Floats:
        """Return the postures of the table (k, n) to begin with."""
        off = ((self._places - goal.position) ** 2).sum(axis=1)
        if goal.axes is not None:
            off += ARMS_LENGTH_M**2 * ((self._axes - goal.axes) ** 2).sum(axis=(1, 2))
        elif goal.approach is not None:
            off += ARMS_LENGTH_M**2 * ((self._axes[:, :, 0] - goal.approach) ** 2).sum(axis=1)
        near = min(tries, NEAR_TRIES)
        nearest = np.argpartition(off, near)[:near]
        nearest = nearest[np.argsort(off[nearest], kind="stable")]
        return np.concatenate((self._table[nearest], self._table[: tries - near]))

    def _refined(self, goal: ToolGoal, found: _Found) -> _Found:
        """Descend as far as it goes; where the orientation pulls the tool away, it stands back."""
        for weight in (FIRST_M, 0.0):
            if found.position_error >= POSITION_TOLERANCE_M:
                (found,) = self._descend(goal, found.posture[None], STEPS, weight)
        return found

    def _descend(
        self, goal: ToolGoal, starts: Floats, steps: int, weight: float = ARMS_LENGTH_M
    ) -> list[_Found]:
        """Return the ends of descents from postures (k, n)."""
        postures, held = starts.copy(), np.zeros(starts.shape, np.bool_)
        errors = np.empty((len(starts), 2))
        frame, part = goal.frame, goal.part
        weight = 0.0 if part == PLACE else weight
        descend(self.arm.chain, self._limits, frame, part, weight, steps, postures, held, errors)
        ends = zip(postures, held, errors.tolist(), strict=True)
        return [_Found(posture, stuck, *off) for posture, stuck, off in ends]

    def _explain(self, found: _Found) -> OutOfReach:
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
    """Return points (count, dimensions) in 0 to 1 that cover it evenly (Roberts' sequence)."""
    root = 2.0
    for _ in range(60):  # towards the root of x**(dimensions + 1) = x + 1
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    steps = root ** -np.arange(1.0, dimensions + 1)
    return np.asarray((0.5 + np.outer(np.arange(1, count + 1), steps)) % 1.0)
