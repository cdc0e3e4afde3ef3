"""Control's step for joints, with a gate and servos that follow late and sag."""

from collections.abc import Sequence
from itertools import zip_longest

import numpy as np

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import (
    Arm,
    BodyDescription,
    GateStatus,
    Joint,
    JointDescription,
    JointGains,
    RobotState,
)
from gigabrain_schemas.brain import Intent, JointCommand, JointSpeeds, JointTarget, JointTrajectory
from gigabrain_zenoh.control.joints import JointInputs, JointMemory, step_joints
from gigabrain_zenoh.geometry.joints import ANY_SPEED, JointMotion, approach, braked
from gigabrain_zenoh.testing.samples import DRIVING

PAN, LIFT = (
    JointDescription(
        name=name,
        lower=-1.5,
        upper=1.5,
        max_speed=2.0,
        max_acceleration=20.0,
        gains=JointGains(i=4),
    )
    for name in ("pan", "lift")
)


def arm_body(*joints: JointDescription, goal_time: float = 1.0) -> BodyDescription:
    joints = joints or (PAN, LIFT)
    return BodyDescription(
        robot_type="crane",
        drive_type="arm",
        footprint=((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1)),
        joints=joints,
        arm=Arm(home=(0.0,) * len(joints), goal_time=goal_time),
    )


def targets(**places: float) -> Intent:
    joints = tuple(JointTarget(name=name, position=place) for name, place in places.items())
    return Intent(joints=joints, behaviour="reach", reason="because", basis=1)


def path(
    rows: Sequence[Sequence[float]], start: int, names: Sequence[str] = ("pan", "lift")
) -> Intent:
    """Positions a tick apart."""
    positions = np.array(rows, "<f4").tobytes()
    window = JointTrajectory(name=tuple(names), start=start, period=0.02, positions=positions)
    return Intent(joint_trajectory=window, behaviour="reach", reason="because", basis=1)


class ArmBench:
    """An arm that is enabled, at rest with all joints at 0."""

    def __init__(self, body: BodyDescription | None = None, *, sag: float = 0.0) -> None:
        self.body = body or arm_body()
        self.memory, self.tick, self.sag = JointMemory(), 0, sag
        self.gate, self.limp, self.blocked, self.boot = DRIVING, False, False, 7
        self.sent = [JointMotion(0.0) for _ in self.body.joints]
        self.here = [-sag] * len(self.sent)
        self.places: list[tuple[float, ...]] = []  # commanded
        self.missing = False
        self.band = ANY_SPEED  # limits of safety

    def go(
        self, intent: Intent | None = None, *, teleop: JointSpeeds | None = None, ticks: int = 1
    ) -> JointCommand | None:
        """Pass `ticks` ticks with one intent; return the last command."""
        command = None
        for _ in range(ticks):
            self.tick += 1
            inputs = JointInputs(state=self.state(), intent=intent, teleop=teleop)
            self.memory, command = step_joints(self.body, self.memory, inputs)
            if command:
                self.obey(command)
                sent = tuple(motion.position for motion in self.sent)
                self.places.append(command.position or sent)
        return command

    def state(self) -> RobotState:
        names = [joint.name for joint in self.body.joints][: -1 if self.missing else None]
        return RobotState(
            robot_type="crane",
            pose=Pose(x=0.0, y=0.0, yaw=0.0),
            velocity=Velocity(),
            joints=tuple(Joint(name=n, position=p) for n, p in zip(names, self.here, strict=False)),
            joints_sent=tuple(motion.position for motion in self.sent),
            limp=self.limp,
            gate=self.gate,
            tick=self.tick,
            boot=self.boot,
        )

    def obey(self, command: JointCommand) -> None:
        """Let the gate and the servos do it."""
        if self.gate.mode == "enabled" and self.gate.commander == "control":
            wanted = map(JointMotion, command.position, command.velocity)
            self.sent = [
                approach(now, to, joint, 0.02, self.band) if to else braked(now, joint, 0.02)
                for now, to, joint in zip_longest(self.sent, wanted, self.body.joints)
            ]
        if not self.blocked:
            self.here = [
                here + 0.5 * (motion.position - self.sag - here)
                for here, motion in zip(self.here, self.sent, strict=True)
            ]


CLOSED = {
    "latched": GateStatus(mode="latched", enables=1),
    "idle": GateStatus(mode="idle", enables=1),
    "a script's": GateStatus(mode="enabled", commander="script", enables=1),
}
