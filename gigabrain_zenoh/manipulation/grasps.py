"""Plans grasps of a thing from its pose and size: pose of the tool, width and tilt.

The tool's x axis is the approach, and the fingers close along its z axis. Boxes are held at
opposite faces, cylinders round their side, balls anywhere. The approach is from above, or tilted
about the axis along which the fingers close, up to horizontal. An arm with few joints may reach a
thing only with such a tilt.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics, Frame, Opening
from gigabrain_zenoh.manipulation.collision import CollisionChecker, Thing
from gigabrain_zenoh.manipulation.inverse_kinematics import (
    InverseKinematics,
    OutOfReach,
    Reachable,
    ToolGoal,
)

GAP_M = 0.006  # least gap between each finger and the thing, before they close
WIDE_GAP_M = 0.01  # the same if the gripper opens wide enough: a camera errs by 6 mm
WIDE = 0.6  # share of the widest opening; for wider things the tilt decides beyond ROOM_M
ROOM_M = 0.01  # sufficient clearance for a wide thing
MARGIN_M = 0.001  # of the open hand from everything else
TILTS_RAD = tuple(math.radians(angle) for angle in (0, 15, 30, 45, 60, 75, 90))
YAWS = 12  # directions round a cylinder or a sphere
RETREATS_M = (0.08, 0.05, 0.03)  # lengths of the approach; the first possible one is used
HEIGHTS = (0.0, 0.3, 0.6)  # of the tool above the thing's middle, as shares of half its height
TOLERANCE_RAD = math.radians(4)  # of the tool's orientation at the thing
DRIFT_RAD = math.radians(35)  # the same at the start of the approach
TRIES = 5  # start postures of inverse kinematics, per pose
ENOUGH_GRASPS = 8  # the search stops after so many
MIN_LEVEL = 0.3  # sine of the angle from the vertical to the axis along which fingers close
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True, eq=False)
class Grasp:
    """A way to grasp: postures before it and at it, between which the arm moves straight."""

    tool: Frame  # where the tool is when the fingers close
    width: float  # [m], of the thing between the fingers
    tilt: float  # [rad] of the approach; 0 from above
    opening: float  # [rad] or [m], of the gripper's joint during the approach
    closed: float  # [rad] or [m], the same when the fingers touch the thing
    before: Floats  # (n,) posture at the start of the approach
    posture: Floats  # (n,) posture at the thing
    clearance: float  # [m], of the arm from everything else


@dataclass(frozen=True, kw_only=True)
class NoGrasp:
    """The reason why a thing cannot be grasped."""

    reason: str  # for people


class GraspPlanner:
    """Finds ways to grasp things with one arm. Not for two threads at once."""

    def __init__(self, arm: ArmKinematics, inverse: InverseKinematics) -> None:
        """Take an arm. Raises ConfigError for one without gripper or pads."""
        self.arm, self._inverse, self._opening = arm, inverse, arm.opening()

    def grasps(
        self,
        thing: Thing,
        others: Sequence[Thing],
        start: Floats | None = None,
        enough: int = ENOUGH_GRASPS,
    ) -> list[Grasp] | NoGrasp:
        """Return grasps of a thing, those with the largest clearance first.

        A wide thing slips out of tilted grasps. For it, the most upright grasp with sufficient
        clearance is first.

        Args:
            thing: A box, cylinder or sphere, in the frame of the arm's base.
            others: What is around it: the table, other things.
            start: A posture (n,); results tend to be near it.
            enough: Number of grasps after which the search stops.
        """
        if thing.kind == "floor":
            raise ConfigError(f"{thing.name}: a floor cannot be grasped")
        found: list[Grasp] = []
        faults: list[OutOfReach] = []
        checkers: dict[float, tuple[CollisionChecker, CollisionChecker]] = {}
        for tool, width, tilt in candidates(thing, self._opening):
            if width not in checkers:
                checkers[width] = (
                    self._checker([thing, *others], width),
                    self._checker(others, width),
                )
            grasp = self._grasp(checkers[width][0], tool, start)
            if isinstance(grasp, OutOfReach):
                faults.append(grasp)
                continue
            before, posture = grasp
            found.append(Grasp(
                tool=tool, width=width, tilt=tilt, before=before, posture=posture,
                opening=self._opening.position(_open_width(width, self._opening)),
                closed=self._opening.position(width),
                clearance=checkers[width][1].clearance(posture).distance,
            ))  # fmt: skip
            if len(found) == enough:
                break
        if found:
            return self._sort(found, thing)
        if not faults:
            narrowest, widest = narrowest_width(thing), self._opening.widest - 2 * GAP_M
            return NoGrasp(
                reason=f"{thing.name} is {narrowest * 100:.1f} cm wide; "
                f"the gripper takes {widest * 100:.1f} cm"
            )
        nearest = min(faults, key=lambda one: (one.position_error, one.orientation_error))
        return NoGrasp(reason=f"{thing.name}: {nearest.reason}")

    def _sort(self, found: Sequence[Grasp], thing: Thing) -> list[Grasp]:
        sufficient = ROOM_M if narrowest_width(thing) > WIDE * self._opening.widest else math.inf
        return sorted(found, key=lambda one: (-min(one.clearance, sufficient), one.tilt))

    def _checker(self, things: Sequence[Thing], width: float) -> CollisionChecker:
        opening = self._opening.position(_open_width(width, self._opening))
        return CollisionChecker(self.arm, things, margin=MARGIN_M, gripper=opening)

    def _grasp(
        self, checker: CollisionChecker, tool: Frame, start: Floats | None
    ) -> tuple[Floats, Floats] | OutOfReach:
        """Return the postures before the thing and at it."""
        goal = ToolGoal(position=tool.position, axes=tool.axes, orientation_tolerance=TOLERANCE_RAD)
        at = self._inverse.solve(goal, start, checker.touches, TRIES)
        if isinstance(at, OutOfReach):
            return at
        before = self._approach_start(checker, tool, at.posture)
        return before if isinstance(before, OutOfReach) else (before, at.posture)

    def _approach_start(
        self, checker: CollisionChecker, tool: Frame, posture: Floats
    ) -> Floats | OutOfReach:
        """Return a posture from which the tool can move straight to the thing."""
        fault: OutOfReach | None = None
        for retreat in RETREATS_M:
            goal = ToolGoal(
                position=tool.position - retreat * tool.axes[:, 0],
                axes=tool.axes,
                orientation_tolerance=DRIFT_RAD,
            )
            before = self._inverse.solve(goal, posture, checker.touches, TRIES)
            if isinstance(before, Reachable):
                if checker.is_line_free(before.posture, posture):
                    return before.posture
                before = OutOfReach(
                    cause="collision", reason="the way to it is not free", posture=before.posture,
                    position_error=before.position_error,
                    orientation_error=before.orientation_error,
                )  # fmt: skip
            fault = before
        assert fault is not None  # RETREATS_M is not empty
        return fault


def candidates(thing: Thing, opening: Opening) -> Iterator[tuple[Frame, float, float]]:
    """Yield poses of the tool for a thing, with the thing's width [m] and the tilt [rad]."""
    for tilt in TILTS_RAD:
        for across, width in _closing_axes(thing):
            level = np.cross(UP, across)
            if width + 2 * GAP_M > opening.widest or np.linalg.norm(level) < MIN_LEVEL:
                continue  # too wide, or the fingers would close from above
            level /= np.linalg.norm(level)
            middle = opening.middle(opening.position(_open_width(width, opening)))
            for side in (1.0, -1.0) if tilt else (1.0,):
                approach = side * math.sin(tilt) * level
                approach = approach - math.cos(tilt) * np.cross(across, level)
                axes = np.stack((approach, np.cross(across, approach), across), axis=1)
                tall = float(np.abs(thing.axes.T @ approach) @ thing.half)
                for height in HEIGHTS:
                    place = thing.position - middle * across - height * tall * approach
                    yield Frame(position=place, axes=axes), width, tilt


def _open_width(width: float, opening: Opening) -> float:
    """Return the distance between the pads before they close on a thing [m]."""
    return max(width + 2 * GAP_M, min(width + 2 * WIDE_GAP_M, opening.widest))


def _closing_axes(thing: Thing) -> Iterator[tuple[Floats, float]]:
    """Yield directions (3,) along which fingers may close, with the thing's width [m]."""
    if thing.kind == "box":
        for number, half in enumerate(thing.half):
            for sign in (1.0, -1.0):
                yield sign * thing.axes[:, number], float(2 * half)
        return
    width = 2 * thing.size[0]
    upright = np.eye(3) if thing.kind == "sphere" else thing.axes
    ahead = math.atan2(thing.position[1], thing.position[0])  # the first is across this direction
    first = np.array([-math.sin(ahead), math.cos(ahead), 0.0])
    axis = upright[:, 2]
    first = first - axis * (axis @ first)
    if np.linalg.norm(first) < 1e-3:
        first = upright[:, 0]
    first /= np.linalg.norm(first)
    for number in range(YAWS):
        angle = 2 * math.pi * number / YAWS
        yield math.cos(angle) * first + math.sin(angle) * np.cross(axis, first), width


def narrowest_width(thing: Thing) -> float:
    """Return the smallest width of a thing along which fingers may close [m]."""
    return float(2 * (thing.half.min() if thing.kind == "box" else thing.size[0]))
