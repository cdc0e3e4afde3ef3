"""Monitors of an arm's joints: whether they are where they were sent, and not overloaded.

What the arm comes near to is judged by `arm_motion`.
"""

from collections.abc import Sequence

from msgspec import Struct
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_S, Cause
from gigabrain_schemas.body import BodyDescription, Joint, JointDescription, RobotState
from gigabrain_zenoh.geometry.joints import JointMotion
from gigabrain_zenoh.safety.arm_motion import ArmLimits, ArmShape, limits
from gigabrain_zenoh.safety.catalogue import cause, lasting, ticks_of

WINDOW_TICKS = 15  # 0.3 s for the line to the servos and back, and for them to follow
LOST_TICKS = 5  # 0.1 s without a joint in the state
JUMP_FACTOR, JUMP_TICKS = 1.5, 3  # of the greatest speed; states that may come late
GRIP_FACTOR = 5.0  # a gripper may hold something so many times longer at its greatest effort
Counts = dict[str, int]  # by joint, in ticks


class ArmMonitor(Struct, frozen=True, kw_only=True):
    """Compares joints with what they were sent, and finds how fast they may move."""

    sent: tuple[tuple[float, ...], ...] = ()  # of the newest ticks
    measured: tuple[Joint, ...] = ()  # of the last state
    speeds: tuple[float, ...] = ()  # at which they are sent on [rad/s] or [m/s]
    limits: ArmLimits = ArmLimits()
    judged: tuple[object, ...] = ()  # the postures that the limits are for
    shape: ArmShape | None = None
    lost: Counts = {}
    off: Counts = {}
    strained: Counts = {}
    frozen: Counts = {}
    jumped: str = ""  # the joint that did, in this state
    low_ticks: int = 0  # of the voltage
    high_ticks: int = 0
    problem: str = ""  # of its model

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

        `elapsed` are those of them that count. Without a `shape` there is a `problem`.
        """
        if not body.joints or not elapsed:
            return self
        measured = {joint.name: joint for joint in state.joints}
        lost = _counted(
            self.lost, elapsed, {joint.name: joint.name not in measured for joint in body.joints}
        )
        now = replace(self, lost=lost, problem=problem, jumped="")._powered(body, state, elapsed)
        if not state.link.connected or len(measured.keys() & lost.keys()) < len(body.joints):
            return now
        joints = tuple(measured[joint.name] for joint in body.joints)
        now = now._moved(body, state, joints, elapsed, passed)
        if shape is None:
            return now
        there = tuple(JointMotion(joint.position, joint.velocity) for joint in joints)
        sent = now.sent[-1] if now.sent else tuple(joint.position for joint in joints)
        speeds = now.speeds or (0.0,) * len(joints)
        judged = (sent, speeds, there)
        if judged == now.judged and shape is now.shape:  # it rests
            return now
        clearance = body.thresholds.arm_clearance
        found = limits(body.joints, shape, sent, speeds, there, clearance)
        return replace(now, limits=found, judged=judged, shape=shape)

    def _powered(self, body: BodyDescription, state: RobotState, elapsed: int) -> "ArmMonitor":
        if body.arm is None or body.arm.voltage is None or state.battery is None:
            return self
        least, most = body.arm.voltage
        volts = state.battery.voltage
        return replace(
            self,
            low_ticks=lasting(self.low_ticks, volts < least, elapsed),
            high_ticks=lasting(self.high_ticks, volts > most, elapsed),
        )

    def _moved(
        self,
        body: BodyDescription,
        state: RobotState,
        joints: tuple[Joint, ...],
        elapsed: int,
        passed: int,
    ) -> "ArmMonitor":
        """Compare a state with the last one, and with what was sent."""
        if state.limp or not state.joints_sent:  # a person may move them
            return replace(
                self, sent=(), measured=joints, speeds=(), off={}, strained={}, frozen={}
            )
        sent = (*self.sent, state.joints_sent)[-WINDOW_TICKS:]
        pairs = tuple(zip(body.joints, joints, strict=True))
        before = self.measured or joints
        stays = {
            one.name: one == last and _error(limit, one, [sent[-1]], index) > 0.5
            for index, ((limit, one), last) in enumerate(zip(pairs, before, strict=True))
        }
        off = {
            one.name: _error(limit, one, sent, index) > 1.0
            for index, (limit, one) in enumerate(pairs)
        }
        jumped = (
            one.name
            for (limit, one), last in zip(pairs, before, strict=True)
            if abs(one.position - last.position) > _jump(limit, passed)
        )
        return replace(
            self,
            sent=sent,
            measured=joints,
            speeds=_speeds(sent, passed),
            off=_counted(self.off, elapsed, off),
            strained=_counted(
                self.strained, elapsed, {one.name: _strained(limit, one) for limit, one in pairs}
            ),
            frozen=_counted(self.frozen, elapsed, stays),
            jumped=next(jumped, ""),
        )

    def causes(self, body: BodyDescription) -> tuple[Cause, ...]:
        """Return why the arm must stop."""
        times = body.thresholds
        sustain = ticks_of(times.battery_sustain)
        found = [cause("arm_model", self.problem)] if self.problem else []
        if self.jumped:
            found.append(cause("joint_jump", f"{self.jumped} jumped farther than it can move"))
        if self.low_ticks >= sustain:
            found.append(cause("voltage_low"))
        if self.high_ticks >= sustain:
            found.append(cause("voltage_high"))
        grip = GRIP_FACTOR * times.effort_sustain
        for joint in body.joints:
            effort = grip if joint.part == "gripper" else times.effort_sustain
            judged = (
                ("joint_lost", self.lost, LOST_TICKS, "is no longer reported"),
                ("joint_frozen", self.frozen, ticks_of(times.frozen_sustain),
                 "repeats the same values although it should move"),
                ("joint_off", self.off, ticks_of(times.joint_sustain),
                 "is not where it was sent"),
                ("joint_overload", self.strained, ticks_of(effort),
                 "has been at its greatest effort for too long"),
            )  # fmt: skip
            found += [
                cause(code, f"{joint.name} {words}")
                for code, counts, enough, words in judged
                if counts.get(joint.name, 0) >= enough
            ]
        return tuple(found)


def _counted(before: Counts, elapsed: int, wrong: dict[str, bool]) -> Counts:
    return {name: lasting(before.get(name, 0), is_so, elapsed) for name, is_so in wrong.items()}


def _error(
    limit: JointDescription, joint: Joint, sent: Sequence[tuple[float, ...]], index: int
) -> float:
    """Return how far a joint is off what was sent lately, in parts of what it may be off.

    A gripper that holds something cannot reach what it was sent; it is judged by its effort.
    """
    if limit.part == "gripper":
        return 0.0
    positions = [one[index] for one in sent]
    over, under = joint.position - max(positions), min(positions) - joint.position
    return max(over, under, 0.0) / limit.follow_error


def _jump(limit: JointDescription, passed: int) -> float:
    return JUMP_FACTOR * limit.max_speed * TICK_S * (passed + JUMP_TICKS)


def _strained(limit: JointDescription, joint: Joint) -> bool:
    pairs = ((joint.effort, limit.max_effort), (joint.current, limit.max_current))
    return any(value is not None and most and abs(value) >= most for value, most in pairs)


def _speeds(sent: Sequence[tuple[float, ...]], passed: int) -> tuple[float, ...]:
    """Return the speeds at which joints are sent on [rad/s] or [m/s]."""
    if len(sent) < 2 or not passed:
        return ()
    return tuple(
        (now - last) / (passed * TICK_S) for now, last in zip(sent[-1], sent[-2], strict=True)
    )
