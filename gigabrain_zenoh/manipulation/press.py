"""Plans how a tool presses something: move before it, straight on until contact, and back.

    grip  hover  press      then  hold  retreat

The executor of a plan ends `press` when the push on the tool is strong enough.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.manipulation.collision import CollisionChecker, Thing
from gigabrain_zenoh.manipulation.inverse_kinematics import (
    InverseKinematics,
    OutOfReach,
    ToolGoal,
)
from gigabrain_zenoh.manipulation.joint_trajectory import (
    FAST,
    JointTrajectory,
    TimeParametrization,
    eased,
)
from gigabrain_zenoh.manipulation.phases import Phase
from gigabrain_zenoh.manipulation.pick_place import CREEP, NoWay
from gigabrain_zenoh.manipulation.planner import NoPath, plan

RUN_IN_M = 0.04  # before the place, to measure efforts and lag without a contact
STEP_M = 0.01  # between postures
MAX_SPEED_M_S = 0.03  # of the tool, if a single joint moves it
MARGIN_M = 0.002
FLOOR_M = 0.008  # clearance from a floor, near which safety slows joints down
TILT_RAD = math.radians(10)  # largest error of the approach
MAX_JUMP = 0.3  # [rad] or [m] per step; a larger one is a jump to another solution


@dataclass(frozen=True, kw_only=True, eq=False)
class PressWay:
    """A plan to press something, and the posture to return to."""

    phases: tuple[Phase, ...]
    before: Floats  # (n,) posture for the return


class PressPlanner:
    """Plans for one arm with a gripper. Not for two threads at once."""

    def __init__(self, arm: ArmKinematics, inverse: InverseKinematics) -> None:
        """Take an arm. Raises ConfigError for one without gripper or pads."""
        self.arm, self._inverse = arm, inverse
        self._closed = arm.opening().position(0.0)
        fastest = max(arm.levers(0.0) * [joint.max_speed for joint in arm.joints])
        self._fast = TimeParametrization(eased(arm.joints, FAST))
        self._slow = TimeParametrization(eased(arm.joints, min(CREEP, MAX_SPEED_M_S / fastest)))
        self._creep = TimeParametrization(eased(arm.joints, CREEP))

    def press(
        self,
        target: Floats | Thing,
        approaches: Sequence[Floats],
        depth: float,
        others: Sequence[Thing],
        posture: Floats,
    ) -> PressWay | NoWay:
        """Plan a press, or return why it is impossible.

        Args:
            target: A place (3,) [m], or a thing whose near side is pressed.
            approaches: Directions (3,) of the tool's motion, the best first.
            depth: Largest motion beyond the place [m].
            others: Other things around.
            posture: Present posture (n,).
        """
        thing = target if isinstance(target, Thing) else None
        solids = [*([thing] if thing else []), *others]
        around = CollisionChecker(self.arm, solids, margin=MARGIN_M, gripper=self._closed)
        touched = [(thing.name, body) for body in self.arm.hand] if thing else []
        along = CollisionChecker(
            self.arm, [_with_margin(one) for one in solids], margin=MARGIN_M, gripper=self._closed,
            ignore=touched,
        )  # fmt: skip
        fault = NoWay(reason="not reachable")
        for number, approach in enumerate(approaches):
            point = target if not isinstance(target, Thing) else near_side(target, approach)
            line = self._press_line(along, point, approach, depth, posture)
            if isinstance(line, NoWay):
                fault = fault if number else line  # the fault of the best approach
                continue
            way = plan(around, posture, line[0])
            if isinstance(way, NoPath):
                fault = NoWay(reason=way.reason)
                continue
            hover = self._fast.trajectory(way.postures, checker=around)
            return PressWay(
                phases=(
                    Phase(name="grip", gripper=self._closed),
                    Phase(name="hover", arm=hover),
                    Phase(name="press", arm=self._slow.trajectory(line)),
                ),
                before=line[0],
            )
        return fault

    def back(self, posture: Floats, before: Floats, seconds: float = 0.0) -> tuple[Phase, ...]:
        """Plan to keep the posture of a press for some `seconds`, and then to go back."""
        away = self._creep.trajectory(np.stack((posture, before)))
        retreat = Phase(name="retreat", arm=away)
        return (Phase(name="hold", arm=self._stay(posture, seconds)), retreat)

    def _press_line(
        self,
        checker: CollisionChecker,
        point: Floats,
        approach: Floats,
        depth: float,
        posture: Floats,
    ) -> Floats | NoWay:
        """Return postures (k, n) along the approach, at least up to the place."""
        ends = np.arange(-RUN_IN_M, STEP_M / 2, STEP_M), np.arange(STEP_M, depth, STEP_M), [depth]
        found: list[Floats] = []
        for far in np.concatenate(ends):
            goal = ToolGoal(
                position=point + far * approach, approach=approach, orientation_tolerance=TILT_RAD
            )
            tries = {} if not found else {"tries": 0}  # continue from the previous posture only
            one = self._inverse.solve(
                goal, found[-1] if found else posture, checker.touches, **tries
            )
            if isinstance(one, OutOfReach):
                fault = one.reason
            elif found and np.abs(one.posture - found[-1]).max() > MAX_JUMP:
                fault = "the way to it is not straight"
            else:
                found.append(one.posture)
                continue
            if far <= STEP_M / 2:
                return NoWay(reason=fault)
            break
        return np.array(found)

    def _stay(self, posture: Floats, seconds: float) -> JointTrajectory:
        rest = np.zeros((2, len(posture)))
        return JointTrajectory(
            names=self.arm.names, times=np.array([0.0, seconds]),
            positions=np.stack((posture, posture)), velocities=rest, accelerations=rest,
        )  # fmt: skip


def near_side(thing: Thing, approach: Floats) -> Floats:
    """Return the point (3,) [m] where a ray along `approach` (3,) to a thing's middle enters it."""
    along = np.abs(thing.axes.T @ approach)
    if thing.kind == "sphere":
        way = thing.size[0]
    else:
        if thing.kind == "cylinder":
            along = np.array([math.hypot(*along[:2]), 0.0, along[2]])
        way = float((thing.half / np.maximum(along, 1e-9)).min())
    return np.asarray(thing.position - way * approach)


def _with_margin(thing: Thing) -> Thing:
    if thing.kind != "floor":
        return thing
    return replace(thing, position=thing.position + np.array([0.0, 0.0, FLOOR_M]))
