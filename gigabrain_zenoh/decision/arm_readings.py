"""Reads from a robot's state what the planner of an arm needs."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_zenoh.decision.tasks.arm_steps import NamedPosture
from gigabrain_zenoh.geometry.pose import relative
from gigabrain_zenoh.manipulation.arm_planner import ArmPlanner, Hold, Plan
from gigabrain_zenoh.manipulation.joint_trajectory import JointTrajectory
from gigabrain_zenoh.manipulation.phases import Phase

GRIPS = 0.1  # of the gripper's greatest speed, above which it moves: an encoder's steps are less
MOVED = 0.02  # [rad] or [m] off the beginning of a plan: it was made for another posture
SENT = 0.01  # of the gripper's range, within which it was sent to its target
AT_THINGS = ("descend", "press", "lift", "retreat")  # phases in which an arm moves at a thing
BASE_M, BASE_RAD = 0.03, 0.05  # by which a base moves at most that stands
REGRIP = 0.12  # of its range, by which a grip changes at most while something is held


def sent_posture(planner: ArmPlanner, body: BodyDescription, state: RobotState) -> Floats:
    """Return where the arm's joints were sent (n,) [rad] or [m]."""
    sent = dict(zip((joint.name for joint in body.joints), state.joints_sent, strict=True))
    return np.array([sent[name] for name in planner.arm.names])


def pace(
    body: BodyDescription, state: RobotState
) -> tuple[Mapping[str, float], Mapping[str, float]]:
    """Return where each joint was sent, and by how much that may be behind [rad] or [m]."""
    names = [joint.name for joint in body.joints]
    sent = dict(zip(names, state.joints_sent, strict=False))
    measured = {joint.name: joint.position for joint in state.joints}
    return measured | sent, {joint.name: joint.gains.max_correction for joint in body.joints}


def measured_posture(planner: ArmPlanner, state: RobotState) -> Floats:
    """Return where the arm's joints are (n,) [rad] or [m]."""
    found = {joint.name: joint.position for joint in state.joints}
    return np.array([found[name] for name in planner.arm.names])


def measured_efforts(planner: ArmPlanner, state: RobotState) -> Floats | None:
    """Return the efforts of the arm's joints (n,) [N m] or [N]; None where one is not measured."""
    found = {joint.name: joint.effort for joint in state.joints}
    efforts = [found.get(name) for name in planner.arm.names]
    return None if None in efforts else np.array(efforts)


def posture_of(body: BodyDescription, name: NamedPosture) -> dict[str, float]:
    """Return a posture of the robot's file [rad] or [m]."""
    assert body.arm
    places = body.arm.home if name == "home" else body.arm.carry
    return dict(zip((joint.name for joint in body.joints), places, strict=True))


def begins_at(plan: Plan, posture: Floats) -> bool:
    """Return whether a plan's first trajectory begins where the arm was sent (n,) [rad] or [m]."""
    first = next((phase.arm for phase in plan.phases if phase.arm), None)
    return first is None or bool(np.abs(first.positions[0] - posture).max() < MOVED)


def is_at(
    left: Plan, base: Pose, planner: ArmPlanner, body: BodyDescription, state: RobotState
) -> bool:
    """Return whether the arm is on a plan's last way to its thing, and the body still at `base`."""
    off = relative(base, state.pose)
    if math.hypot(off.x, off.y) > BASE_M or abs(off.yaw) > BASE_RAD:
        return False
    if len(state.joints_sent) != len(body.joints):
        return False
    slack = MOVED + np.array([joint.gains.max_correction for joint in planner.arm.joints])
    posture = sent_posture(planner, body, state)
    ways = [phase.arm for phase in left.phases if phase.arm and phase.name in AT_THINGS]
    return any((np.abs(way.positions - posture) < slack).all(axis=1).any() for way in ways)


def rest_of_place(left: Plan, posture: Floats) -> Plan:
    """Return how to let go and retreat as planned, for an arm that was sent to `posture` (n,)."""
    *_, let_go, retreat = left.phases
    way = retreat.arm
    assert way
    begun = int(np.abs(way.positions - posture).max(axis=1).argmin())
    rest = JointTrajectory(
        names=way.names, times=way.times[begun:] - way.times[begun],
        positions=way.positions[begun:], velocities=way.velocities[begun:],
        accelerations=way.accelerations[begun:],
    )  # fmt: skip
    return Plan(phases=(let_go, Phase(name="retreat", arm=rest)))


def holds(planner: ArmPlanner, hold: Hold, state: RobotState) -> bool:
    """Return whether the gripper has stopped short of where it was sent."""
    return planner.holds(gripper_place(planner, state, hold.grip), hold.grip)


def still_held(
    planner: ArmPlanner, body: BodyDescription, state: RobotState, hold: Hold
) -> Hold | None:
    """Return `hold` by where the gripper was sent meanwhile; None if it holds nothing any more."""
    gripper = planner.arm.gripper
    assert gripper
    sent = sent_place(planner, body, state, hold.grip)
    grip = hold.grip if sent_to(planner, body, state, hold.grip) else sent
    measured = gripper_place(planner, state, sent)
    squeezes = (sent - measured) * (hold.grip - hold.opening) > 0.0
    near = abs(grip - hold.grip) <= REGRIP * (gripper.upper - gripper.lower)
    held = squeezes and near and planner.holds(measured, sent)
    return replace(hold, grip=grip) if held else None


def squeezes(planner: ArmPlanner, body: BodyDescription, state: RobotState, place: float) -> bool:
    """Return whether something stops the gripper short of where it was sent, towards `place`."""
    sent = sent_place(planner, body, state, place)
    measured = gripper_place(planner, state, sent)
    return planner.holds(measured, sent) and (sent - measured) * (place - measured) > 0.0


def gripper_moves(
    planner: ArmPlanner, state: RobotState, body: BodyDescription, phase: Phase
) -> bool:
    """Return whether the gripper is still on its way: it moves, or was not sent there yet."""
    gripper = planner.arm.gripper
    if gripper is None or phase.gripper is None:
        return False
    moves = any(
        joint.name == gripper.name and abs(joint.velocity) > GRIPS * gripper.max_speed
        for joint in state.joints
    )
    return moves or not sent_to(planner, body, state, phase.gripper)


def sent_to(planner: ArmPlanner, body: BodyDescription, state: RobotState, place: float) -> bool:
    """Return whether the gripper was sent to a place [rad] or [m], or where that is not known."""
    gripper = planner.arm.gripper
    assert gripper
    slack = gripper.gains.max_correction + SENT * (gripper.upper - gripper.lower)
    return abs(sent_place(planner, body, state, place) - place) <= slack


def sent_place(
    planner: ArmPlanner, body: BodyDescription, state: RobotState, unknown: float
) -> float:
    """Return where the gripper was sent [rad] or [m]."""
    assert planner.arm.gripper
    sent = dict(zip((joint.name for joint in body.joints), state.joints_sent, strict=False))
    return sent.get(planner.arm.gripper.name, unknown)


def gripper_place(planner: ArmPlanner, state: RobotState, unknown: float) -> float:
    """Return where the gripper is [rad] or [m]."""
    gripper = planner.arm.gripper
    name = gripper.name if gripper else ""
    return next((joint.position for joint in state.joints if joint.name == name), unknown)


def off_from(
    body: BodyDescription,
    state: RobotState,
    wanted: Mapping[str, float],
    which: Literal["path_tolerance", "goal_tolerance"],
) -> str:
    """Return which joint is too far from where it should be, and how far; empty for none."""
    measured = {joint.name: joint.position for joint in state.joints}
    for joint in body.joints:
        if joint.name in wanted:
            tolerance: float = getattr(joint, which)
            error = abs(measured.get(joint.name, math.inf) - wanted[joint.name])
            if tolerance and error > tolerance:
                return f"{joint.name} is {error:.2f} off, more than its {which} of {tolerance:g}"
    return ""
