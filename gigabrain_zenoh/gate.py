"""The gate: alone lets a command through to the body. A pure function, no I/O, no clock.

    latched ──release──► idle ──enable──► enabled ──any cause──► stopping ──► idle or latched

`step(config, state, event) -> (state, outcome)`. Its time is the robot's tick (20 ms). Where there
is a wall clock worth trusting (not when time is lock-stepped), events carry it as well, and the age
of an echoed tick is bounded by both.
"""

import msgspec
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS, Cause, Velocity
from gigabrain_schemas.body import GateMode, GateStatus
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState
from gigabrain_zenoh import causes as why
from gigabrain_zenoh.limits import NO_CAPS, ZERO, Limits, clamp, ramp

TICK_S = TICK_NS / 1e9
ECHO_NS = 150_000_000  # a command must echo a tick that was issued this recently
SILENCE_TICKS = 5  # 100 ms without a good command
STOPPING_TICKS = 15  # 300 ms, then idle
STILL_TICKS = 25  # 0.5 s at rest before a release
HEALTHY_TICKS = 25  # 0.5 s without a cause before an automatic resume
NAN_STORM_COUNT, NAN_STORM_TICKS = 5, 50  # five in a second
STILL_LINEAR, STILL_ANGULAR = 0.01, 0.05  # [m/s], [rad/s]
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
    estop_generation: int = 0
    commander: str = ""
    enables: int = 0
    command: CmdVel | None = None  # last good one of the commander
    command_tick: int = 0  # when it came
    last_seq: int = -1
    heard: CmdVel | None = None  # last good one of the brain, whoever commands
    heard_tick: int = -1000
    safety: SafetyState | None = None
    stopped_tick: int = 0  # when stopping began
    still_ticks: int = 0
    healthy_ticks: int = 0
    nan_ticks: tuple[int, ...] = ()
    before: Velocity = ZERO  # what the body was told in the last tick
    output: Velocity = ZERO  # what the body is to be told now


class Tick(msgspec.Struct, frozen=True):
    """20 ms of the body's time have passed."""

    measured: Velocity
    wall_ns: int | None = None
    faults: tuple[Cause, ...] = ()  # what the driver itself knows to be wrong


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


Event = Tick | Command | NotFinite | Safety | Estop | Release | Enable


class Outcome(msgspec.Struct, frozen=True):
    """What came of an event."""

    refused: str = ""  # why a command was not obeyed; a code
    ok: bool = True  # whether a request was granted
    text: str = ""  # the answer to a request, for people


def step(config: GateConfig, state: GateState, event: Event) -> tuple[GateState, Outcome]:
    """One event."""
    match event:
        case Tick():
            return _tick(config, state, event), Outcome()
        case Command():
            return _command(config, state, event)
        case NotFinite():
            return _not_finite(state, event)
        case Safety():
            return _safety(config, state, event.state), Outcome()
        case Estop():
            return _estop(state, event)
        case Release():
            return _release(state, event)
        case Enable():
            return _enable(config, state, event)


def status(state: GateState) -> GateStatus:
    """The gate as `robot/state` shows it."""
    return GateStatus(
        mode=state.mode,
        causes=state.causes,
        estop_generation=state.estop_generation,
        commander=state.commander,
        enables=state.enables,
    )


def age_ns(state: GateState, tick: int, wall_ns: int | None) -> int:
    """How long ago `tick` was issued: by ticks, and by the wall clock where there is one [ns]."""
    back = state.tick - tick
    age = back * TICK_NS
    if wall_ns is not None and 0 <= back < len(state.issued_ns):
        age = max(age, wall_ns - state.issued_ns[-1 - back])
    return age


def _tick(config: GateConfig, state: GateState, event: Tick) -> GateState:
    still = abs(event.measured.angular_z) < STILL_ANGULAR and (
        max(abs(event.measured.linear_x), abs(event.measured.linear_y)) < STILL_LINEAR
    )
    issued = () if event.wall_ns is None else (*state.issued_ns[-8:], event.wall_ns)
    state = replace(
        state,
        tick=state.tick + 1,
        issued_ns=issued,
        still_ticks=state.still_ticks + 1 if still else 0,
        before=state.output,
    )
    now = (*event.faults, *_conditions(config, state, state.commander or BRAIN, event.wall_ns))
    state = replace(state, healthy_ticks=0 if now else state.healthy_ticks + 1)
    if state.mode == "enabled":
        state = _stop(state, now) if now else state
    elif state.mode == "stopping":
        state = _stopping(state, now)
    else:
        state = _waiting(config, state, now)
    return replace(state, output=_output(config, state))


def _conditions(
    config: GateConfig, state: GateState, source: str, wall_ns: int | None
) -> tuple[Cause, ...]:
    """What speaks against letting `source` move the body now."""
    found: list[Cause] = []
    if state.safety is None or age_ns(state, state.safety.tick, wall_ns) > ECHO_NS:
        found.append(why.SAFETY_SILENT)
    elif state.safety.verdict == "stop":
        found.extend(state.safety.causes)
    enabled = state.mode == "enabled"
    if enabled or source == BRAIN:
        command = state.command if enabled else state.heard
        heard_tick = state.command_tick if enabled else state.heard_tick
        if state.tick - heard_tick > SILENCE_TICKS:
            found.append(why.SILENCE)
        if command and command.basis and age_ns(state, command.basis, None) > config.basis_ns:
            found.append(why.STALE)
    return tuple(found)


def _stop(state: GateState, found: tuple[Cause, ...]) -> GateState:
    return replace(state, mode="stopping", causes=found, stopped_tick=state.tick, command=None)


def _stopping(state: GateState, now: tuple[Cause, ...]) -> GateState:
    """No way back to enabled from here: whoever stopped is asked again."""
    state = replace(state, causes=_merge(state.causes, why.latching(now)))
    if state.tick - state.stopped_tick < STOPPING_TICKS or state.output != ZERO:
        return state
    latched = why.latching(state.causes)
    return replace(
        state, mode="latched" if latched else "idle", causes=latched or now, commander=""
    )


def _waiting(config: GateConfig, state: GateState, now: tuple[Cause, ...]) -> GateState:
    """Idle or latched."""
    latched = _merge(why.latching(state.causes), why.latching(now))
    if latched:
        return replace(state, mode="latched", causes=latched)
    if config.auto_resume and min(state.healthy_ticks, state.still_ticks) >= HEALTHY_TICKS:
        return _enabled(state, BRAIN)
    boot = (why.BOOT,) if state.mode == "latched" else ()
    return replace(state, causes=_merge(boot, now))


def _enabled(state: GateState, source: str) -> GateState:
    return replace(
        state,
        mode="enabled",
        causes=(),
        commander=source,
        enables=state.enables + 1,
        command=None,
        command_tick=state.tick,
        last_seq=-1,
        nan_ticks=(),
    )


def _output(config: GateConfig, state: GateState) -> Velocity:
    """What the body is told in this tick; the same however often it is asked within one tick."""
    if state.mode in ("latched", "idle"):
        return ZERO
    target = ZERO
    if state.mode == "enabled" and state.command:
        asked = state.command
        caps = state.safety.caps if state.safety else NO_CAPS
        target = clamp(
            Velocity(linear_x=asked.linear_x, linear_y=asked.linear_y, angular_z=asked.angular_z),
            config.limits,
            caps,
        )
    return ramp(state.before, target, config.limits, TICK_S)


def _command(config: GateConfig, state: GateState, event: Command) -> tuple[GateState, Outcome]:
    command = event.command
    refused = _refusal(state, command, event.wall_ns)
    if refused:
        return state, Outcome(refused=refused, ok=False)
    if command.source == BRAIN:
        state = replace(state, heard=command, heard_tick=state.tick)
    if state.mode != "enabled":
        return state, Outcome(refused="not_enabled", ok=False)
    if command.source != state.commander:
        return state, Outcome(refused="commander", ok=False)
    if command.seq <= state.last_seq:
        return state, Outcome(refused="seq", ok=False)
    state = replace(state, command=command, command_tick=state.tick, last_seq=command.seq)
    return replace(state, output=_output(config, state)), Outcome()


def _refusal(state: GateState, command: CmdVel, wall_ns: int | None) -> str:
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


def _not_finite(state: GateState, event: NotFinite) -> tuple[GateState, Outcome]:
    """Zero at once when it comes from the commander; from anybody else it is only counted."""
    if event.boot != state.boot or not state.commander or event.source != state.commander:
        return state, Outcome(refused="not_finite", ok=False)
    recent = (*(t for t in state.nan_ticks if state.tick - t < NAN_STORM_TICKS), state.tick)
    cause = why.NAN_STORM if len(recent) >= NAN_STORM_COUNT else why.NOT_FINITE
    if state.mode == "enabled":
        state = _stop(state, ())
    state = replace(
        state,
        nan_ticks=recent,
        causes=_merge(state.causes, (cause,)),
        before=ZERO,
        output=ZERO,
    )
    return state, Outcome(refused="not_finite", ok=False)


def _safety(config: GateConfig, state: GateState, said: SafetyState) -> GateState:
    if said.boot != state.boot or said.tick > state.tick:
        return state
    if state.safety and said.tick < state.safety.tick:
        return state
    state = replace(state, safety=said)
    return replace(state, output=_output(config, state))


def _estop(state: GateState, event: Estop) -> tuple[GateState, Outcome]:
    generation = state.estop_generation + 1
    state = replace(
        state,
        mode="latched",
        causes=_merge(why.latching(state.causes), (why.estop(event.source),)),
        estop_generation=generation,
        commander="",
        command=None,
        before=ZERO,
        output=ZERO,
    )
    return state, Outcome(text=f"stopped and latched; e-stop number {generation}")


def _release(state: GateState, event: Release) -> tuple[GateState, Outcome]:
    if state.mode != "latched":
        return state, Outcome(text="not latched, nothing to release")
    if event.estop_generation != state.estop_generation:
        newest = state.estop_generation
        return _no(state, f"e-stop number {newest} is the newest; look at it before you release")
    if state.still_ticks < STILL_TICKS:
        return _no(state, "the body is not at rest yet; wait half a second")
    held = why.latching(state.safety.causes) if state.safety else ()
    if held:
        return _no(state, f"what latched it still holds: {why.in_words(held)}")
    return replace(state, mode="idle", causes=()), Outcome(text="released; enable it to move")


def _enable(config: GateConfig, state: GateState, event: Enable) -> tuple[GateState, Outcome]:
    if state.mode == "latched":
        return _no(state, f"latched: {why.in_words(state.causes)}; release it first")
    if state.mode == "stopping":
        return _no(state, "still stopping; try again when it is idle")
    if state.commander and state.commander != event.source and not event.take:
        return _no(state, f"{state.commander} drives; take it over with take=true")
    idle = replace(state, mode="idle", commander="")
    against = _conditions(config, idle, event.source, None)
    if against:
        return _no(state, f"not now: {why.in_words(against)}")
    return _enabled(state, event.source), Outcome(text=f"{event.source} drives")


def _no(state: GateState, text: str) -> tuple[GateState, Outcome]:
    return state, Outcome(ok=False, text=text)


def _merge(known: tuple[Cause, ...], more: tuple[Cause, ...]) -> tuple[Cause, ...]:
    codes = {cause.code for cause in known}
    return known + tuple(cause for cause in more if cause.code not in codes)
