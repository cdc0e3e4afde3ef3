"""Reads the inputs of the arm's planner from a robot's state."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription, JointDescription, RobotState
from gigabrain_zenoh.decision.tasks.arm_steps import NamedPosture
from gigabrain_zenoh.geometry.pose import relative
from gigabrain_zenoh.manipulation.arm_planner import ArmPlanner, Hold, Plan
from gigabrain_zenoh.manipulation.joint_trajectory import JointTrajectory
from gigabrain_zenoh.manipulation.phases import Phase

GRIPPER_MOVES = 0.1  # share of the gripper's maximum speed; the noise of its encoder is smaller
START_TOLERANCE = 0.02  # [rad] or [m], between the arm and the start of its plan
SENT_TOLERANCE = 0.01  # share of the gripper's range, between its command and its target
AT_THINGS = ("descend", "press", "lift", "retreat")  # phases in which the arm is at a thing
MAX_BASE_M, MAX_BASE_RAD = 0.03, 0.05  # motion of a base that counts as standing
MAX_REGRIP = 0.12  # share of the gripper's range, change of the grip on a held thing


@dataclass(frozen=True)
class ArmReading:
    """A state of a body with an arm, read for the arm's planner."""

    planner: ArmPlanner
    body: BodyDescription
    state: RobotState

    @property
    def sent_posture(self) -> Floats:
        """The commanded positions of the arm's joints (n,) [rad] or [m]."""
        sent = self._sent(strict=True)
        return np.array([sent[name] for name in self.planner.arm.names])

    @property
    def measured_posture(self) -> Floats:
        """The measured positions of the arm's joints (n,) [rad] or [m]."""
        positions = {joint.name: joint.position for joint in self.state.joints}
        return np.array([positions[name] for name in self.planner.arm.names])

    @property
    def measured_efforts(self) -> Floats | None:
        """The efforts of the arm's joints (n,) [N m] or [N]; None if one is not measured."""
        measured = {joint.name: joint.effort for joint in self.state.joints}
        efforts = [measured.get(name) for name in self.planner.arm.names]
        return None if None in efforts else np.array(efforts)

    def is_at_thing(self, left: Plan, base: Pose) -> bool:
        """Return whether the arm is at the thing of plan `left`, and the body still at `base`."""
        motion = relative(base, self.state.pose)
        if math.hypot(motion.x, motion.y) > MAX_BASE_M or abs(motion.yaw) > MAX_BASE_RAD:
            return False
        if len(self.state.joints_sent) != len(self.body.joints):
            return False
        max_lags = np.array([joint.gains.max_correction for joint in self.planner.arm.joints])
        tolerance = START_TOLERANCE + max_lags
        posture = self.sent_posture
        ways = [phase.arm for phase in left.phases if phase.arm and phase.name in AT_THINGS]
        return any((np.abs(way.positions - posture) < tolerance).all(axis=1).any() for way in ways)

    def holds(self, hold: Hold) -> bool:
        """Return whether a thing stops the gripper short of its grip."""
        return self.planner.holds(self.gripper_place(hold.grip), hold.grip)

    def still_held(self, hold: Hold) -> Hold | None:
        """Return `hold` with the newest command of the gripper; None if it lost the thing."""
        gripper = self._gripper
        sent = self.sent_place(hold.grip)
        grip = hold.grip if self.sent_to(hold.grip) else sent
        measured = self.gripper_place(sent)
        squeezes = (sent - measured) * (hold.grip - hold.opening) > 0.0
        near = abs(grip - hold.grip) <= MAX_REGRIP * (gripper.upper - gripper.lower)
        held = squeezes and near and self.planner.holds(measured, sent)
        return replace(hold, grip=grip) if held else None

    def squeezes(self, place: float) -> bool:
        """Return whether something stops the gripper short of its command, towards `place`."""
        sent = self.sent_place(place)
        measured = self.gripper_place(sent)
        return self.planner.holds(measured, sent) and (sent - measured) * (place - measured) > 0.0

    def gripper_moves(self, phase: Phase) -> bool:
        """Return whether the gripper moves, or was not sent to its target of `phase` yet."""
        gripper = self.planner.arm.gripper
        if gripper is None or phase.gripper is None:
            return False
        moves = any(
            joint.name == gripper.name and abs(joint.velocity) > GRIPPER_MOVES * gripper.max_speed
            for joint in self.state.joints
        )
        return moves or not self.sent_to(phase.gripper)

    def sent_to(self, place: float) -> bool:
        """Return whether the gripper was sent to `place` [rad] or [m]; also if that is unknown."""
        gripper = self._gripper
        tolerance = gripper.gains.max_correction + SENT_TOLERANCE * (gripper.upper - gripper.lower)
        return abs(self.sent_place(place) - place) <= tolerance

    def sent_place(self, unknown: float) -> float:
        """Return the commanded position of the gripper [rad] or [m], or `unknown`."""
        return self._sent(strict=False).get(self._gripper.name, unknown)

    def gripper_place(self, unknown: float) -> float:
        """Return the measured position of the gripper [rad] or [m], or `unknown`."""
        gripper = self.planner.arm.gripper
        name = gripper.name if gripper else ""
        return next((joint.position for joint in self.state.joints if joint.name == name), unknown)

    @property
    def _gripper(self) -> JointDescription:
        gripper = self.planner.arm.gripper
        assert gripper
        return gripper

    def _sent(self, *, strict: bool) -> dict[str, float]:
        names = (joint.name for joint in self.body.joints)
        return dict(zip(names, self.state.joints_sent, strict=strict))


def pace(
    body: BodyDescription, state: RobotState
) -> tuple[Mapping[str, float], Mapping[str, float]]:
    """Return the commanded position of each joint and its allowed lag, both [rad] or [m]."""
    names = [joint.name for joint in body.joints]
    sent = dict(zip(names, state.joints_sent, strict=False))
    measured = {joint.name: joint.position for joint in state.joints}
    return measured | sent, {joint.name: joint.gains.max_correction for joint in body.joints}


def posture_of(body: BodyDescription, name: NamedPosture) -> dict[str, float]:
    """Return a named posture of the robot's file [rad] or [m]."""
    assert body.arm
    positions = body.arm.home if name == "home" else body.arm.carry
    return dict(zip((joint.name for joint in body.joints), positions, strict=True))


def begins_at(plan: Plan, posture: Floats) -> bool:
    """Return whether a plan starts at the commanded `posture` (n,) [rad] or [m]."""
    first = next((phase.arm for phase in plan.phases if phase.arm), None)
    return first is None or bool(np.abs(first.positions[0] - posture).max() < START_TOLERANCE)


def rest_of_place(left: Plan, posture: Floats) -> Plan:
    """Return the rest of plan `left`, to let go and retreat, from the commanded `posture` (n,)."""
    *_, let_go, retreat = left.phases
    way = retreat.arm
    assert way
    start = int(np.abs(way.positions - posture).max(axis=1).argmin())
    rest = JointTrajectory(
        names=way.names, times=way.times[start:] - way.times[start],
        positions=way.positions[start:], velocities=way.velocities[start:],
        accelerations=way.accelerations[start:],
    )  # fmt: skip
    return Plan(phases=(let_go, Phase(name="retreat", arm=rest)))


def off_from(
    body: BodyDescription,
    state: RobotState,
    wanted: Mapping[str, float],
    which: Literal["path_tolerance", "goal_tolerance"],
) -> str:
    """Describe the first joint that is off from `wanted` by more than its tolerance, if any."""
    measured = {joint.name: joint.position for joint in state.joints}
    for joint in body.joints:
        if joint.name in wanted:
            tolerance: float = getattr(joint, which)
            error = abs(measured.get(joint.name, math.inf) - wanted[joint.name])
            if tolerance and error > tolerance:
                return f"{joint.name} is {error:.2f} off, more than its {which} of {tolerance:g}"
    return ""
