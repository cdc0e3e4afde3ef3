"""Joint trajectory controller: turns intents, or an operator's speeds, into joint positions.

It starts from the goals that the gate sent, and keeps each joint's limits of speed, acceleration
and jerk. A joint's gains correct its lag. A joint that leaves its tolerance stops all of them.
"""

from collections.abc import Sequence
from functools import lru_cache

import msgspec
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import BodyDescription, JointDescription, RobotState
from gigabrain_schemas.brain import Intent, JointCommand, JointSpeeds, JointTrajectory
from gigabrain_zenoh.gate.gate import CALM_TICKS
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry.joint_ramp import (
    REST,
    JointGoal,
    JointPoint,
    along,
    held,
    measured,
    ramp,
    within,
)

MAX_STEP_TICKS = 5  # longest step, also after a gap
MAX_DEVIATION_TICKS = 3  # allowed between command and gate, in ticks of full-speed motion
MAX_SPEED_FACTOR = 1.1  # the gate moves no joint faster than its maximum, except for rounding
SLOW = 0.01  # [rad/s] or [m/s], a joint whose setpoint is slower counts as at rest
Places = tuple[float, ...]


class JointInputs(msgspec.Struct, frozen=True, kw_only=True):
    """Inputs of one command for joints; None if stale, missing or malformed."""

    state: RobotState
    intent: Intent | None = None
    teleop: JointSpeeds | None = None  # while the operator's stream is live


class JointMemory(msgspec.Struct, frozen=True, kw_only=True):
    """State from tick to tick."""

    boot: int = 0
    tick: int = 0
    enables: int = 0  # the gate's count of enables
    enabled_tick: int = 0  # when the gate opened; 0 while it is closed
    operator: bool = False  # an operator jogs, until the gate is enabled again
    active: bool = False  # motion was requested since then, so that gains correct the lag
    setpoint: tuple[JointPoint, ...] = ()  # for the next tick; empty while closed
    sent: Places = ()  # the last command
    obeyed: Places = ()  # positions that the gate sent at `tick`
    integral: Places = ()  # [rad] or [m], part of the correction
    problem: str = ""  # code of the violated tolerance
    detail: str = ""  # the joint and its error
    broken_tick: int = 0
    hold: Places = ()  # measured positions at `broken_tick`


def step_joints(
    body: BodyDescription, memory: JointMemory, inputs: JointInputs, commander: str = BRAIN
) -> tuple[JointMemory, JointCommand | None]:
    """Return the command for the tick after the state; None while joints are missing.

    It moves the joints while the gate obeys `commander`.
    """
    state = inputs.state
    obeyed = state.gate.mode == "enabled" and state.gate.commander == commander
    memory, command = _step(body, memory, inputs, obeyed)
    return memory, command and replace(command, source=commander)


def _step(
    body: BodyDescription, memory: JointMemory, inputs: JointInputs, obeyed: bool
) -> tuple[JointMemory, JointCommand | None]:
    state = inputs.state
    here, posture = measured(body, state), held(body, state)
    if not here:
        return JointMemory(boot=state.boot, tick=state.tick), None
    if not obeyed:
        memory = JointMemory(
            boot=state.boot,
            tick=state.tick,
            enables=memory.enables,
            operator=memory.operator and memory.boot == state.boot,
        )
        return memory, _command(body, _places(posture))
    memory, ticks = _next_tick(body, memory, state, here, posture)
    if ticks == 0:
        return memory, _command(body, memory.sent, memory)
    if inputs.teleop:
        memory = replace(memory, operator=True)
    if inputs.intent is None and not (memory.operator or memory.problem):
        return _brake(body, memory, here, posture)
    intent = None if memory.operator else inputs.intent
    requested = intent and (intent.joints or intent.joint_trajectory)
    memory = replace(memory, active=bool(memory.active or inputs.teleop or requested))
    if intent and intent.joint_trajectory:
        memory = _checked(body, memory, intent.joint_trajectory, here)
    elif intent or inputs.teleop:
        memory = replace(memory, problem="", detail="")
    memory = replace(memory, setpoint=_next_setpoint(body, memory, inputs.teleop, intent, ticks))
    return _corrected(body, memory, here, ticks)


def _next_tick(
    body: BodyDescription,
    memory: JointMemory,
    state: RobotState,
    here: tuple[JointPoint, ...],
    posture: tuple[JointPoint, ...],
) -> tuple[JointMemory, int]:
    """Advance to the tick of `state`; also return the ticks since the last step.

    After an enable, all joints start from the positions that the gate sent. So does a joint that
    the gate slowed down; it continues at the speed that the gate sent.
    """
    opened = not memory.setpoint or memory.boot != state.boot
    handed_over = state.gate.enables != memory.enables
    if opened or handed_over:
        memory = JointMemory(
            boot=state.boot,
            tick=state.tick,
            enables=state.gate.enables,
            enabled_tick=state.tick,
            operator=memory.operator and not handed_over,
            setpoint=posture,
            sent=_places(posture),
            obeyed=_places(posture),
            integral=(0.0,) * len(posture),
        )
        return memory, 0
    passed = max(0, min(state.tick - memory.tick, MAX_STEP_TICKS))
    calm = state.tick - memory.enabled_tick <= CALM_TICKS
    deviating = [
        calm or abs(sent - point.position) > MAX_DEVIATION_TICKS * TICK_S * joint.max_speed
        for sent, point, joint in zip(memory.sent, posture, body.joints, strict=True)
    ]
    speeds = [0.0] * len(posture)
    for k, joint in enumerate(body.joints):
        moved = (posture[k].position - memory.obeyed[k]) / (max(1, passed) * TICK_S)
        if abs(moved) <= MAX_SPEED_FACTOR * joint.max_speed:  # otherwise it was turned by hand
            speeds[k] = moved
    memory = _resume_from_gate(body, memory, here, posture, deviating, speeds)
    memory = replace(memory, tick=state.tick, obeyed=_places(posture))
    return memory, 0 if calm else passed


def _brake(
    body: BodyDescription,
    memory: JointMemory,
    here: tuple[JointPoint, ...],
    posture: tuple[JointPoint, ...],
) -> tuple[JointMemory, JointCommand]:
    """Let the gate brake and hold the joints, while decision is silent."""
    names, still = tuple(joint.name for joint in body.joints), (0.0,) * len(posture)
    memory = _resume_from_gate(body, memory, here, posture, [True] * len(posture), still)
    return memory, JointCommand(name=names, velocity=still)


def _resume_from_gate(
    body: BodyDescription,
    memory: JointMemory,
    here: tuple[JointPoint, ...],
    posture: tuple[JointPoint, ...],
    selected: Sequence[bool],
    speeds: Sequence[float],
) -> JointMemory:
    """Let the selected joints continue at `speeds` from the positions that the gate sent.

    The correction at rest is subtracted from the setpoint, otherwise it would add up.
    """
    setpoint, sent = list(memory.setpoint), list(memory.sent)
    for k, joint in enumerate(body.joints):
        if selected[k]:
            sent[k] = place = posture[k].position
            if memory.active:
                gains, now, old = joint.gains, here[k].position, memory.integral[k]
                wanted = (place - old + gains.p * now) / (1.0 + gains.p)
                limit = gains.max_correction
                place -= max(-limit, min(limit, gains.p * (wanted - now) + old))
            setpoint[k] = JointPoint(within(joint, place), speeds[k])
    return replace(memory, setpoint=tuple(setpoint), sent=tuple(sent))


def _next_setpoint(
    body: BodyDescription,
    memory: JointMemory,
    teleop: JointSpeeds | None,
    intent: Intent | None,
    ticks: int,
) -> tuple[JointPoint, ...]:
    """Return the setpoint `ticks` later, by the operator, else by the intent, else at rest."""
    now, joints, dt = memory.setpoint, body.joints, ticks * TICK_S
    trajectory = intent.joint_trajectory if intent else None
    if memory.problem:
        return ramp(now, [JointGoal(place) for place in memory.hold], joints, dt)
    if trajectory:
        at = [memory.tick + 1 + k * ticks for k in (-1, 0, 1)]
        path = [sample(body, trajectory, now, tick) for tick in at]
        return along(now, path, joints, dt)
    if teleop:
        speeds = dict(zip(teleop.name, teleop.velocity, strict=True))
        goals = {name: JointGoal(velocity=speed) for name, speed in speeds.items()}
    else:
        targets = intent.joints if intent else ()
        goals = {target.name: JointGoal(target.position) for target in targets}
    if not goals and not any(point.velocity or point.acceleration for point in now):
        return now
    limits = joints if teleop else [_with_reserve(joint) for joint in joints]
    return ramp(now, [goals.get(joint.name, REST) for joint in joints], limits, dt)


@lru_cache(maxsize=64)
def _with_reserve(joint: JointDescription) -> JointDescription:
    """Return a joint with less acceleration and jerk, to leave a reserve for the feed-forward.

    The command leads by f v. Its acceleration a + f j must be within the joint's limit; otherwise
    the gate limits it, and the joint overshoots.
    """
    lead = joint.gains.feed_forward * joint.max_jerk
    share = joint.max_acceleration / (joint.max_acceleration + lead)
    acceleration, jerk = share * joint.max_acceleration, share * joint.max_jerk
    return replace(joint, max_acceleration=acceleration, max_jerk=jerk)


def sample(
    body: BodyDescription, path: JointTrajectory, now: tuple[JointPoint, ...], tick: int
) -> Places:
    """Return each joint's position on the path at a tick; other joints stay where they are."""
    points = path.array()
    at = max(0.0, min(len(points) - 1.0, (tick - path.start) * TICK_S / path.period))
    first = int(at)
    last, share = min(first + 1, len(points) - 1), at - first
    row = (points[first] + share * (points[last] - points[first])).tolist()
    wanted = dict(zip(path.name, row, strict=True))
    return tuple(
        within(joint, wanted.get(joint.name, point.position))
        for joint, point in zip(body.joints, now, strict=True)
    )


def _checked(
    body: BodyDescription, memory: JointMemory, path: JointTrajectory, here: tuple[JointPoint, ...]
) -> JointMemory:
    """Check the tolerances. A hold ends with a trajectory that was made later."""
    assert body.arm
    wanted = sample(body, path, here, memory.tick)
    errors = _errors(body.joints, wanted, here)
    ended_s = (memory.tick - path.start) * TICK_S - (len(path.array()) - 1) * path.period
    found = _violation("path_tolerance", errors, [joint.path_tolerance for joint in body.joints])
    if not found[0] and ended_s > body.arm.goal_time:
        tolerances = [joint.goal_tolerance for joint in body.joints]
        found = _violation("goal_tolerance", errors, tolerances)
    if memory.problem and (found[0] or path.start <= memory.broken_tick):
        return memory
    problem, detail = found
    if not problem:
        return replace(memory, problem="", detail="")
    places = tuple(within(joint, p.position) for joint, p in zip(body.joints, here, strict=True))
    return replace(memory, problem=problem, detail=detail, broken_tick=memory.tick, hold=places)


def _errors(
    joints: tuple[JointDescription, ...], wanted: Places, here: tuple[JointPoint, ...]
) -> dict[str, float]:
    return {
        joint.name: place - point.position
        for joint, place, point in zip(joints, wanted, here, strict=True)
    }


def _violation(code: str, errors: dict[str, float], tolerances: list[float]) -> tuple[str, str]:
    """Return code and detail of the first joint beyond its tolerance; 0 means unlimited."""
    for (name, error), tolerance in zip(errors.items(), tolerances, strict=True):
        if tolerance and abs(error) > tolerance:
            return code, f"{name} is {abs(error):.2f} off, more than {tolerance:g}"
    return "", ""


def _corrected(
    body: BodyDescription, memory: JointMemory, here: tuple[JointPoint, ...], ticks: int
) -> tuple[JointMemory, JointCommand]:
    """Return the command: the setpoint plus the corrections by each joint's gains."""
    sent, integral = [], []
    for joint, point, now, old in zip(
        body.joints, memory.setpoint, here, memory.integral, strict=True
    ):
        gains = joint.gains
        limit = gains.max_correction
        error = point.position - now.position
        still = memory.active and abs(point.velocity) < SLOW and not memory.problem
        still = still and joint.part == "arm"  # a gripper with an object stays off its setpoint
        grown = old + gains.i * error * TICK_S * ticks if still else old
        grown = max(-limit, min(limit, grown))
        fixed = gains.p * error + grown + gains.d * (point.velocity - now.velocity)
        fixed = max(-limit, min(limit, fixed)) + gains.feed_forward * point.velocity
        fixed += gains.inertia * point.acceleration
        fixed = fixed if memory.active else 0.0
        integral.append(grown)
        sent.append(within(joint, point.position + fixed))
    memory = replace(memory, sent=tuple(sent), integral=tuple(integral))
    return memory, _command(body, memory.sent, memory)


def between(
    body: BodyDescription, memory: JointMemory, command: JointCommand, after_s: float
) -> JointCommand:
    """Return `command`, extrapolated by `after_s`."""
    places = tuple(
        within(joint, place + speed * after_s)
        for joint, place, speed in zip(body.joints, command.position, command.velocity, strict=True)
    )
    return replace(command, position=places)


def _speeds(body: BodyDescription, memory: JointMemory) -> Places:
    """Return the speeds of the commanded positions, including their feed-forward."""
    lead = [joint.gains.feed_forward if memory.active else 0.0 for joint in body.joints]
    speeds = [p.velocity + f * p.acceleration for p, f in zip(memory.setpoint, lead, strict=True)]
    return tuple(
        max(-joint.max_speed, min(joint.max_speed, speed))
        for joint, speed in zip(body.joints, speeds, strict=True)
    )


def _places(points: tuple[JointPoint, ...]) -> Places:
    return tuple(point.position for point in points)


def _command(
    body: BodyDescription, places: Places, memory: JointMemory | None = None
) -> JointCommand:
    speeds = _speeds(body, memory) if memory else (0.0,) * len(places)
    return JointCommand(
        name=tuple(joint.name for joint in body.joints),
        position=places,
        velocity=speeds,
        operator=memory.operator if memory else False,
    )
