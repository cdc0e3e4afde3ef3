"""The gate's state and events, and the checks on them."""

import math

import msgspec

from gigabrain_schemas.base import TICK_NS, Cause, Velocity
from gigabrain_schemas.body import GateMode, GateStatus
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState
from gigabrain_zenoh.gate import causes as why
from gigabrain_zenoh.geometry.limits import ZERO, Limits

BRAIN = "control"  # the commander of the normal chain


class GateConfig(msgspec.Struct, frozen=True, kw_only=True):
    """What the gate must know of the body and of the deployment."""

    limits: Limits
    basis_ns: int = 250_000_000  # oldest sensor data that may move the body
    auto_resume: bool = False


class GateState(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that the gate remembers."""

    boot: int
    tick: int = 0
    issued_ns: tuple[int, ...] = ()  # wall time of the newest ticks, oldest first
    mode: GateMode = "latched"
    causes: tuple[Cause, ...] = (why.BOOT,)
    faults: tuple[Cause, ...] = ()  # what the driver itself knew to be wrong at the last tick
    estop_generation: int = 0
    by_hand: bool = False  # released from a latch: only a person enables it, not auto resume
    commander: str = ""
    enables: int = 0
    enabled_tick: int = -1000  # when the present commander was let in
    command: CmdVel | None = None  # last good one of the commander
    command_tick: int = 0  # when it came
    next_seq: int = 0  # the lowest that the commander may use
    heard: CmdVel | None = None  # last good one of the brain, whoever commands
    heard_tick: int = -1000
    safety: SafetyState | None = None
    stopped_tick: int = 0  # when stopping began
    still_ticks: int = 0
    healthy_ticks: int = 0
    nan_ticks: tuple[int, ...] = ()
    late: bool = False  # whether this tick is one that was missed and is made up for
    before: Velocity = ZERO  # what the body was told in the last tick
    output: Velocity = ZERO  # what the body is to be told now


class Tick(msgspec.Struct, frozen=True):
    """20 ms of the body's time have passed."""

    measured: Velocity
    wall_ns: int | None = None
    faults: tuple[Cause, ...] = ()  # what the driver itself knows to be wrong
    late: bool = False  # it was missed and is made up for, right behind another one


class Command(msgspec.Struct, frozen=True):
    """Somebody wants the body to move."""

    command: CmdVel
    wall_ns: int | None = None


class NotFinite(msgspec.Struct, frozen=True):
    """Somebody sent NaN or infinity for a speed."""

    source: str
    boot: int


class Safety(msgspec.Struct, frozen=True):
    """The safety process has spoken."""

    state: SafetyState


class Estop(msgspec.Struct, frozen=True):
    """Somebody pressed the e-stop."""

    source: str


class Release(msgspec.Struct, frozen=True):
    """A person lets go of the latch."""

    estop_generation: int


class Enable(msgspec.Struct, frozen=True):
    """Somebody asks for the body."""

    source: str
    take: bool = False
    by: str = ""  # who asks for it, where that is somebody else


Event = Tick | Command | NotFinite | Safety | Estop | Release | Enable


class Outcome(msgspec.Struct, frozen=True):
    """What came of an event."""

    refused: str = ""  # why a command was not obeyed; a code
    ok: bool = True  # whether a request was granted
    text: str = ""  # the answer to a request, for people


def status(state: GateState) -> GateStatus:
    """The gate as `robot/state` shows it."""
    return GateStatus(
        mode=state.mode,
        causes=state.causes,
        estop_generation=state.estop_generation,
        commander=state.commander,
        enables=state.enables,
    )


ECHO_NS = 150_000_000  # commands and verdicts must echo a tick that was issued this recently
ISSUED_TICKS = 16  # ticks whose wall time is remembered; an echo is accepted for 7
SILENCE_TICKS = 5  # 100 ms without a good command


def age_ns(state: GateState, tick: int, wall_ns: int | None) -> int:
    """How long ago `tick` was issued: by ticks, and by the wall clock where there is one [ns]."""
    back = state.tick - tick
    age = back * TICK_NS
    if wall_ns is not None and 0 <= back < len(state.issued_ns):
        age = max(age, wall_ns - state.issued_ns[-1 - back])
    return age


def is_finite(command: CmdVel) -> bool:
    """Whether all speeds are numbers. What was decoded is; this is for what was not."""
    speeds = (command.linear_x, command.linear_y, command.angular_z)
    return all(math.isfinite(speed) for speed in speeds)


def stop_reasons(config: GateConfig, state: GateState, source: str) -> tuple[Cause, ...]:
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
