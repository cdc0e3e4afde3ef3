"""Control: what decision or an operator wants becomes smooth commands that the body can follow."""

import logging
from collections.abc import Callable

import msgspec
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_S, Message, Velocity
from gigabrain_schemas.body import BodyDescription, ControlGains, RobotState
from gigabrain_schemas.brain import CmdVel, Intent
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.topics import BODY, INTENT, SAFETY, STATE, TELEOP, command_topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import PreviousTick
from gigabrain_zenoh.control.teleop import Teleop
from gigabrain_zenoh.control.tracking import LONGEST_DELAY_TICKS, undone, wanted
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.geometry.limits import NO_CAPS, ZERO, clamp, limits_of, ramp
from gigabrain_zenoh.geometry.pose import PoseHistory
from gigabrain_zenoh.runtime.heartbeat import Progress

log = logging.getLogger(__name__)

LONGEST_STEP_TICKS = 5  # after a gap the ramp goes on as if no more than this had passed
STEADY_TICKS = 10  # the measured speed has caught up with a constant setpoint by then
SLOW_LINEAR, SLOW_ANGULAR = 0.05, 0.1  # [m/s], [rad/s]; below, encoders say little


class Inputs(msgspec.Struct, frozen=True, kw_only=True):
    """What control goes by. None stands for stale, missing and malformed alike."""

    state: RobotState
    intent: Intent | None = None
    teleop: Velocity | None = None  # only while the operator's stream can be trusted
    caps: SpeedCaps = NO_CAPS


class Memory(msgspec.Struct, frozen=True, kw_only=True):
    """What control remembers from tick to tick."""

    boot: int = 0
    tick: int = 0
    elapsed_ticks: int = 1  # since the tick before
    before: Velocity = ZERO  # setpoint of the tick before
    setpoint: Velocity = ZERO
    wanted: Velocity = ZERO  # the setpoint times what the body needs
    allowed: Velocity = ZERO  # as much of that as limits and caps let through
    steady_ticks: int = 0
    gain_x: float = 1.0  # commanded over measured speed, learnt while driving steadily
    gain_z: float = 1.0
    basis: int = 0
    opened: int = 0  # the tick in which the gate opened; 0 while it is shut
    holding: bool = False  # an operator has driven and has not handed back yet
    enables: int = 0  # the gate's count when the body was last handed over
    told: tuple[Velocity, ...] = ()  # setpoints of the ticks before, the newest last
    history: PoseHistory = PoseHistory()
    off_track: bool = False  # the body is too far from the trajectory that it should follow


def step(body: BodyDescription, memory: Memory, inputs: Inputs) -> tuple[Memory, CmdVel]:
    """One command. Asked again within a tick, it starts from the same setpoint every time."""
    state, intent = inputs.state, inputs.intent
    memory = _next_tick(body, memory, state)
    if intent and intent.basis > state.tick:
        intent = None  # it rests on what has not happened yet
    if intent:
        memory = replace(memory, basis=max(memory.basis, intent.basis))
    if state.gate.mode != "enabled" or state.gate.commander != BRAIN:
        return _at_rest(memory), _command(ZERO)
    if state.gate.enables != memory.enables:  # whoever enables hands back to decision
        memory = replace(memory, enables=state.gate.enables, holding=False)
    if inputs.teleop:
        memory = replace(memory, holding=True, basis=state.tick)  # resting on the operator's eyes
    memory = replace(memory, opened=memory.opened or state.tick)
    limits = limits_of(body)
    memory, wish = _wish(body, memory, inputs, intent)
    target = clamp(wish, limits, inputs.caps)
    setpoint = ramp(memory.before, target, limits, TICK_S * memory.elapsed_ticks)
    if memory.opened == state.tick:  # the first command after enabling is zero
        setpoint = ZERO
    gain_z = memory.gain_z
    if intent and _follows(memory, intent, inputs.teleop):  # decision knows how the body turns
        gain_z, memory = undone(intent.response.turn_gain), replace(memory, steady_ticks=0)
    needed = replace(
        setpoint,
        linear_x=setpoint.linear_x * memory.gain_x,
        angular_z=setpoint.angular_z * gain_z,
    )
    allowed = clamp(needed, limits, inputs.caps)
    memory = replace(memory, setpoint=setpoint, wanted=needed, allowed=allowed)
    return memory, _command(clamp(needed, limits), operator=memory.holding)


def _next_tick(body: BodyDescription, memory: Memory, state: RobotState) -> Memory:
    """Move on to the tick of `state`, learning from how well the body followed."""
    if state.boot != memory.boot:
        return Memory(boot=state.boot, tick=state.tick, history=memory.history.then(state))
    if state.tick == memory.tick:
        return memory
    steady = memory.steady_ticks + 1 if memory.setpoint == memory.before else 0
    if steady >= STEADY_TICKS:
        memory = _learn(body.control, memory, state.velocity)
    passed = state.tick - memory.tick
    told = (*memory.told, *(memory.setpoint,) * min(passed, LONGEST_DELAY_TICKS))
    return replace(
        memory,
        tick=state.tick,
        elapsed_ticks=min(passed, LONGEST_STEP_TICKS),
        before=memory.setpoint,
        steady_ticks=steady,
        told=told[-LONGEST_DELAY_TICKS:],
        history=memory.history.then(state),
    )


def _learn(gains: ControlGains, memory: Memory, measured: Velocity) -> Memory:
    """Correct both gains by how far the measured speed is off the setpoint.

    Where a limit or a cap has held the command back nothing can be learnt from a body too slow.
    """
    asked, wanted, allowed = memory.setpoint, memory.wanted, memory.allowed
    gain_x, gain_z = memory.gain_x, memory.gain_z
    if abs(asked.linear_x) > SLOW_LINEAR:
        error = 1.0 - measured.linear_x / asked.linear_x
        if error < 0 or allowed.linear_x == wanted.linear_x:
            gain_x += gains.linear_integral * TICK_S * error
    if abs(asked.angular_z) > SLOW_ANGULAR:
        error = 1.0 - measured.angular_z / asked.angular_z
        if error < 0 or allowed.angular_z == wanted.angular_z:
            gain_z += gains.angular_integral * TICK_S * error
    least, most = 1.0 - gains.max_correction, 1.0 + gains.max_correction
    return replace(
        memory,
        gain_x=max(least, min(most, gain_x)),
        gain_z=max(least, min(most, gain_z)),
    )


def _at_rest(memory: Memory) -> Memory:
    """While the gate is shut nothing is learnt, and what was learnt is forgotten."""
    return Memory(
        boot=memory.boot,
        tick=memory.tick,
        basis=memory.basis,
        holding=memory.holding,
        enables=memory.enables,
        history=memory.history,
    )


def _follows(memory: Memory, intent: Intent, teleop: Velocity | None) -> bool:
    return intent.follow and not teleop and not memory.holding


def _wish(
    body: BodyDescription, memory: Memory, inputs: Inputs, intent: Intent | None
) -> tuple[Memory, Velocity]:
    """Where to: what the operator wants, else what decision wants, else nowhere."""
    state, teleop = inputs.state, inputs.teleop
    if intent and _follows(memory, intent, teleop):
        start = memory.history.at(state.boot, intent.basis)
        if start is None:
            return memory, ZERO
        told, velocity = memory.told, state.velocity
        wish = wanted(body, intent, state.tick, start, state.pose, velocity, told)
        return replace(memory, off_track=wish is None), wish or ZERO
    memory = replace(memory, off_track=False)
    if teleop:
        return memory, teleop
    if memory.holding or intent is None or intent.twist is None:
        return memory, ZERO
    return memory, intent.twist


def _command(velocity: Velocity, *, operator: bool = False) -> CmdVel:
    return CmdVel(
        linear_x=velocity.linear_x,
        linear_y=velocity.linear_y,
        angular_z=velocity.angular_z,
        source=BRAIN,
        operator=operator,
    )


def _tell(tick: int, *, lost: bool) -> None:
    data = {"event": "off_track" if lost else "on_track", "tick": tick}
    if lost:
        log.warning("braking: too far off the trajectory", extra={"data": data})
    else:
        log.info("on the trajectory again", extra={"data": data})


class EarlierCaps:
    """The speed caps that safety gave before a tick.

    Within the tick it must not matter whether safety's verdict or decision's intent is quicker. The
    gate obeys a verdict at once; control, which only has to plan for it, obeys from the next tick.
    """

    def __init__(self) -> None:
        self._verdicts: PreviousTick[SafetyState] = PreviousTick()

    def receive(self, verdict: SafetyState) -> None:
        """Take one verdict."""
        self._verdicts.receive(verdict)

    def at(self, state: RobotState) -> SpeedCaps:
        """The caps that hold throughout the tick of `state`."""
        verdict = self._verdicts.at(state.boot, state.tick, SAFETY.stale_after_ns)
        return verdict.caps if verdict else NO_CAPS  # without one the gate lets nothing through


async def run(bus: Bus, ready: Callable[[], None]) -> None:
    """A command at the body's rate, and at once when decision has thought again."""
    memory, lost, commands = Memory(), False, 0
    teleop, caps = Teleop(bus.clock.now_ns), EarlierCaps()

    def act(_: Message) -> None:
        nonlocal memory, lost, commands
        state, body = states.fresh(), bodies.current
        if state is None or body is None:
            return
        inputs = Inputs(
            state=state,
            intent=intents.fresh(),
            teleop=teleop.velocity(state, echo_wanted=body.link == "real"),
            caps=caps.at(state),
        )
        before = memory.basis
        memory, command = step(body.description, memory, inputs)
        if memory.off_track != lost:
            lost = memory.off_track
            _tell(state.tick, lost=lost)
        due = state.tick % body.description.control.period_ticks == 0
        if due or memory.basis != before:
            bus.publish(command_topic(body.description), command, basis=memory.basis)
            commands += 1

    def came() -> tuple[object, ...]:
        return (bus.arrived.get(STATE.key),) if bodies.current else ()

    def think_again(intent: Intent) -> None:
        # an intent of a tick whose state is still on its way waits for that state
        if intent.basis > memory.basis and intent.tick <= bus.time.tick:
            act(intent)

    bodies = bus.latest(BODY)
    states = bus.latest(STATE, act)
    intents = bus.latest(INTENT, think_again)
    bus.latest(SAFETY, caps.receive)
    bus.latest(TELEOP, teleop.receive)
    bus.progress = Progress(came, lambda: commands)
    ready()
    await bus.failed
