"""Control: what decision or an operator wants becomes smooth commands that the body can follow."""

from collections.abc import Callable

import msgspec
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS, Message, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel, Intent, Twist
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_schemas.topics import BODY, CMD_VEL, INTENT, SAFETY, STATE, TELEOP
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.gate import BRAIN
from gigabrain_zenoh.limits import NO_CAPS, ZERO, clamp, limits_of, ramp

TICK_S = TICK_NS / 1e9
LONGEST_STEP_TICKS = 5  # after a gap the ramp goes on as if no more than this had passed
STEADY_TICKS = 10  # the measured speed has caught up with a constant setpoint by then
SLOW_LINEAR, SLOW_ANGULAR = 0.05, 0.1  # [m/s], [rad/s]; below, encoders say little
TELEOP_GAP_NS = 200_000_000
TELEOP_DEAF_NS = 500_000_000


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
    steady_ticks: int = 0
    gain_x: float = 1.0  # commanded over measured speed, learnt while driving steadily
    gain_z: float = 1.0
    basis: int = 0
    holding: bool = False  # an operator has driven and has not handed back yet
    enables: int = 0  # the gate's count when the body was last handed over


def step(body: BodyDescription, memory: Memory, inputs: Inputs) -> tuple[Memory, CmdVel]:
    """One command. Asked twice within a tick, it starts from the same setpoint both times."""
    state = inputs.state
    memory = _next_tick(body, memory, state)
    if inputs.intent:
        memory = replace(memory, basis=max(memory.basis, inputs.intent.basis))
    if state.gate.mode != "enabled" or state.gate.commander != BRAIN:
        return _at_rest(memory), _command(ZERO)
    if state.gate.enables != memory.enables:  # whoever enables hands back to decision
        memory = replace(memory, enables=state.gate.enables, holding=False)
    if inputs.teleop:
        memory = replace(memory, holding=True, basis=state.tick)  # resting on the operator's eyes
    target = clamp(_target(memory, inputs), limits_of(body), inputs.caps)
    setpoint = ramp(memory.before, target, limits_of(body), TICK_S * memory.elapsed_ticks)
    memory = replace(memory, setpoint=setpoint)
    return memory, _command(_corrected(body, memory))


def _next_tick(body: BodyDescription, memory: Memory, state: RobotState) -> Memory:
    """Move on to the tick of `state`, learning from how well the body followed."""
    if state.boot != memory.boot:
        return Memory(boot=state.boot, tick=state.tick)
    if state.tick == memory.tick:
        return memory
    steady = memory.steady_ticks + 1 if memory.setpoint == memory.before else 0
    gain_x, gain_z = memory.gain_x, memory.gain_z
    if steady >= STEADY_TICKS:
        gains, asked, got = body.control, memory.setpoint, state.velocity
        most = gains.max_correction
        if abs(asked.linear_x) > SLOW_LINEAR:
            error = 1.0 - got.linear_x / asked.linear_x
            gain_x = _bounded(gain_x + gains.linear_integral * TICK_S * error, most)
        if abs(asked.angular_z) > SLOW_ANGULAR:
            error = 1.0 - got.angular_z / asked.angular_z
            gain_z = _bounded(gain_z + gains.angular_integral * TICK_S * error, most)
    return replace(
        memory,
        tick=state.tick,
        elapsed_ticks=min(state.tick - memory.tick, LONGEST_STEP_TICKS),
        before=memory.setpoint,
        steady_ticks=steady,
        gain_x=gain_x,
        gain_z=gain_z,
    )


def _at_rest(memory: Memory) -> Memory:
    """While the gate is shut nothing is learnt, and the first command after it opens is zero."""
    return replace(memory, before=ZERO, setpoint=ZERO, steady_ticks=0, gain_x=1.0, gain_z=1.0)


def _bounded(gain: float, most: float) -> float:
    return max(1.0 - most, min(1.0 + most, gain))


def _target(memory: Memory, inputs: Inputs) -> Velocity:
    if inputs.teleop:
        return inputs.teleop
    if memory.holding or inputs.intent is None or inputs.intent.twist is None:
        return ZERO
    return inputs.intent.twist


def _corrected(body: BodyDescription, memory: Memory) -> Velocity:
    """The setpoint times what the body has been found to need."""
    asked = memory.setpoint
    wanted = replace(
        asked, linear_x=asked.linear_x * memory.gain_x, angular_z=asked.angular_z * memory.gain_z
    )
    return clamp(wanted, limits_of(body))


def _command(velocity: Velocity) -> CmdVel:
    return CmdVel(
        linear_x=velocity.linear_x,
        linear_y=velocity.linear_y,
        angular_z=velocity.angular_z,
        source=BRAIN,
    )


class Teleop:
    """An operator's stream, trusted only while it is plainly live.

    A network that was cut hands over what it had stored when it heals: after a gap nothing is
    believed for half a second. A real body wants the newest tick echoed as well.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._newest: Twist | None = None
        self._arrived_ns = -(1 << 62)
        self._trusted_from_ns = 0

    def receive(self, twist: Twist) -> None:
        """Take one message."""
        now = self._now_ns()
        if now - self._arrived_ns > TELEOP_GAP_NS:
            self._trusted_from_ns = now + TELEOP_DEAF_NS
        self._newest, self._arrived_ns = twist, now

    def velocity(self, state: RobotState, echo_wanted: bool) -> Velocity | None:
        """What the operator wants now, or None when nobody steers."""
        now, twist = self._now_ns(), self._newest
        if twist is None or now - self._arrived_ns > TELEOP_GAP_NS or now < self._trusted_from_ns:
            return None
        late_ns = (state.tick - twist.tick) * TICK_NS
        if (echo_wanted or twist.boot) and (twist.boot != state.boot or late_ns > TELEOP_GAP_NS):
            return None
        return Velocity(linear_x=twist.linear_x, linear_y=twist.linear_y, angular_z=twist.angular_z)


async def run(bus: Bus, ready: Callable[[], None]) -> None:
    """A command per state, and at once when decision has thought again."""
    memory = Memory()
    teleop = Teleop(bus.clock.now_ns)

    def act(_: Message) -> None:
        nonlocal memory
        state, body = states.fresh(), bodies.current
        if state is None or body is None:
            return
        verdict = safety.fresh()
        inputs = Inputs(
            state=state,
            intent=intents.fresh(),
            teleop=teleop.velocity(state, echo_wanted=body.link == "real"),
            caps=verdict.caps if verdict else NO_CAPS,
        )
        memory, command = step(body.description, memory, inputs)
        bus.publish(CMD_VEL, command, basis=memory.basis)

    def think_again(intent: Intent) -> None:
        # an intent of a tick whose state is still on its way waits for that state
        if intent.basis > memory.basis and intent.tick <= bus.time.tick:
            act(intent)

    bodies = bus.latest(BODY)
    states = bus.latest(STATE, act)
    intents = bus.latest(INTENT, think_again)
    safety = bus.latest(SAFETY)
    bus.latest(TELEOP, teleop.receive)
    ready()
    await bus.failed
