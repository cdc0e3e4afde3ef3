"""Monitors of an arm's joints: position errors, overload, and lost or implausible data.

Distances to obstacles are judged by `arm_motion`.
"""

from collections.abc import Sequence

from msgspec import Struct
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_S, Cause
from gigabrain_schemas.body import BodyDescription, Joint, JointDescription, RobotState
from gigabrain_zenoh.geometry.joints import JointMotion
from gigabrain_zenoh.safety.arm_motion import ArmLimits, ArmShape, limits
from gigabrain_zenoh.safety.catalogue import cause, lasting, ticks_of

WINDOW_TICKS = 15  # 0.3 s: the line's round trip, and the servos' own delay
LOST_TICKS = 5  # 0.1 s without a joint in the state
JUMP_FACTOR = 1.5  # a joint that is this much faster than its maximum speed jumps
JUMP_TICKS = 3  # a state may be this late
GRIP_FACTOR = 5.0  # a gripper may be at its maximum effort this many times longer
Counts = dict[str, int]  # ticks by joint


class ArmMonitor(Struct, frozen=True, kw_only=True):
    """Compares joints with their setpoints, and computes their speed limits."""

    sent: tuple[tuple[float, ...], ...] = ()  # setpoints of the newest ticks
    measured: tuple[Joint, ...] = ()  # joints in the last state
    speeds: tuple[float, ...] = ()  # of the setpoints [rad/s] or [m/s]
    limits: ArmLimits = ArmLimits()
    limits_inputs: tuple[object, ...] = ()  # from which `limits` are computed
    shape: ArmShape | None = None
    lost: Counts = {}  # not in the state
    off: Counts = {}  # too far from the recent setpoints
    overloaded: Counts = {}
    frozen: Counts = {}
    jumped: str = ""  # joint that jumped in this state
    low_voltage_ticks: int = 0
    high_voltage_ticks: int = 0
    problem: str = ""  # with the arm's model

    def then(
        self,
        body: BodyDescription,
        state: RobotState,
        elapsed: int,
        passed: int,
        shape: ArmShape | None,
        problem: str,
    ) -> "ArmMonitor":
        """Return the monitor after one more state, `passed` ticks after the last one.

        Counters grow by `elapsed` ticks. Without a `shape`, `problem` says why.
        """
        if not body.joints or not elapsed:
            return self
        measured = {joint.name: joint for joint in state.joints}
        lost = _count_ticks(
            self.lost, elapsed, {joint.name: joint.name not in measured for joint in body.joints}
        )
        now = replace(self, lost=lost, problem=problem, jumped="")
        now = now._with_voltage(body, state, elapsed)
        if not state.link.connected or len(measured.keys() & lost.keys()) < len(body.joints):
            return now
        joints = tuple(measured[joint.name] for joint in body.joints)
        now = now._with_joints(body, state, joints, elapsed, passed)
        if shape is None:
            return now
        motion = tuple(JointMotion(joint.position, joint.velocity) for joint in joints)
        sent = now.sent[-1] if now.sent else tuple(joint.position for joint in joints)
        speeds = now.speeds or (0.0,) * len(joints)
        inputs = (sent, speeds, motion)
        if inputs == now.limits_inputs and shape is now.shape:  # the arm rests
            return now
        clearance = body.thresholds.arm_clearance
        found = limits(body.joints, shape, sent, speeds, motion, clearance)
        return replace(now, limits=found, limits_inputs=inputs, shape=shape)

    def _with_voltage(self, body: BodyDescription, state: RobotState, elapsed: int) -> "ArmMonitor":
        if body.arm is None or body.arm.voltage is None or state.battery is None:
            return self
        lowest, highest = body.arm.voltage
        volts = state.battery.voltage
        return replace(
            self,
            low_voltage_ticks=lasting(self.low_voltage_ticks, volts < lowest, elapsed),
            high_voltage_ticks=lasting(self.high_voltage_ticks, volts > highest, elapsed),
        )

    def _with_joints(
        self,
        body: BodyDescription,
        state: RobotState,
        joints: tuple[Joint, ...],
        elapsed: int,
        passed: int,
    ) -> "ArmMonitor":
        """Compare the joints with the last state, and with their setpoints."""
        if state.limp or not state.joints_sent:  # a person may move the joints
            return replace(
                self, sent=(), measured=joints, speeds=(), off={}, overloaded={}, frozen={}
            )
        sent = (*self.sent, state.joints_sent)[-WINDOW_TICKS:]
        pairs = tuple(zip(body.joints, joints, strict=True))
        before = self.measured or joints
        frozen = {
            joint.name: joint == last and _relative_error(limit, joint, [sent[-1]], index) > 0.5
            for index, ((limit, joint), last) in enumerate(zip(pairs, before, strict=True))
        }
        off = {
            joint.name: _relative_error(limit, joint, sent, index) > 1.0
            for index, (limit, joint) in enumerate(pairs)
        }
        jumped = (
            joint.name
            for (limit, joint), last in zip(pairs, before, strict=True)
            if abs(joint.position - last.position) > _max_travel(limit, passed)
        )
        return replace(
            self,
            sent=sent,
            measured=joints,
            speeds=_setpoint_speeds(sent, passed),
            off=_count_ticks(self.off, elapsed, off),
            overloaded=_count_ticks(
                self.overloaded,
                elapsed,
                {joint.name: _overloaded(limit, joint) for limit, joint in pairs},
            ),
            frozen=_count_ticks(self.frozen, elapsed, frozen),
            jumped=next(jumped, ""),
        )

    def causes(self, body: BodyDescription) -> tuple[Cause, ...]:
        """Return the causes that stop the arm."""
        thresholds = body.thresholds
        sustain = ticks_of(thresholds.battery_sustain)
        found = [cause("arm_model", self.problem)] if self.problem else []
        if self.jumped:
            found.append(cause("joint_jump", f"{self.jumped} jumped farther than it can move"))
        if self.low_voltage_ticks >= sustain:
            found.append(cause("voltage_low"))
        if self.high_voltage_ticks >= sustain:
            found.append(cause("voltage_high"))
        grip_s = GRIP_FACTOR * thresholds.effort_sustain
        for joint in body.joints:
            effort_s = grip_s if joint.part == "gripper" else thresholds.effort_sustain
            faults = (
                ("joint_lost", self.lost, LOST_TICKS, "is no longer reported"),
                ("joint_frozen", self.frozen, ticks_of(thresholds.frozen_sustain),
                 "repeats the same values although it should move"),
                ("joint_off", self.off, ticks_of(thresholds.joint_sustain),
                 "is not where it was sent"),
                ("joint_overload", self.overloaded, ticks_of(effort_s),
                 "has been at its greatest effort for too long"),
            )  # fmt: skip
            found += [
                cause(code, f"{joint.name} {text}")
                for code, counts, max_ticks, text in faults
                if counts.get(joint.name, 0) >= max_ticks
            ]
        return tuple(found)


def _count_ticks(before: Counts, elapsed: int, faults: dict[str, bool]) -> Counts:
    return {name: lasting(before.get(name, 0), fault, elapsed) for name, fault in faults.items()}


def _relative_error(
    limit: JointDescription, joint: Joint, sent: Sequence[tuple[float, ...]], index: int
) -> float:
    """Return a joint's distance from its recent setpoints, as a share of its allowed error.

    It is 0 for a gripper: one that holds something cannot reach its setpoint.
    """
    if limit.part == "gripper":
        return 0.0
    setpoints = [posture[index] for posture in sent]
    over, under = joint.position - max(setpoints), min(setpoints) - joint.position
    return max(over, under, 0.0) / limit.follow_error


def _max_travel(limit: JointDescription, passed: int) -> float:
    return JUMP_FACTOR * limit.max_speed * TICK_S * (passed + JUMP_TICKS)


def _overloaded(limit: JointDescription, joint: Joint) -> bool:
    pairs = ((joint.effort, limit.max_effort), (joint.current, limit.max_current))
    return any(value is not None and high and abs(value) >= high for value, high in pairs)


def _setpoint_speeds(sent: Sequence[tuple[float, ...]], passed: int) -> tuple[float, ...]:
    """Return the speeds of the setpoints [rad/s] or [m/s]; empty while unknown."""
    if len(sent) < 2 or not passed:
        return ()
    return tuple(
        (now - last) / (passed * TICK_S) for now, last in zip(sent[-1], sent[-2], strict=True)
    )
