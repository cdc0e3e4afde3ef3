"""The gate's part for joints: which commands count, and where each joint goes next.

In every case but a live command of the commander, joints come to rest and are held there. They move
no faster in a direction than safety's newest verdict allows, and not at all by an old one.
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

VERDICT_TICKS = 2  # 40 ms, the oldest verdict of safety by which joints move
LIVE_TICKS = 2  # 40 ms after a command, joints that get no other brake
TOLERANCE = 1e-6  # [rad] or [m], of positions at a limit


def refusal(config: GateConfig, state: GateState, command: JointCommand) -> str:
    """Return the code for which a command for joints is refused; empty if it is valid."""
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
    """Return where the joints were sent in the last tick.

    At the start, and while the body cannot be reached, that is where it holds them by itself; at
    the start where they are, if nothing does.
    """
    if event.joints and event.limp:
        return tuple(map(frozen, event.joints))
    if event.held and why.LINK_LOST in (*state.faults, *event.faults):
        return tuple(map(JointMotion, event.held))
    if event.joints and not state.joints:
        return tuple(map(JointMotion, event.held)) or tuple(map(frozen, event.joints))
    return state.joints


def output(config: GateConfig, state: GateState, calm: bool) -> tuple[JointMotion, ...]:
    """Return where each joint goes: one step from the output of the last tick.

    A latched body's joints stop at once. Ticks that are made up for in a burst only brake.
    """
    now = state.joints_before
    if state.mode == "latched":
        return tuple(map(stopped, now))
    command = state.joint_command
    live = command and state.tick - state.joint_tick < LIVE_TICKS
    safety = state.safety
    known = safety is not None and state.tick - safety.tick <= VERDICT_TICKS
    if state.mode != "enabled" or not live or not known or calm or state.late:
        command = None
    bands = _bands(safety.joints if safety else ())
    return tuple(
        _step(joint, motion, command, bands.get(joint.name, ANY_SPEED))
        for joint, motion in zip(config.joints, now, strict=False)
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
    joint: JointDescription, now: JointMotion, command: JointCommand | None, band: SpeedBand
) -> JointMotion:
    if command is None or joint.name not in command.name:
        return braked(now, joint, TICK_S)
    index = command.name.index(joint.name)
    velocity = command.velocity[index] if command.velocity else 0.0
    if not command.position and not velocity:
        return braked(now, joint, TICK_S)
    if not command.position:
        return accelerated(now, velocity, joint, TICK_S, band)
    return approach(now, JointMotion(command.position[index], velocity), joint, TICK_S, band)
