"""What the gate checks: how old things are, what speaks against moving, what is no good command."""

import math

from gigabrain_schemas.base import TICK_NS, Cause, Velocity
from gigabrain_schemas.brain import CmdVel
from gigabrain_zenoh.gate import causes as why
from gigabrain_zenoh.gate.state import BRAIN, GateConfig, GateState

ECHO_NS = 150_000_000  # commands and verdicts must echo a tick that was issued this recently
ISSUED_TICKS = 16  # ticks whose wall time is remembered; an echo is accepted for 7
SILENCE_TICKS = 5  # 100 ms without a good command
STILL_LINEAR, STILL_ANGULAR = 0.01, 0.05  # [m/s], [rad/s]


def age_ns(state: GateState, tick: int, wall_ns: int | None) -> int:
    """How long ago `tick` was issued: by ticks, and by the wall clock where there is one [ns]."""
    back = state.tick - tick
    age = back * TICK_NS
    if wall_ns is not None and 0 <= back < len(state.issued_ns):
        age = max(age, wall_ns - state.issued_ns[-1 - back])
    return age


def at_rest(measured: Velocity) -> bool:
    """Whether the body stands still; what is not a number does not."""
    return (
        abs(measured.linear_x) < STILL_LINEAR
        and abs(measured.linear_y) < STILL_LINEAR
        and abs(measured.angular_z) < STILL_ANGULAR
    )


def is_finite(command: CmdVel) -> bool:
    """Whether all speeds are numbers. What was decoded is; this is for what was not."""
    speeds = (command.linear_x, command.linear_y, command.angular_z)
    return all(math.isfinite(speed) for speed in speeds)


def against(config: GateConfig, state: GateState, source: str) -> tuple[Cause, ...]:
    """What speaks against letting `source` move the body now."""
    found = [*state.faults, *_verdict(state)]
    if state.mode == "enabled" and source == state.commander:
        command, came = state.command, state.command_tick
    elif source == BRAIN:
        command, came = state.heard, state.heard_tick
    else:
        return tuple(found)  # somebody new need not have spoken yet
    if state.tick - came > SILENCE_TICKS:
        found.append(why.SILENCE)
    if command and command.basis and age_ns(state, command.basis, None) > config.basis_ns:
        found.append(why.STALE)
    return tuple(found)


def _verdict(state: GateState) -> tuple[Cause, ...]:
    """Zones alone only cap speeds, so their causes are not among these."""
    safety = state.safety
    ticked_ns = state.issued_ns[-1] if state.issued_ns else None
    if safety is None or age_ns(state, safety.tick, ticked_ns) > ECHO_NS:
        return (why.SAFETY_SILENT,)
    if safety.verdict == "stop":
        return safety.causes or (why.SAFETY_STOP,)
    return why.latching(safety.causes)


def refusal(state: GateState, command: CmdVel, wall_ns: int | None) -> str:
    """Why `command` is no good, whoever sent it; a code, empty for a good one."""
    if command.boot != state.boot:
        return "boot"
    if command.tick > state.tick or command.basis > state.tick:
        return "future"
    if age_ns(state, command.tick, wall_ns) > ECHO_NS:
        return "old"
    moves = command.linear_x or command.linear_y or command.angular_z
    if moves and command.source == BRAIN and not command.basis:
        return "basis"  # the brain has no business moving without having looked
    return ""
