"""Plans the actions of an arm: reach, take a posture, move its gripper, pick, place, press."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.manipulation.collision import CollisionChecker, Thing, turned
from gigabrain_zenoh.manipulation.grasps import Grasp
from gigabrain_zenoh.manipulation.inverse_kinematics import (
    InverseKinematics,
    OutOfReach,
    ToolGoal,
)
from gigabrain_zenoh.manipulation.joint_trajectory import FAST, TimeParametrization, eased
from gigabrain_zenoh.manipulation.phases import Phase
from gigabrain_zenoh.manipulation.pick_place import (
    LIMIT_SPARE,
    NoWay,
    PickPlacePlanner,
    may_touch,
)
from gigabrain_zenoh.manipulation.planner import NoPath, plan
from gigabrain_zenoh.manipulation.press import PressPlanner

TABLE, ABOVE_TABLE = "the table", "just above the table"
SPARE_M = 0.004  # distance from boxes, beyond the clearance at which safety stops an arm
SUNK_M = 0.001  # the floor is modelled lower, so that things on it do not touch it
STAND_OFFS = (0.57, 0.62, 0.7, 0.5, 0.78)  # good distances for a grasp, as shares of the reach
MAX_EXCESS_M = 0.065  # over the stand-off: beyond it, the body drives nearer (within 5 cm)
MIN_GAP_M = 0.08  # between the body and a thing to pick up
MARGIN_M = 0.002  # of an arm that holds nothing, from everything around
ORIENTATION_RAD = math.radians(2)  # largest error of the approach, to reach a point
# ahead and up, as shares of the reach
OFFERS = ((0.7, 0.5), (0.6, 0.55), (0.6, 0.4), (0.5, 0.5), (0.5, 0.3))
OFFER_PITCHES = (0.0, math.radians(30), None)
PRESS_PITCHES = tuple(math.radians(angle) for angle in (90, 70, 50, 30, 0))
# lag of a gripper behind its goal, as shares of its range
HELD = 0.01  # with a larger lag, something is between the fingers
MOVING = (0.0315, 0.035, 0.049)  # least, set and largest, while the arm moves
STILL = (0.018, 0.02, 0.0224)  # the same at rest, where servos stay below 60 °C for hours


@dataclass(frozen=True, kw_only=True, eq=False)
class Hold:
    """A thing in the gripper."""

    thing: Thing  # in the frame of the tool
    grip: float  # [rad] or [m], goal of the gripper's joint
    opening: float  # [rad] or [m], its goal to let go


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """Phases of an action; for a pick, also the thing in the closed gripper."""

    phases: tuple[Phase, ...]
    hold: Hold | None = None
    grasp: Grasp | None = None
    grasps: tuple[Grasp, ...] = ()  # all possible ones, the chosen one first
    before: Floats | None = None  # (n,) of a press: the posture for the return


class ArmPlanner:
    """Plans for one arm. Not for two threads at once."""

    def __init__(self, mjcf: str, body: BodyDescription) -> None:
        """Read the arm's model. Raises ConfigError for one that does not fit the body."""
        if body.arm is None:
            raise ConfigError(f"{body.robot_type} has no arm")
        self.arm = ArmKinematics(mjcf, body.joints, body.arm.tool)
        self._inverse = InverseKinematics(self.arm, LIMIT_SPARE)
        self._times = TimeParametrization(eased(self.arm.joints, FAST))
        self._around = surroundings(body)
        higher = np.array([0.0, 0.0, SUNK_M + body.thresholds.arm_clearance])
        self._above_floor = [
            replace(one, name=ABOVE_TABLE, position=one.position + higher)
            for one in self._around
            if one.kind == "floor"
        ]
        self._pick_place: PickPlacePlanner | None = None
        self._press_planner: PressPlanner | None = None
        self._front = max(x for x, _ in body.footprint)  # [m]
        base = self.arm.chain.fixed[0, :2, 3]
        self._reach = float(np.linalg.norm(base) + self.arm.levers(0.0)[0])  # [m]

    def reach(
        self,
        point: Floats,
        pitch: float | None,
        things: Sequence[Thing],
        posture: Floats,
        hold: Hold | None,
        gripper_at: float | None = None,
    ) -> Plan | NoWay:
        """Plan to bring the tool to a point.

        Args:
            point: Goal of the tool (3,) [m], in the frame of the arm's base.
            pitch: Angle of the tool below level [rad]; None for any direction.
            things: Things around.
            posture: Present posture (n,).
            hold: The held thing.
            gripper_at: Position of an empty gripper [rad] or [m]; otherwise as in the model.
        """
        goal = self.tool_goal(point, pitch)
        if self._above_floor and hold is None:  # prefer a way on which safety does not slow it
            higher = self._checker([*things, *self._above_floor], None, gripper_at)
            way = self._move_tool(higher, goal, posture)
            if isinstance(way, Plan):
                return way
        return self._move_tool(self._checker(things, hold, gripper_at), goal, posture)

    def _move_tool(
        self, checker: CollisionChecker, goal: ToolGoal, posture: Floats
    ) -> Plan | NoWay:
        found = self._inverse.solve(goal, posture, checker.touches)
        if isinstance(found, OutOfReach):
            return NoWay(reason=self._explain(found))
        return self._move(checker, posture, found.posture)

    def tool_goal(self, point: Floats, pitch: float | None) -> ToolGoal:
        """Return a goal at a point (3,) [m]; `pitch` as in `reach`."""
        return ToolGoal(
            position=point,
            approach=None if pitch is None else self._approach(point, pitch),
            orientation_tolerance=ORIENTATION_RAD,
        )

    def take_posture(
        self,
        positions: Mapping[str, float],
        things: Sequence[Thing],
        posture: Floats,
        hold: Hold | None,
        gripper_at: float | None = None,
    ) -> Plan | NoWay:
        """Plan to move joints to `positions` [rad] or [m], and the gripper at the end.

        Until then, an empty gripper is at `gripper_at` [rad] or [m]; None: as in the model.
        """
        wanted = zip(self.arm.names, posture, strict=True)
        goal = np.array([positions.get(name, here) for name, here in wanted])
        moved = self._move(self._checker(things, hold, gripper_at), posture, goal)
        gripper = self.arm.gripper
        if isinstance(moved, NoWay) or gripper is None or gripper.name not in positions or hold:
            return moved
        return Plan(phases=(*moved.phases, Phase(name="grip", gripper=positions[gripper.name])))

    def grip(self, to: float | Literal["open", "close"]) -> Plan:
        """Plan a move of the gripper [rad] or [m]. Raises ConfigError for an arm without one."""
        gripper = self.arm.gripper
        if gripper is None:
            raise ConfigError("this arm has no gripper")
        if isinstance(to, str):
            opening = self.arm.opening()
            to = opening.position(opening.widest if to == "open" else 0.0)
        return Plan(phases=(Phase(name="grip", gripper=to),))

    def pick(
        self,
        thing: Thing,
        things: Sequence[Thing],
        posture: Floats,
        without: int,
        *,
        drives: bool = False,
    ) -> Plan | NoWay:
        """Plan to pick a thing up; `without` as in `PickPlacePlanner.pick`.

        For a body that `drives`, a refusal has the distance at which picking succeeds.
        """
        far = math.hypot(*thing.position[:2])
        may_drive = drives and (not without or far > self._reach)
        stand_off = self._stand_off(thing, posture) if may_drive else None
        if stand_off is not None and far > stand_off + MAX_EXCESS_M:
            return NoWay(reason=f"{thing.name}: too far", stand_off=stand_off)
        found = self._picker().pick(thing, self._with_surroundings(things), posture, without)
        if isinstance(found, NoWay):
            return replace(found, stand_off=stand_off)
        grip = next(phase.gripper for phase in found.phases if phase.name == "close")
        assert grip is not None
        hold = Hold(thing=found.held, grip=grip, opening=found.grasp.opening)
        others = (one for one in found.grasps if one is not found.grasp)
        return Plan(
            phases=found.phases, hold=hold, grasp=found.grasp, grasps=(found.grasp, *others)
        )

    def place(
        self, hold: Hold, target: Floats, things: Sequence[Thing], posture: Floats
    ) -> Plan | NoWay:
        """Plan to put down the held thing, with its middle at `target` (3,) [m]."""
        around = self._with_surroundings(things)
        found = self._picker().place(hold.thing, target, around, posture, hold.opening)
        return found if isinstance(found, NoWay) else Plan(phases=found.phases)

    def press(
        self,
        target: Floats | Thing,
        pitch: float | None,
        depth: float,
        things: Sequence[Thing],
        posture: Floats,
    ) -> Plan | NoWay:
        """Plan to press a place (3,) [m], or the near side of a thing.

        Args:
            target: The place, or the thing.
            pitch: Angle of the tool below level [rad]; None for any direction.
            depth: Largest motion beyond the place [m].
            things: Other things around.
            posture: Present posture (n,).
        """
        pitches = PRESS_PITCHES if pitch is None else (pitch,)
        middle = target.position if isinstance(target, Thing) else target
        ways = [self._approach(middle, one) for one in pitches]
        found = self._presser().press(target, ways, depth, self._with_surroundings(things), posture)
        if isinstance(found, NoWay):
            return found
        return Plan(phases=found.phases, before=found.before)

    def after_press(self, pressed: Plan, posture: Floats, seconds: float) -> Plan:
        """Plan to keep the posture of a press for some `seconds`, and then to go back."""
        assert pressed.before is not None
        phases = self._presser().back(posture, pressed.before, seconds)
        return replace(pressed, phases=phases)

    def offer(
        self,
        at: Floats | None,
        pitch: float | None,
        things: Sequence[Thing],
        posture: Floats,
        hold: Hold,
    ) -> Plan | NoWay:
        """Plan to bring the held thing to a point (3,) [m]; None for a point ahead and high."""
        if at is not None:
            return self.reach(at, pitch, things, posture, hold)
        pitches = OFFER_PITCHES if pitch is None else (pitch,)
        fault = NoWay(reason="there is no free place in front of the arm to hand it over")
        for ahead, up in OFFERS:
            point = self._reach * np.array([ahead, 0.0, up])
            for one in pitches:
                found = self.reach(point, one, things, posture, hold)
                if isinstance(found, Plan):
                    return found
        return fault

    def back_off(self, left: Plan, posture: Floats) -> Plan:
        """Plan the retreat from a thing that is not held, or from a press."""
        if left.grasp is None:
            return self.after_press(left, posture, 0.0)
        return Plan(phases=self._picker().back_off(left.grasp, posture), grasp=left.grasp)

    def squeeze(self, measured: float, wanted: float, *, moving: bool) -> float:
        """Return the gripper's goal [rad] or [m] for the right force on the held thing.

        The goal stays if the gripper's largest effort is unknown.

        Args:
            measured: Position of its joint [rad] or [m].
            wanted: Newest goal of its joint [rad] or [m].
            moving: Whether the arm moves at the same time.
        """
        gripper = self.arm.gripper
        assert gripper
        span, lag = gripper.upper - gripper.lower, wanted - measured
        least, aim, largest = (share * span for share in (MOVING if moving else STILL))
        if not gripper.max_effort or least <= abs(lag) <= largest:
            return wanted
        return max(gripper.lower, min(gripper.upper, measured + math.copysign(aim, lag)))

    def gripped(self, hold: Hold, thing: Thing, measured: Floats) -> Hold:
        """Return the hold after the fingers have closed on a thing.

        Along the closing axis the thing is between the fingers; along the others it has not moved.

        Args:
            hold: The planned hold.
            thing: The thing before it was grasped, in the frame of the base.
            measured: Measured posture (n,).
        """
        tool = self.arm.forward(measured)
        place = tool.axes.T @ (thing.position - tool.position)
        place[2] = hold.thing.position[2]
        return replace(
            hold, thing=replace(hold.thing, position=place, axes=tool.axes.T @ thing.axes)
        )

    def holds(self, measured: float, wanted: float) -> bool:
        """Return whether an object stopped the gripper before its goal, both [rad] or [m]."""
        gripper = self.arm.gripper
        assert gripper
        return abs(measured - wanted) > HELD * (gripper.upper - gripper.lower)

    def _stand_off(self, thing: Thing, posture: Floats) -> float | None:
        """Return a good distance for a grasp ahead of the base [m]; None if there is none."""
        least = self._front + float(thing.half[:2].max()) + MIN_GAP_M
        for far in (share * self._reach for share in STAND_OFFS):
            place = np.array([far, 0.0, thing.position[2]])
            moved = replace(thing, position=place, axes=turned(0.0))
            if far >= least and self._picker().can_grasp(moved, self._around, posture):
                return far
        return None

    def _picker(self) -> PickPlacePlanner:
        """Return the planner of picks. Raises ConfigError for an arm that cannot hold things."""
        if self._pick_place is None:
            self._pick_place = PickPlacePlanner(self.arm, self._inverse)
        return self._pick_place

    def _presser(self) -> PressPlanner:
        """Return the planner of presses. Raises ConfigError for an arm without gripper or pads."""
        if self._press_planner is None:
            self._press_planner = PressPlanner(self.arm, self._inverse)
        return self._press_planner

    def _with_surroundings(self, things: Sequence[Thing]) -> list[Thing]:
        return [*self._around, *things]

    def _checker(
        self, things: Sequence[Thing], hold: Hold | None, gripper_at: float | None
    ) -> CollisionChecker:
        around = self._with_surroundings(things)
        if hold is None:
            return CollisionChecker(self.arm, around, margin=MARGIN_M, gripper=gripper_at)
        return CollisionChecker(
            self.arm, around, held=hold.thing, margin=0.001,
            ignore=may_touch(hold.thing, around), gripper=hold.grip,
        )  # fmt: skip

    def _move(self, checker: CollisionChecker, start: Floats, goal: Floats) -> Plan | NoWay:
        way = plan(checker, start, goal)
        if isinstance(way, NoPath):
            return NoWay(reason=way.reason)
        trajectory = self._times.trajectory(way.postures, checker=checker)
        return Plan(phases=(Phase(name="move", arm=trajectory),))

    def _approach(self, point: Floats, pitch: float) -> Floats:
        """Return the tool's direction (3,) towards a point, away from the first joint's axis."""
        away = point[:2] - self.arm.chain.fixed[0, :2, 3]
        azimuth = math.atan2(away[1], away[0])
        level = math.cos(pitch)
        return np.array([level * math.cos(azimuth), level * math.sin(azimuth), -math.sin(pitch)])

    def _explain(self, found: OutOfReach) -> str:
        if found.posture is None:
            return found.reason
        text = f"not reachable: {found.reason}"
        if found.cause in ("collision", "orientation"):  # the position itself is reachable
            return text
        x, y, z = self.arm.forward(found.posture).position
        return f"{text}; the nearest is ({x:.3f}, {y:.3f}, {z:.3f})"


def surroundings(body: BodyDescription) -> list[Thing]:
    """Return the floor, and the keep-out boxes, grown by the clearance that safety keeps."""
    assert body.arm
    found = []
    if body.arm.floor is not None:
        place = np.array([0.0, 0.0, body.arm.floor - SUNK_M])
        found.append(Thing(name=TABLE, kind="floor", position=place))
    growth = 2 * (body.thresholds.arm_clearance + SPARE_M)
    for box in body.arm.keep_out:
        length, width, height = (side + growth for side in box.size)
        found.append(Thing(
            name=box.name, kind="box", size=(length, width, height),
            position=np.array(box.center), axes=turned(box.yaw),
        ))  # fmt: skip
    return found
