"""The safety process: a verdict per scan and per second state, and at once when it changes."""

import logging
from collections.abc import Callable

from gigabrain_schemas.base import Cause, Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import SAFETY, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.gate.causes import in_words
from gigabrain_zenoh.geometry.stopping import REPEAT_TICKS
from gigabrain_zenoh.host.run_folders import state_dir
from gigabrain_zenoh.runtime.heartbeat import Progress
from gigabrain_zenoh.safety.host import HostWatch, Look
from gigabrain_zenoh.safety.senses import Senses
from gigabrain_zenoh.safety.step import Memory, step

log = logging.getLogger("gigabrain_zenoh.safety")


async def run(bus: Bus, ready: Callable[[], None], look: Look | None = None) -> None:
    """Judge until the process ends; `look` tells of the computer, this one unless it is given."""
    memory, said, said_tick = Memory(), SafetyState(verdict="stop"), 0

    def judge(_: Message) -> None:
        nonlocal memory, said, said_tick
        body = senses.bodies.current
        inputs = senses.inputs(body.description) if body else None
        if body is None or inputs is None:
            return
        before, state = memory, inputs.state
        memory, verdict = step(body.description, memory, inputs)
        due = state.tick - said_tick >= REPEAT_TICKS or state.boot != before.boot
        new = memory.field.basis != before.field.basis
        if due or new or _differs(verdict, said):
            _tell(state, said, verdict)
            basis = memory.field.basis
            said, said_tick = bus.publish(SAFETY, verdict, basis=basis), state.tick

    def came() -> tuple[object, ...]:
        return (bus.arrived.get(STATE.key),) if senses.bodies.current else ()

    senses = Senses(bus, judge, look or HostWatch(state_dir()).now)
    bus.progress = Progress(came, lambda: bus.sent[SAFETY.key])
    ready()
    await bus.failed


def _differs(now: SafetyState, before: SafetyState) -> bool:
    return (now.causes, now.caps) != (before.causes, before.caps)


def _tell(state: RobotState, before: SafetyState, now: SafetyState) -> None:
    """Log each cause and warning once when it begins and once when it ends.

    Not while all is starting.
    """
    if not state.gate.enables:
        return
    level = logging.WARNING if now.verdict == "stop" else logging.INFO
    if fresh := _missing(now.causes, before.causes):
        _log(level, f"{now.verdict}: {in_words(fresh)}", "held back", fresh)
    if fresh := _missing(now.warnings, before.warnings):
        _log(logging.WARNING, f"warning: {in_words(fresh)}", "warned", fresh)
    over = _missing((*before.causes, *before.warnings), (*now.causes, *now.warnings))
    if over:
        _log(logging.INFO, f"over: {'; '.join(cause.text for cause in over)}", "over", over)


def _missing(causes: tuple[Cause, ...], known: tuple[Cause, ...]) -> tuple[Cause, ...]:
    codes = {cause.code for cause in known}
    return tuple(cause for cause in causes if cause.code not in codes)


def _log(level: int, text: str, event: str, causes: tuple[Cause, ...]) -> None:
    data = {"event": event, "causes": ",".join(cause.code for cause in causes)}
    log.log(level, "%s", text, extra={"data": data})
