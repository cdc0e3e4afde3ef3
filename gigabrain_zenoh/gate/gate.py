"""The gate: the only way for a command to the body. A pure function, no I/O, no clock.

    latched ──release──► idle ──enable──► enabled ──any cause──► stopping ──► idle or latched

`step(config, state, event) -> (state, outcome)`. Its time is the robot's tick (20 ms). Except in
lock-step, events carry wall time as well. Both then limit the age of an echoed tick.
"""

from msgspec.structs import replace

from gigabrain_schemas.base import TICK_S, Cause, Velocity
from gigabrain_schemas.body import GateMode
from gigabrain_schemas.brain import CmdVel, JointCommand
from gigabrain_schemas.safety import SafetyState
from gigabrain_zenoh.gate import causes as why
from gigabrain_zenoh.gate import joints
from gigabrain_zenoh.gate.state import (
    BRAIN,
    ISSUED_TICKS,
    SILENCE_TICKS,
    Enable,
    Estop,
    Event,
    GateConfig,
    GateState,
    JointsCommand,
    NotFinite,
    Outcome,
    Release,
    Safety,
    Tick,
    VelocityCommand,
    age_ns,
    is_finite,
    refusal,
    status,
    stop_reasons,
)
from gigabrain_zenoh.geometry.joints import joints_at_rest
from gigabrain_zenoh.geometry.limits import ZERO, at_rest, clamp, ramp, slowed

STILL_TICKS = 25  # 0.5 s at rest before a release


def estop(state: GateState, event: Estop) -> tuple[GateState, Outcome]:
    """Stop at once and latch, from any mode."""
    generation = state.estop_generation + 1
    state = replace(
        state,
        mode="latched",
        causes=why.merge(why.latching(state.causes), (why.estop(event.source),)),
        estop_generation=generation,
        commander="",
        before=ZERO,
    )
    return state, Outcome(text=f"stopped and latched; e-stop number {generation}")


def release(state: GateState, event: Release) -> tuple[GateState, Outcome]:
    """Release the latch, if the body rests and no latching cause remains."""
    if state.mode == "stopping":
        return rejected(state, "still stopping; try again when the body is at rest")
    if state.mode != "latched":
        return state, Outcome(text="not latched, nothing to release")
    if event.estop_generation != state.estop_generation:
        newest = state.estop_generation
        return rejected(
            state, f"wrong e-stop number, the newest is {newest}; check its cause, then release"
        )
    if state.still_ticks < STILL_TICKS:
        return rejected(state, "the body is not at rest yet; wait half a second")
    remaining = why.latching(state.faults + (state.safety.causes if state.safety else ()))
    if remaining:
        return rejected(state, f"the cause is still present: {why.in_words(remaining)}")
    by_hand = bool(why.latching(state.causes))
    state = replace(state, mode="idle", causes=(), by_hand=by_hand)
    return state, Outcome(text="released; enable it to move")


def rejected(state: GateState, text: str) -> tuple[GateState, Outcome]:
    """Return the outcome of a rejected request, with the reason."""
    return state, Outcome(ok=False, text=text)


__all__ = [
    "BRAIN",
    "Enable",
    "Estop",
    "Event",
    "GateConfig",
    "GateState",
    "JointsCommand",
    "NotFinite",
    "Outcome",
    "Release",
    "Safety",
    "Tick",
    "VelocityCommand",
    "age_ns",
    "status",
    "step",
]
STOPPING_TICKS = 15  # 300 ms, then idle
CALM_TICKS = 5  # 100 ms at zero after an enable, even if a joystick is held
HEALTHY_TICKS = 25  # 0.5 s without a cause before an automatic resume
RESUME_TICKS = 110  # from an enable to an automatic resume: starts and stops stay below 1 Hz
NAN_STORM_COUNT, NAN_STORM_TICKS = 5, 50  # five within a second


def step(config: GateConfig, state: GateState, event: Event) -> tuple[GateState, Outcome]:
    """Process one event. The new state decides whether the body may move, and how fast."""
    after, outcome = _handle(config, state, event)
    if after is state:
        return state, outcome
    if after.mode == "enabled":
        reasons = stop_reasons(config, after, after.commander)
        after = _stop(after, reasons) if reasons else after
    if after.mode == "latched" and state.mode != "latched":
        after = replace(after, latches=state.latches + 1)
    goals = joints.output(config, after, _just_enabled(after))
    return replace(after, output=_output(config, after), joints=goals), outcome


def _handle(config: GateConfig, state: GateState, event: Event) -> tuple[GateState, Outcome]:
    match event:
        case Tick():
            return _tick(config, state, event), Outcome()
        case VelocityCommand():
            return _command(config, state, event)
        case JointsCommand():
            return _command(config, state, event)
        case NotFinite():
            return _not_finite(state, event)
        case Safety():
            return _safety(state, event.state), Outcome()
        case Release():
            return release(state, event)
        case Enable():
            return _enable(config, state, event)
        case _:
            return estop(state, event)


def _tick(config: GateConfig, state: GateState, event: Tick) -> GateState:
    issued = () if event.wall_ns is None else (*state.issued_ns, event.wall_ns)
    state = replace(
        state,
        tick=state.tick + 1,
        issued_ns=issued[-ISSUED_TICKS:],
        faults=event.faults,
        still_ticks=state.still_ticks + 1 if _is_at_rest(event) else 0,
        late=event.late,
        before=state.output,
        joints_before=joints.before(state, event),
    )
    if state.mode == "enabled":
        return state
    present = stop_reasons(config, state, BRAIN)
    state = replace(state, healthy_ticks=0 if present else state.healthy_ticks + 1)
    if state.mode == "stopping":
        return _continue_stopping(state, present)
    return _wait(config, state, present)


def _is_at_rest(event: Tick) -> bool:
    return at_rest(event.measured) and joints_at_rest(event.joints)


def _stop(state: GateState, reasons: tuple[Cause, ...]) -> GateState:
    return replace(state, mode="stopping", causes=reasons, stopped_tick=state.tick, healthy_ticks=0)


def _continue_stopping(state: GateState, present: tuple[Cause, ...]) -> GateState:
    """Continue stopping. The commander must be enabled again afterwards."""
    state = replace(state, causes=why.merge(state.causes, why.latching(present)))
    if state.tick - state.stopped_tick < STOPPING_TICKS or state.before != ZERO:
        return state
    if any(joint.velocity for joint in state.joints_before):
        return state
    remaining = why.latching(state.causes)
    mode: GateMode = "latched" if remaining else "idle"
    return replace(state, mode=mode, causes=remaining or present, commander="")


def _wait(config: GateConfig, state: GateState, present: tuple[Cause, ...]) -> GateState:
    """Advance a tick while idle or latched."""
    remaining = why.merge(why.latching(state.causes), why.latching(present))
    if remaining:
        return replace(state, mode="latched", causes=remaining)
    healthy = min(state.healthy_ticks, state.still_ticks) >= HEALTHY_TICKS
    due = state.tick - state.enabled_tick >= RESUME_TICKS
    if config.auto_resume and not state.by_hand and healthy and due:
        return _enabled(state, BRAIN)
    boot = (why.BOOT,) if state.mode == "latched" else ()
    return replace(state, causes=boot + present)


def _enabled(state: GateState, source: str) -> GateState:
    return replace(
        state,
        mode="enabled",
        causes=(),
        by_hand=False,
        commander=source,
        enables=state.enables + 1,
        enabled_tick=state.tick,
        command=None,
        command_tick=state.tick,
        next_seq=0,
        joint_command=None,
        joint_tick=state.tick,
        next_joint_seq=0,
    )


def _output(config: GateConfig, state: GateState) -> Velocity:
    """Return the output: one ramp step from the output of the last tick.

    Missed ticks are processed in a burst. A stop then takes all of their steps, but the body must
    not gain speed by several steps at once.
    """
    if state.mode in ("latched", "idle"):
        return ZERO
    target, command = ZERO, state.command
    live = command and state.tick - state.command_tick <= SILENCE_TICKS
    if state.mode == "enabled" and command and live and state.safety and not _just_enabled(state):
        target = clamp(
            Velocity(
                linear_x=command.linear_x, linear_y=command.linear_y, angular_z=command.angular_z
            ),
            config.limits,
            state.safety.caps,
        )
    change = slowed if state.late else ramp
    return change(state.before, target, config.limits, TICK_S)


def _just_enabled(state: GateState) -> bool:
    """Return whether the body must wait at rest after an enable."""
    return state.tick - state.enabled_tick < CALM_TICKS


def _command(
    config: GateConfig, state: GateState, event: VelocityCommand | JointsCommand
) -> tuple[GateState, Outcome]:
    command = event.command
    if not is_finite(command):
        return _not_finite(state, NotFinite(command.source, command.boot))
    refused = refusal(state, command, event.wall_ns)
    if not refused and isinstance(command, JointCommand):
        refused = joints.refusal(config, state, command)
    if refused:
        return state, Outcome(refused=refused, ok=False)
    if command.source == BRAIN:
        state = replace(state, brain_command=command, brain_tick=state.tick)
    if state.mode != "enabled":
        return state, Outcome(refused="not_enabled", ok=False)
    if command.source != state.commander:
        return state, Outcome(refused="commander", ok=False)
    if command.seq < _next_seq(state, command):
        return state, Outcome(refused="seq", ok=False)
    return _obey(state, command), Outcome()


def _next_seq(state: GateState, command: CmdVel | JointCommand) -> int:
    return state.next_joint_seq if isinstance(command, JointCommand) else state.next_seq


def _obey(state: GateState, command: CmdVel | JointCommand) -> GateState:
    """Make `command` the current one."""
    next_seq = command.seq + 1
    if isinstance(command, JointCommand):
        return replace(state, joint_command=command, joint_tick=state.tick, next_joint_seq=next_seq)
    return replace(state, command=command, command_tick=state.tick, next_seq=next_seq)


def _not_finite(state: GateState, event: NotFinite) -> tuple[GateState, Outcome]:
    """Stop at once if the commander sent it. Latch if it goes on, even after losing command."""
    refused = Outcome(refused="not_finite", ok=False)
    sender = state.commander or state.nan_source
    if event.boot != state.boot or not sender or event.source != sender or state.mode == "latched":
        return state, refused
    before = state.nan_ticks if event.source == state.nan_source else ()
    recent = (*(t for t in before if state.tick - t < NAN_STORM_TICKS), state.tick)
    cause = why.NAN_STORM if len(recent) >= NAN_STORM_COUNT else why.NOT_FINITE
    causes = why.merge(state.causes, (cause,))
    if state.mode == "enabled":
        state = _stop(state, causes)
    else:  # while idle it latches at once: an enable would forget the causes
        latches = state.mode == "idle" and why.latching(causes)
        state = replace(state, causes=causes, mode="latched" if latches else state.mode)
    state = replace(state, nan_ticks=recent, nan_source=event.source)
    return replace(state, healthy_ticks=0, before=ZERO), refused


def _safety(state: GateState, verdict: SafetyState) -> GateState:
    if verdict.boot != state.boot or verdict.tick > state.tick:
        return state
    if state.safety and verdict.tick < state.safety.tick:
        return state
    return replace(state, safety=verdict)


def _enable(config: GateConfig, state: GateState, event: Enable) -> tuple[GateState, Outcome]:
    if not event.source:
        return rejected(state, "the source is empty; name the commander")
    if state.mode == "latched":
        return rejected(state, f"latched: {why.in_words(state.causes)}; release it first")
    if state.mode == "stopping":
        return rejected(state, "still stopping; try again when it is idle")
    if state.commander not in ("", event.source):
        if not event.take:
            return rejected(
                state, f"{state.commander} drives; take it over with --take (in a script take=True)"
            )
        if event.source == BRAIN and event.by in ("", BRAIN):
            return rejected(state, f"{state.commander} drives; only a person can enable the brain")
    reasons = stop_reasons(config, state, event.source)
    if reasons:
        return rejected(state, f"not now: {why.in_words(reasons)}")
    granted = Outcome(text=f"{event.source} drives")
    if state.commander == event.source:  # no new start: an enable is not a command
        return replace(state, enables=state.enables + 1), granted
    return _enabled(state, event.source), granted
