"""The gate's part for joints: checks commands, and computes the next goal of each joint.

Without a live command of the commander, joints come to rest and are held there. Safety's newest
verdict limits their speed in each direction. While it is old, they do not move.
"""

import math

from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import JointDescription
from gigabrain_schemas.brain import JointCommand
from gigabrain_schemas.safety import JointCap
from gigabrain_zenoh.gate import causes as why
from gigabrain_zenoh.gate.state import GateConfig, GateState, Tick
from gigabrain_zenoh.geometry.joints import (
    ANY_SPEED,
    JointMotion,
    SpeedBand,
    accelerated,
    approach,
    braked,
    frozen,
    stopped,
)

MAX_VERDICT_TICKS = 2  # 40 ms; joints do not move by an older verdict
COMMAND_TICKS = 2  # 40 ms; joints brake unless the next command arrives by then
TOLERANCE = 1e-6  # [rad] or [m], of positions at a limit


def refusal(config: GateConfig, state: GateState, command: JointCommand) -> str:
    """Return the code of why a joint command is refused; empty if it is valid."""
    known = {joint.name: joint for joint in config.joints}
    if not known:
        return "no_joints"
    if not state.joints:
        return "joints_unknown"  # not measured yet
    if any(name not in known for name in command.name):
        return "joint"
    for name, position in zip(command.name, command.position, strict=False):
        joint = known[name]
        if not joint.lower - TOLERANCE <= position <= joint.upper + TOLERANCE:
            return "joint_limits"
    return ""


def before(state: GateState, event: Tick) -> tuple[JointMotion, ...]:
    """Return the goal of each joint in the last tick.

    At the start, and while the link is lost, this is where the body itself holds the joint. If it
    does not report that at the start, or the joint is limp, this is the measured position.
    """
    if event.joints and event.limp:
        return tuple(map(frozen, event.joints))
    if event.held and why.LINK_LOST in (*state.faults, *event.faults):
        return tuple(map(JointMotion, event.held))
    if event.joints and not state.joints:
        return tuple(map(JointMotion, event.held)) or tuple(map(frozen, event.joints))
    return state.joints


def output(config: GateConfig, state: GateState, calm: bool) -> tuple[JointMotion, ...]:
    """Return the next goal of each joint: one step from that of the last tick.

    A latched body's joints stop at once. Missed ticks, processed in a burst, only brake.
    """
    last = state.joints_before
    if state.mode == "latched":
        return tuple(map(stopped, last))
    command = state.joint_command
    live = command and state.tick - state.joint_tick < COMMAND_TICKS
    safety = state.safety
    judged = safety is not None and state.tick - safety.tick <= MAX_VERDICT_TICKS
    if state.mode != "enabled" or not live or not judged or calm or state.late:
        command = None
    bands = _bands(safety.joints if safety else ())
    return tuple(
        _step(joint, motion, command, bands.get(joint.name, ANY_SPEED))
        for joint, motion in zip(config.joints, last, strict=False)
    )


def _bands(caps: tuple[JointCap, ...]) -> dict[str, SpeedBand]:
    return {
        cap.name: SpeedBand(
            -math.inf if cap.fall is None else -cap.fall,
            math.inf if cap.rise is None else cap.rise,
        )
        for cap in caps
    }


def _step(
    joint: JointDescription, last: JointMotion, command: JointCommand | None, band: SpeedBand
) -> JointMotion:
    if command is None or joint.name not in command.name:
        return braked(last, joint, TICK_S)
    index = command.name.index(joint.name)
    velocity = command.velocity[index] if command.velocity else 0.0
    if not command.position and not velocity:
        return braked(last, joint, TICK_S)
    if not command.position:
        return accelerated(last, velocity, joint, TICK_S, band)
    return approach(last, JointMotion(command.position[index], velocity), joint, TICK_S, band)
