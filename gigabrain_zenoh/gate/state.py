"""The gate's state and events, and the checks on them."""

import math

import msgspec

from gigabrain_schemas.base import TICK_NS, Cause, Velocity
from gigabrain_schemas.body import GateMode, GateStatus, JointDescription
from gigabrain_schemas.brain import CmdVel, JointCommand
from gigabrain_schemas.safety import SafetyState
from gigabrain_zenoh.gate import causes as why
from gigabrain_zenoh.geometry.joints import JointMotion
from gigabrain_zenoh.geometry.limits import ZERO, Limits

BRAIN = "control"  # the commander of the normal chain


class GateConfig(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of the gate, from the body and the deployment."""

    limits: Limits
    joints: tuple[JointDescription, ...] = ()  # those that accept commands
    basis_ns: int = 250_000_000  # maximum age of sensor data that may move the body
    auto_resume: bool = False


class GateState(msgspec.Struct, frozen=True, kw_only=True):
    """State of the gate from event to event."""

    boot: int
    tick: int = 0
    issued_ns: tuple[int, ...] = ()  # wall time of the newest ticks, oldest first
    mode: GateMode = "latched"
    causes: tuple[Cause, ...] = (why.BOOT,)
    faults: tuple[Cause, ...] = ()  # reported by the driver at the last tick
    estop_generation: int = 0
    by_hand: bool = False  # a person released a latch: no automatic resume
    commander: str = ""
    enables: int = 0
    latches: int = 0
    enabled_tick: int = -1000  # when the commander was enabled
    command: CmdVel | None = None  # newest valid one of the commander
    command_tick: int = 0  # when it arrived
    next_seq: int = 0  # the lowest that is accepted
    joint_command: JointCommand | None = None  # these three: the same for joints
    joint_tick: int = 0
    next_joint_seq: int = 0
    brain_command: CmdVel | JointCommand | None = None
    # newest valid one of the brain, also while it does not drive
    brain_tick: int = -1000
    safety: SafetyState | None = None
    stopped_tick: int = 0  # when stopping began
    still_ticks: int = 0
    healthy_ticks: int = 0
    nan_ticks: tuple[int, ...] = ()  # arrivals of the newest commands with NaN or infinity
    nan_source: str = ""  # their sender
    late: bool = False  # this tick was missed, and is processed in a burst
    before: Velocity = ZERO  # output of the last tick
    output: Velocity = ZERO  # velocity for the body
    joints_before: tuple[JointMotion, ...] = ()  # goals of the last tick
    joints: tuple[JointMotion, ...] = ()  # goals for the body; empty before any measurement


class Tick(msgspec.Struct, frozen=True):
    """20 ms of the body's time have passed."""

    measured: Velocity
    wall_ns: int | None = None
    faults: tuple[Cause, ...] = ()  # reported by the driver
    late: bool = False  # it was missed, and is processed in a burst
    joints: tuple[JointMotion, ...] = ()  # as measured, those that accept commands
    held: tuple[float, ...] = ()  # where the body itself holds them; empty if not reported
    limp: bool = False  # the torque of the joints is off


class VelocityCommand(msgspec.Struct, frozen=True):
    """A velocity command has arrived."""

    command: CmdVel
    wall_ns: int | None = None


class JointsCommand(msgspec.Struct, frozen=True):
    """A command for joints has arrived."""

    command: JointCommand
    wall_ns: int | None = None


class NotFinite(msgspec.Struct, frozen=True):
    """A command with NaN or infinity has arrived."""

    source: str
    boot: int


class Safety(msgspec.Struct, frozen=True):
    """A verdict of safety has arrived."""

    state: SafetyState


class Estop(msgspec.Struct, frozen=True):
    """The e-stop was pressed."""

    source: str


class Release(msgspec.Struct, frozen=True):
    """A person releases the latch."""

    estop_generation: int


class Enable(msgspec.Struct, frozen=True):
    """A commander asks for the body."""

    source: str
    take: bool = False
    by: str = ""  # sender of the request, if another than `source`


Event = Tick | VelocityCommand | JointsCommand | NotFinite | Safety | Estop | Release | Enable


class Outcome(msgspec.Struct, frozen=True):
    """Result of an event."""

    refused: str = ""  # code of why a command was not obeyed
    ok: bool = True  # whether a request was granted
    text: str = ""  # the answer to a request, for people


def status(state: GateState) -> GateStatus:
    """Return the gate's status for `robot/state`."""
    return GateStatus(
        mode=state.mode,
        causes=state.causes,
        estop_generation=state.estop_generation,
        commander=state.commander,
        enables=state.enables,
        latches=state.latches,
    )


ECHO_NS = 150_000_000  # commands and verdicts must echo a tick that was issued this recently
ISSUED_TICKS = 16  # ticks whose wall time is remembered; an echo is accepted for 7
SILENCE_TICKS = 5  # 100 ms without a valid command


def age_ns(state: GateState, tick: int, wall_ns: int | None) -> int:
    """Return the age of `tick` [ns]: the larger of tick count and wall clock, if there is one."""
    age_ticks = state.tick - tick
    age = age_ticks * TICK_NS
    if wall_ns is not None and 0 <= age_ticks < len(state.issued_ns):
        age = max(age, wall_ns - state.issued_ns[-1 - age_ticks])
    return age


def is_finite(command: CmdVel | JointCommand) -> bool:
    """Return whether all numbers of a command are finite; those of decoded messages are."""
    if isinstance(command, JointCommand):
        return all(map(math.isfinite, (*command.position, *command.velocity)))
    return all(map(math.isfinite, (command.linear_x, command.linear_y, command.angular_z)))


def stop_reasons(config: GateConfig, state: GateState, source: str) -> tuple[Cause, ...]:
    """Return the causes for which `source` must not move the body now."""
    reasons = [*state.faults, *_safety_causes(state)]
    streams: tuple[tuple[CmdVel | JointCommand | None, int], ...]
    if state.mode == "enabled" and source == state.commander:
        streams = (state.command, state.command_tick), (state.joint_command, state.joint_tick)
    elif source == BRAIN:
        streams = ((state.brain_command, state.brain_tick),)
    else:
        return tuple(reasons)  # a new commander need not have sent a command yet
    live = [command for command, arrived in streams if state.tick - arrived <= SILENCE_TICKS]
    if not live:
        reasons.append(why.SILENCE)
        live = [command for command, _ in streams]
    bases = [command.basis for command in live if command and command.basis]
    if any(age_ns(state, basis, None) > config.basis_ns for basis in bases):
        reasons.append(why.STALE)
    return tuple(reasons)


def _safety_causes(state: GateState) -> tuple[Cause, ...]:
    """Return safety's stop causes; zones only cap speeds and are not among them."""
    safety = state.safety
    ticked_ns = state.issued_ns[-1] if state.issued_ns else None
    if safety is None or age_ns(state, safety.tick, ticked_ns) > ECHO_NS:
        return (why.SAFETY_SILENT,)
    if safety.verdict == "stop":
        return safety.causes or (why.SAFETY_STOP,)
    return why.latching(safety.causes)


def refusal(state: GateState, command: CmdVel | JointCommand, wall_ns: int | None) -> str:
    """Return the code of why a command is refused, from any sender; empty if it is valid."""
    if command.boot != state.boot:
        return "boot"
    if command.tick > state.tick or command.basis > state.tick:
        return "future"
    if age_ns(state, command.tick, wall_ns) > ECHO_NS:
        return "old"
    if moves(command) and command.source == BRAIN and not command.basis:
        return "basis"  # the brain must not move without sensor data
    return ""


def moves(command: CmdVel | JointCommand) -> bool:
    """Return whether a command asks for motion."""
    if isinstance(command, JointCommand):
        return True
    return bool(command.linear_x or command.linear_y or command.angular_z)
