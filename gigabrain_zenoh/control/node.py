"""Control node: turns intents, or an operator's velocities, into commands the body can follow."""

import asyncio
import logging
from collections.abc import Callable

import msgspec
from msgspec import structs
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS, TICK_S, Message, Velocity
from gigabrain_schemas.body import Body, BodyDescription, ControlGains, RobotState
from gigabrain_schemas.brain import CmdVel, Intent, JointCommand, JointSpeeds
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.topics import (
    BODY,
    INTENT,
    JOINT_CMD,
    JOINT_TELEOP,
    SAFETY,
    STATE,
    TELEOP,
    command_topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import PreviousTick
from gigabrain_zenoh.control.joints import JointInputs, JointMemory, between, step_joints
from gigabrain_zenoh.control.teleop import OperatorStream, Teleop
from gigabrain_zenoh.control.tracking import (
    MAX_DELAY_TICKS,
    track,
    turn_correction,
    within_turning_circle,
)
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry import joint_ramp
from gigabrain_zenoh.geometry.limits import NO_CAPS, ZERO, clamp, limits_of, ramp
from gigabrain_zenoh.geometry.pose import PoseHistory
from gigabrain_zenoh.runtime.heartbeat import Progress

log = logging.getLogger(__name__)

MAX_RAMP_TICKS = 5  # longest step of the ramp, also after a gap
STEADY_TICKS = 10  # the measured speed reaches a constant setpoint within this time
INTENT_TICKS = 2  # maximum age for joints: an arm rests within 120 ms of its last intent
MIN_LEARN_LINEAR, MIN_LEARN_ANGULAR = 0.05, 0.1  # [m/s], [rad/s]; below, encoders are too coarse


class ControlInputs(msgspec.Struct, frozen=True, kw_only=True):
    """Inputs of one command; None if stale, missing or malformed."""

    state: RobotState
    intent: Intent | None = None
    teleop: Velocity | None = None  # while the operator's stream is live
    caps: SpeedCaps = NO_CAPS


class ControlMemory(msgspec.Struct, frozen=True, kw_only=True):
    """State from tick to tick."""

    boot: int = 0
    tick: int = 0
    elapsed_ticks: int = 1  # since the previous state
    before: Velocity = ZERO  # setpoint of the previous state
    setpoint: Velocity = ZERO
    needed: Velocity = ZERO  # setpoint times the learnt gains
    allowed: Velocity = ZERO  # `needed` within limits and caps
    steady_ticks: int = 0
    gain_x: float = 1.0  # commanded / measured speed, learnt at steady speed
    gain_z: float = 1.0
    basis: int = 0
    enabled_tick: int = 0  # when the gate opened; 0 while it is closed
    operator: bool = False  # an operator drives, until the gate is enabled again
    enables: int = 0  # the gate's count of enables
    sent: tuple[Velocity, ...] = ()  # setpoints of the previous ticks, newest last
    history: PoseHistory = PoseHistory()
    off_track: bool = False  # the body is too far from its trajectory


def step(
    body: BodyDescription, memory: ControlMemory, inputs: ControlInputs
) -> tuple[ControlMemory, CmdVel]:
    """Return the command. All commands of a tick start from the same setpoint."""
    state, intent = inputs.state, inputs.intent
    memory = _next_tick(body, memory, state)
    if intent and intent.basis > state.tick:
        intent = None  # it is based on a future scan
    if intent:
        memory = replace(memory, basis=max(memory.basis, intent.basis))
    if state.gate.mode != "enabled" or state.gate.commander != BRAIN:
        return _reset(memory), _command(ZERO)
    if state.gate.enables != memory.enables:  # an enable hands back to decision
        memory = replace(memory, enables=state.gate.enables, operator=False)
    if inputs.teleop:
        memory = replace(memory, operator=True, basis=state.tick)  # the operator sees the robot
    memory = replace(memory, enabled_tick=memory.enabled_tick or state.tick)
    limits = limits_of(body)
    memory, wanted = _wanted_velocity(body, memory, inputs, intent)
    target = clamp(wanted, limits, inputs.caps)
    setpoint = ramp(memory.before, target, limits, TICK_S * memory.elapsed_ticks)
    if memory.enabled_tick == state.tick:  # the first command after enabling is zero
        setpoint = ZERO
    gain_z = memory.gain_z
    if intent and _follows_trajectory(memory, intent, inputs.teleop):
        # the intent has a better estimate of the turn gain
        gain_z, memory = turn_correction(intent.response.turn_gain), replace(memory, steady_ticks=0)
    needed = replace(
        setpoint,
        linear_x=setpoint.linear_x * memory.gain_x,
        angular_z=setpoint.angular_z * gain_z,
    )
    allowed = clamp(needed, limits, inputs.caps)
    memory = replace(memory, setpoint=setpoint, needed=needed, allowed=allowed)
    return memory, _command(clamp(needed, limits), operator=memory.operator)


def _next_tick(body: BodyDescription, memory: ControlMemory, state: RobotState) -> ControlMemory:
    """Advance to the tick of `state`, and learn the gains of the body."""
    if state.boot != memory.boot:
        return ControlMemory(boot=state.boot, tick=state.tick, history=memory.history.then(state))
    if state.tick == memory.tick:
        return memory
    steady = memory.steady_ticks + 1 if memory.setpoint == memory.before else 0
    if steady >= STEADY_TICKS:
        memory = _learn(body.control, memory, state.velocity)
    passed = state.tick - memory.tick
    sent = (*memory.sent, *(memory.setpoint,) * min(passed, MAX_DELAY_TICKS))
    return replace(
        memory,
        tick=state.tick,
        elapsed_ticks=min(passed, MAX_RAMP_TICKS),
        before=memory.setpoint,
        steady_ticks=steady,
        sent=sent[-MAX_DELAY_TICKS:],
        history=memory.history.then(state),
    )


def _learn(gains: ControlGains, memory: ControlMemory, measured: Velocity) -> ControlMemory:
    """Correct both gains by the error of the measured speed.

    A gain does not grow while a limit or a cap slows the body.
    """
    setpoint, needed, allowed = memory.setpoint, memory.needed, memory.allowed
    gain_x, gain_z = memory.gain_x, memory.gain_z
    if abs(setpoint.linear_x) > MIN_LEARN_LINEAR:
        error = 1.0 - measured.linear_x / setpoint.linear_x
        if error < 0 or allowed.linear_x == needed.linear_x:
            gain_x += gains.linear_integral * TICK_S * error
    if abs(setpoint.angular_z) > MIN_LEARN_ANGULAR:
        error = 1.0 - measured.angular_z / setpoint.angular_z
        if error < 0 or allowed.angular_z == needed.angular_z:
            gain_z += gains.angular_integral * TICK_S * error
    min_gain, max_gain = 1.0 - gains.max_correction, 1.0 + gains.max_correction
    return replace(
        memory,
        gain_x=max(min_gain, min(max_gain, gain_x)),
        gain_z=max(min_gain, min(max_gain, gain_z)),
    )


def _reset(memory: ControlMemory) -> ControlMemory:
    """Forget gains and setpoints, while the gate is closed."""
    return ControlMemory(
        boot=memory.boot,
        tick=memory.tick,
        basis=memory.basis,
        operator=memory.operator,
        enables=memory.enables,
        history=memory.history,
    )


def _follows_trajectory(memory: ControlMemory, intent: Intent, teleop: Velocity | None) -> bool:
    return intent.follow and not teleop and not memory.operator


def _wanted_velocity(
    body: BodyDescription, memory: ControlMemory, inputs: ControlInputs, intent: Intent | None
) -> tuple[ControlMemory, Velocity]:
    """Return the operator's velocity, else that of the intent, else zero."""
    state, teleop = inputs.state, inputs.teleop
    if intent and _follows_trajectory(memory, intent, teleop):
        start = memory.history.at(state.boot, intent.basis)
        if start is None:
            return memory, ZERO
        wanted = track(body, intent, state, start, memory.sent)
        return replace(memory, off_track=wanted is None), wanted or ZERO
    memory = replace(memory, off_track=False)
    if teleop:
        return memory, within_turning_circle(body, teleop)
    if memory.operator or intent is None or intent.twist is None:
        return memory, ZERO
    return memory, within_turning_circle(body, intent.twist)


def _command(velocity: Velocity, *, operator: bool = False) -> CmdVel:
    return CmdVel(**structs.asdict(velocity), source=BRAIN, operator=operator)


def _log_tracking(tick: int, *, lost: bool) -> None:
    data = {"event": "off_track" if lost else "on_track", "tick": tick}
    if lost:
        log.warning("braking: too far from the trajectory", extra={"data": data})
    else:
        log.info("on the trajectory again", extra={"data": data})


def caps_at(verdicts: PreviousTick[SafetyState], state: RobotState) -> SpeedCaps:
    """Return the caps that safety set before the tick of `state`.

    Within a tick, the order of safety's verdict and decision's intent must not matter. The gate
    obeys a verdict at once; control adapts to it from the next tick on.
    """
    verdict = verdicts.at(state.boot, state.tick, SAFETY.stale_after_ns)
    return verdict.caps if verdict else NO_CAPS  # without a verdict the gate stops everything


async def run(bus: Bus, ready: Callable[[], None]) -> None:
    """Publish commands at the body's rate, and at once for each new intent."""
    memory, lost, commands = ControlMemory(), False, 0
    teleop, verdicts = Teleop(bus.clock.now_ns), PreviousTick[SafetyState]()
    arm = ArmControl(bus)

    def act(message: Message) -> None:
        nonlocal commands
        state, body = states.fresh(), bodies.current
        if state is None or body is None:
            return
        intent = intents.fresh()
        if body.description.has_base:
            drive(state, body, intent)
        if body.description.joints and message is state:
            arm.act(state, body, _recent(intent, state.tick))
            commands += 1  # also without a command, while joints are missing

    def drive(state: RobotState, body: Body, intent: Intent | None) -> None:
        nonlocal memory, lost, commands
        inputs = ControlInputs(
            state=state,
            intent=intent,
            teleop=teleop.velocity(state, echo_wanted=body.link == "real"),
            caps=caps_at(verdicts, state),
        )
        before = memory.basis
        memory, command = step(body.description, memory, inputs)
        if memory.off_track != lost:
            lost = memory.off_track
            _log_tracking(state.tick, lost=lost)
        due = state.tick % body.description.control.period_ticks == 0
        if due or memory.basis != before:
            bus.publish(command_topic(body.description), command, basis=memory.basis)
            commands += 1

    def on_intent(intent: Intent) -> None:
        # an intent whose state has not arrived waits for it
        if intent.basis > memory.basis and intent.tick <= bus.time.tick:
            act(intent)

    bodies = bus.latest(BODY, arm.prepare)
    states = bus.latest(STATE, act)
    intents = bus.latest(INTENT, on_intent)
    bus.latest(SAFETY, verdicts.receive)
    bus.latest(TELEOP, teleop.receive)
    bus.latest(JOINT_TELEOP, arm.teleop.receive)
    bus.progress = Progress(
        lambda: (bus.arrived.get(STATE.key),) if bodies.current else (), lambda: commands
    )
    ready()
    await bus.failed


def _recent(intent: Intent | None, tick: int) -> Intent | None:
    """Return the intent if it is recent enough to move joints."""
    return intent if intent and tick - intent.tick <= INTENT_TICKS else None


class ArmControl:
    """Publishes commands for joints at each state. They move while the gate obeys `commander`."""

    def __init__(self, bus: Bus, commander: str = BRAIN) -> None:
        self._bus, self._commander = bus, commander
        self._memory = JointMemory()
        self._between_states: asyncio.Future[None] | None = None  # publishes further commands
        self.teleop: OperatorStream[JointSpeeds] = OperatorStream(bus.clock.now_ns)

    @property
    def memory(self) -> JointMemory:
        """State after the last command."""
        return self._memory

    def prepare(self, body: Body) -> None:
        """Load the library for the joints of a body. Raises ConfigError if it is missing."""
        if joints := body.description.joints:
            joint_ramp.prepare(len(joints))

    def act(self, state: RobotState, body: Body, intent: Intent | None) -> None:
        """Publish the command for a state, unless joints are missing."""
        if intent and intent.basis > state.tick:
            intent = None  # it is based on future data
        teleop = self.teleop.live(state, echo_wanted=body.link == "real")
        inputs = JointInputs(state=state, intent=intent, teleop=teleop)
        before = self._memory.problem
        self._memory, command = step_joints(body.description, self._memory, inputs, self._commander)
        if self._memory.problem != before:
            _log_tolerance(state.tick, self._memory)
        if command:
            self._bus.publish(JOINT_CMD, command, basis=state.tick)
            self._publish_between_states(state, body, command)

    def _publish_between_states(self, state: RobotState, body: Body, command: JointCommand) -> None:
        """Publish further commands until the next state, for an arm with a higher rate.

        A simulation gets one per tick, so that runs are repeatable.
        """
        if self._between_states:
            self._between_states.cancel()
            self._between_states = None
        arm, memory = body.description.arm, self._memory
        count = round(arm.rate_hz * TICK_S) if arm and body.link != "sim" else 1
        if count < 2 or not any(point.velocity for point in memory.setpoint):
            return

        async def publish_later() -> None:
            for _ in range(1, count):
                await self._bus.clock.sleep_ns(TICK_NS // count)
                after_s = (self._bus.clock.now_ns() - began_ns) / 1e9
                later = between(body.description, memory, command, min(after_s, TICK_S))
                self._bus.publish(JOINT_CMD, later, basis=state.tick)

        began_ns = self._bus.clock.now_ns()
        self._between_states = asyncio.ensure_future(publish_later())


def _log_tolerance(tick: int, memory: JointMemory) -> None:
    data = {"event": memory.problem or "path_followed", "tick": tick}
    if memory.problem:
        log.warning("holding: %s: %s", memory.problem, memory.detail, extra={"data": data})
    else:
        log.info("joints follow again", extra={"data": data})
