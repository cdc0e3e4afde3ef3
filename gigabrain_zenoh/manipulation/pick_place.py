"""Plans to pick a thing up and to put it down, as phases: trajectories and grips.

    open  hover  descend  close  lift     of a pick
    traverse  lower  open  retreat        of a place

The executor of a plan checks the grip after `close`: the gripper must stop before its goal.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics, Frame
from gigabrain_zenoh.manipulation.collision import CollisionChecker, Thing, turned
from gigabrain_zenoh.manipulation.grasps import Grasp, GraspPlanner, NoGrasp
from gigabrain_zenoh.manipulation.inverse_kinematics import (
    InverseKinematics,
    OutOfReach,
    Reachable,
    ToolGoal,
)
from gigabrain_zenoh.manipulation.joint_trajectory import (
    FAST,
    JointTrajectory,
    TimeParametrization,
    eased,
)
from gigabrain_zenoh.manipulation.phases import Phase
from gigabrain_zenoh.manipulation.planner import NoPath, plan

LIMIT_SPARE = 0.006  # share of a joint's range, kept free at each end: servos overshoot
SLOW = 0.35  # share of the joints' top speeds, with a thing in the gripper
CREEP = 0.1  # the same on straight lines near a thing: safety slows joints down near the table
GENTLE = 0.25  # share of their accelerations on the way to a place: servos overshoot a stop
SQUEEZE = 0.12  # share of the gripper's range by which its goal is beyond the thing's width
LIFT_M = 0.05  # height of the straight lift
PLACE_GAP_M = 0.003  # height above the surface, at which a thing is let go
PLACE_YAWS = 16  # yaw angles in which a thing may be put down
PLACE_TILT_RAD = math.radians(8)  # largest tilt of a thing that is let go
TRIES = 3  # grasps for which a path is planned


@dataclass(frozen=True, kw_only=True, eq=False)
class Pick:
    """A plan to pick up a thing."""

    grasp: Grasp
    phases: tuple[Phase, ...]
    held: Thing  # in the frame of the tool
    grasps: tuple[Grasp, ...] = ()  # all possible ones, the best first


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """A plan to put down the held thing."""

    phases: tuple[Phase, ...]


@dataclass(frozen=True, kw_only=True)
class NoWay:
    """The reason why something cannot be picked up or put down."""

    reason: str  # for people
    stand_off: float | None = None  # [m], distance ahead of its base at which picking succeeds


class PickPlacePlanner:
    """Plans picks and places of one arm. Not for two threads at once."""

    def __init__(self, arm: ArmKinematics, inverse: InverseKinematics | None = None) -> None:
        """Take an arm. Raises ConfigError for one without a gripper that can hold things."""
        self.arm = arm
        self._inverse = inverse or InverseKinematics(arm, LIMIT_SPARE)
        self._grasps = GraspPlanner(arm, self._inverse)
        self._fast = TimeParametrization(eased(arm.joints, FAST))
        self._slow = TimeParametrization(eased(arm.joints, SLOW))
        self._gentle = TimeParametrization(eased(arm.joints, SLOW, GENTLE))
        self._creep = TimeParametrization(eased(arm.joints, CREEP))
        self._opening = arm.opening()
        assert arm.gripper
        self._gripper = arm.gripper

    def pick(
        self, thing: Thing, others: Sequence[Thing], posture: Floats, without: int = 0
    ) -> Pick | NoWay:
        """Plan to pick a thing up, or return why that is impossible.

        Args:
            thing: A box, cylinder or sphere, in the frame of the arm's base.
            others: What is around it: the table, other things.
            posture: Present posture (n,).
            without: Number of the best grasps to skip, as they have failed.
        """
        found = self._grasps.grasps(thing, others, posture)
        if isinstance(found, NoGrasp):
            return NoWay(reason=found.reason)
        if without >= len(found):
            return NoWay(reason=f"{thing.name}: all {len(found)} grasps have failed")
        fault = NoWay(reason=f"{thing.name}: no path to it")
        for grasp in found[without : without + TRIES]:
            one = self._pick(grasp, thing, others, posture)
            if isinstance(one, Pick):
                return replace(one, grasps=tuple(found))
            fault = one
        return fault

    def can_grasp(self, thing: Thing, others: Sequence[Thing], posture: Floats) -> bool:
        """Return whether a thing can be grasped."""
        return not isinstance(self._grasps.grasps(thing, others, posture, enough=1), NoGrasp)

    def back_off(self, grasp: Grasp, posture: Floats) -> tuple[Phase, ...]:
        """Plan the retreat from a thing that is not held: open, and go back along the approach."""
        return (
            Phase(name="open", gripper=grasp.opening),
            Phase(name="retreat", arm=self._straight(posture, grasp.before)),
        )

    def place(
        self, held: Thing, target: Floats, others: Sequence[Thing], posture: Floats, opening: float
    ) -> Place | NoWay:
        """Plan to put the held thing down, or return why that is impossible.

        Args:
            held: The held thing, in the frame of the tool.
            target: Position of its middle (3,) [m], upright as it was picked up.
            others: What is around.
            posture: Present posture (n,).
            opening: Position of the gripper's joint to let go [rad] or [m].
        """
        checker = CollisionChecker(
            self.arm, others, held=held, margin=0.001, ignore=may_touch(held, others)
        )
        faults = []
        for tool in self._place_poses(held, target, posture):
            one = self._place(checker, tool, held, others, posture, opening)
            if isinstance(one, Place):
                return one
            faults.append(one)
        return faults[0]  # of the smallest turn

    def _pick(
        self, grasp: Grasp, thing: Thing, others: Sequence[Thing], posture: Floats
    ) -> Pick | NoWay:
        around = CollisionChecker(self.arm, [thing, *others], gripper=grasp.opening, margin=0.002)
        way = plan(around, posture, grasp.before)
        if isinstance(way, NoPath):
            return NoWay(reason=f"{thing.name}: {way.reason}")
        held = self._held_thing(thing, grasp)
        lifting = CollisionChecker(
            self.arm, others, held=held, margin=0.001, ignore=may_touch(held, others)
        )
        up = self._lift_postures(lifting, grasp)
        phases = (
            Phase(name="open", gripper=grasp.opening),
            Phase(name="hover", arm=self._fast.trajectory(way.postures, checker=around)),
            Phase(name="descend", arm=self._straight(grasp.before, grasp.posture)),
            Phase(name="close", gripper=self._squeeze_position(grasp)),
            Phase(name="lift", arm=self._slow.trajectory(up)),
        )
        return Pick(grasp=grasp, phases=phases, held=held)

    def _lift_postures(self, checker: CollisionChecker, grasp: Grasp) -> Floats:
        """Return postures (k, n) from the grasp straight up, or else back along the approach."""
        here = self.arm.forward(grasp.posture)
        raised = here.position + np.array([0.0, 0.0, LIFT_M])
        goal = ToolGoal(position=raised, approach=here.axes[:, 0], orientation_tolerance=math.pi)
        up = self._inverse.solve(goal, grasp.posture, checker.touches)
        if isinstance(up, Reachable) and checker.is_line_free(grasp.posture, up.posture):
            return np.stack((grasp.posture, up.posture))
        return np.stack((grasp.posture, grasp.before))

    def _place(
        self,
        checker: CollisionChecker,
        tool: Frame,
        held: Thing,
        others: Sequence[Thing],
        posture: Floats,
        opening: float,
    ) -> Place | NoWay:
        goal = ToolGoal(
            position=tool.position, axes=tool.axes, orientation_tolerance=PLACE_TILT_RAD
        )
        down = self._inverse.solve(goal, posture, checker.touches)
        if isinstance(down, OutOfReach):
            return NoWay(reason=f"{held.name}: {down.reason}")
        raised = tool.position + np.array([0.0, 0.0, LIFT_M])
        above = self._inverse.solve(
            ToolGoal(position=raised, approach=tool.axes[:, 0], orientation_tolerance=math.pi),
            down.posture, checker.touches,
        )  # fmt: skip
        if isinstance(above, OutOfReach):
            return NoWay(reason=f"{held.name}: above it: {above.reason}")
        way = plan(checker, posture, above.posture)
        if isinstance(way, NoPath):
            return NoWay(reason=f"{held.name}: {way.reason}")
        return Place(
            phases=(
                Phase(name="traverse", arm=self._gentle.trajectory(way.postures, checker=checker)),
                Phase(name="lower", arm=self._straight(above.posture, down.posture)),
                Phase(name="open", gripper=opening),
                Phase(name="retreat", arm=self._retreat(tool, down, held, others, opening)),
            )
        )

    def _retreat(
        self, tool: Frame, down: Reachable, held: Thing, others: Sequence[Thing], opening: float
    ) -> JointTrajectory:
        """Return the way back along the approach from a released thing, as far as possible."""
        left = _in_base_frame(self.arm.forward(down.posture), held)
        beside = [(left.name, body) for body in self.arm.hand]  # a finger rests against it
        checker = CollisionChecker(
            self.arm, [left, *others], margin=0.0, ignore=beside, gripper=opening
        )
        for far in (0.06, 0.04, 0.02):
            back = tool.position - far * tool.axes[:, 0]
            goal = ToolGoal(position=back, axes=tool.axes, orientation_tolerance=math.pi)
            away = self._inverse.solve(goal, down.posture, checker.touches)
            if isinstance(away, Reachable) and checker.is_line_free(down.posture, away.posture):
                return self._straight(down.posture, away.posture)
        return self._straight(down.posture, down.posture)

    def _place_poses(self, held: Thing, target: Floats, posture: Floats) -> list[Frame]:
        """Return poses of the tool with the held thing at its target, the smallest turn first."""
        now = self.arm.forward(posture)
        thing = _in_base_frame(now, held)
        raised = target + np.array([0.0, 0.0, PLACE_GAP_M])
        found = []
        for number in range(PLACE_YAWS):
            angle = 2 * math.pi * number / PLACE_YAWS
            turn = turned(angle) @ _upright(thing.axes) @ thing.axes.T
            axes = turn @ now.axes
            found.append(Frame(position=raised - axes @ held.position, axes=axes))
        order = [float(np.trace(now.axes.T @ one.axes)) for one in found]
        return [found[k] for k in np.argsort(order)[::-1]]

    def _straight(self, start: Floats, goal: Floats) -> JointTrajectory:
        return self._creep.trajectory(np.stack((start, goal)))

    def _held_thing(self, thing: Thing, grasp: Grasp) -> Thing:
        """Return a thing in the frame of the tool, after the fingers have closed on it.

        A single moving finger pushes the thing to the other one.
        """
        tool = self.arm.forward(grasp.posture)
        place = tool.axes.T @ (thing.position - tool.position)
        place[2] = self._opening.middle(grasp.closed)
        return replace(thing, position=place, axes=tool.axes.T @ thing.axes)

    def _squeeze_position(self, grasp: Grasp) -> float:
        """Return the goal of the gripper's joint to hold a thing: beyond its width."""
        closing = math.copysign(1.0, grasp.closed - grasp.opening)
        span = self._gripper.upper - self._gripper.lower
        aim = grasp.closed + closing * SQUEEZE * span
        return max(self._gripper.lower, min(self._gripper.upper, aim))


def may_touch(held: Thing, others: Sequence[Thing]) -> list[tuple[str, str]]:
    """Return the pairs that may touch: the held thing, and a floor on which it stands."""
    return [("held", other.name) for other in others if other.kind == "floor"]


def _in_base_frame(tool: Frame, held: Thing) -> Thing:
    """Return a held thing in the frame of the base."""
    return replace(held, position=tool.place(held.position), axes=tool.axes @ held.axes)


def _upright(axes: Floats) -> Floats:
    """Return `axes` (3, 3), turned by the smallest angle so that the last one points up."""
    up = np.array([0.0, 0.0, 1.0])
    axis = np.cross(axes[:, 2], up)
    sin, cos = float(np.linalg.norm(axis)), float(axes[2, 2])
    if sin < 1e-9:  # upright already, or upside down
        return axes if cos > 0.0 else axes @ np.diag([1.0, -1.0, -1.0])
    x, y, z = axis / sin
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + sin * cross + (1 - cos) * cross @ cross
    return np.asarray(turn @ axes)
