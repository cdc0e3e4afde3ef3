"""Safety: listens to all, trusts none, and says whether and how fast the body may move."""

import logging
from collections.abc import Callable
from typing import Any

import msgspec
from msgspec.structs import replace

from gigabrain_schemas.arrays import ranges
from gigabrain_schemas.base import Cause, Message
from gigabrain_schemas.body import Body, BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import (
    BODY,
    CMD_VEL,
    HEALTH,
    IMAGE,
    IMU,
    INTENT,
    LOG,
    MAP,
    POSE,
    SAFETY,
    SCAN,
    STATE,
    WORLD,
    Topic,
    command_topic,
)
from gigabrain_zenoh.ages import scan_limit_ns as scan_limit_ns
from gigabrain_zenoh.bus import Bus, Latest
from gigabrain_zenoh.causes import in_words
from gigabrain_zenoh.gate import BRAIN
from gigabrain_zenoh.perception import blind_ahead, scan_problem
from gigabrain_zenoh.stop_zone import NEAREST, cap, free_distances, in_zone

log = logging.getLogger(__name__)

SYSTEMS = ("perception", "decision", "control")
# what nobody else listens to yet, so that what is bad on these keys is counted all the same
OVERHEARD: tuple[Topic[Any], ...] = (IMU, IMAGE, POSE, MAP, HEALTH, LOG)
SCANS_TO_START = 2  # whoever answers the first has been heard by the second, however slow
SUSTAIN_TICKS = 25  # how long a battery or motor must be out of bounds (0.5 s)
LONGEST_STEP_TICKS = 5  # a sample after a longer gap speaks for no more than this
REPEAT_TICKS = 2  # the verdict is repeated every 40 ms, and at once when it changes
HEARTBEAT_NS = 150_000_000  # how long decision and control may be silent
WORLD_MARGIN_NS = 50_000_000  # how much later than a scan its world may come
LOOK_AT_LIDAR = "look at the lidar's power and cable"
CONE_DEG = 30.0  # [deg], the cone ahead of which something must be known


class Inputs(msgspec.Struct, frozen=True, kw_only=True):
    """What safety looks at."""

    state: RobotState
    scan: LaserScan | None = None  # newest of this boot, however old
    scan_age_ns: int | None = None
    silent: tuple[str, ...] = ()  # which of the three systems have stopped sending


class Memory(msgspec.Struct, frozen=True, kw_only=True):
    """What safety remembers from tick to tick."""

    boot: int = 0
    tick: int = 0
    scans: int = 0  # how many have been looked at
    basis: int = 0  # the scan that `free` was read from
    problem: str = ""  # why that scan cannot be believed
    free_ahead: float | None = None  # [m] until the body would touch, None for nothing in the way
    free_behind: float | None = None  # [m]
    stopped_ahead: bool = False
    stopped_behind: bool = False
    low_ticks: int = 0  # how long the battery has been empty
    hot_ticks: int = 0  # how long a motor has been too hot


def step(body: BodyDescription, memory: Memory, inputs: Inputs) -> tuple[Memory, SafetyState]:
    """One verdict. Asked again within a tick, it has changed only by what has come since."""
    state = inputs.state
    if state.boot != memory.boot:  # the driver has started anew
        memory = Memory(boot=state.boot, tick=state.tick)
    memory = _look(body, _count(body, memory, state), inputs)
    stop = (*_blind(body, memory, inputs), *_silent(body, memory, inputs), *_worn(body, memory))
    zones = _zone_causes(memory)
    caps = SpeedCaps(
        forward=cap(body, memory.free_ahead, memory.stopped_ahead),
        backward=cap(body, memory.free_behind, memory.stopped_behind),
    )
    verdict = SafetyState(
        verdict="stop" if stop else "slow" if caps != SpeedCaps() else "ok",
        caps=caps,
        causes=(*stop, *zones),
        warnings=_warnings(body, state),
    )
    return memory, verdict


def _count(body: BodyDescription, memory: Memory, state: RobotState) -> Memory:
    """How long the battery and the motors have been out of bounds."""
    limits = body.thresholds
    low = state.battery is not None and state.battery.percentage <= limits.battery_stop
    hot = any(
        joint.temperature is not None and joint.temperature >= limits.motor_stop
        for joint in state.joints
    )
    elapsed = min(max(0, state.tick - memory.tick), LONGEST_STEP_TICKS)
    return replace(
        memory,
        tick=state.tick,
        low_ticks=memory.low_ticks + elapsed if low else 0,
        hot_ticks=memory.hot_ticks + elapsed if hot else 0,
    )


def _look(body: BodyDescription, memory: Memory, inputs: Inputs) -> Memory:
    """Read a new scan, once the state of its tick is here as well.

    Stop zones go by the measured speed of that tick. Until the next scan the speed caps keep the
    body from gaining more speed than the zone allows.
    """
    scan = inputs.scan
    if body.lidar is None or scan is None or scan.basis == memory.basis:
        return memory
    if scan.basis > inputs.state.tick:
        return memory
    problem = scan_problem(body.lidar, ranges(scan), NEAREST)
    problem = problem or blind_ahead(body.lidar, scan, NEAREST, CONE_DEG)
    ahead, behind = (None, None) if problem else free_distances(body, scan)
    speed = inputs.state.velocity.linear_x
    return replace(
        memory,
        scans=memory.scans + 1,
        basis=scan.basis,
        problem=problem,
        free_ahead=ahead,
        free_behind=behind,
        stopped_ahead=in_zone(body, ahead, speed, memory.stopped_ahead),
        stopped_behind=in_zone(body, behind, -speed, memory.stopped_behind),
    )


def _zone_causes(memory: Memory) -> tuple[Cause, ...]:
    """They hold back only what goes towards the obstacle; the gate does not stop for them."""
    zones = (
        ("zone_ahead", "ahead", memory.stopped_ahead, memory.free_ahead),
        ("zone_behind", "behind", memory.stopped_behind, memory.free_behind),
    )
    return tuple(
        Cause(
            code=code,
            text=f"obstacle {free or 0.0:.2f} m {where} of the body",
            remedy="turn or back away, or clear the way",
        )
        for code, where, stopped, free in zones
        if stopped
    )


def _blind(body: BodyDescription, memory: Memory, inputs: Inputs) -> tuple[Cause, ...]:
    if body.lidar is None:
        return ()
    if inputs.scan_age_ns is None:
        return (Cause(code="scan_lost", text="no scan has come yet", remedy=LOOK_AT_LIDAR),)
    limit_ns = scan_limit_ns(body)
    if inputs.scan_age_ns > limit_ns:
        text = f"no scan for more than {limit_ns // 1_000_000} ms"
        return (Cause(code="scan_lost", text=text, remedy=LOOK_AT_LIDAR),)
    if memory.problem:
        remedy = "clean and uncover the lidar, or move the robot to where it sees walls"
        return (Cause(code="scan_blind", text=memory.problem, remedy=remedy),)
    return ()


def _silent(body: BodyDescription, memory: Memory, inputs: Inputs) -> tuple[Cause, ...]:
    """The brain's processes matter while the brain drives; a person or a script looks itself.

    While nobody drives they matter too, since the brain would be next; but where all three are
    silent there is no brain, and a script need not wait for one.
    """
    if body.lidar and memory.scans < SCANS_TO_START:
        text = "safety has only just begun to look"
        return (Cause(code="starting", text=text, remedy="wait for the second scan"),)
    commander = inputs.state.gate.commander
    if commander not in ("", BRAIN) or (not commander and len(inputs.silent) == len(SYSTEMS)):
        return ()
    return tuple(
        Cause(
            code=f"{name}_silent",
            text=f"{name} is silent",
            remedy=f"start {name}, or read its log to see why it is silent",
        )
        for name in inputs.silent
    )


def _worn(body: BodyDescription, memory: Memory) -> tuple[Cause, ...]:
    found = []
    if memory.low_ticks >= SUSTAIN_TICKS:
        text = f"battery at or below {body.thresholds.battery_stop:g} %"
        remedy = "charge it, then release the robot"
        found.append(Cause(code="battery_empty", text=text, latching=True, remedy=remedy))
    if memory.hot_ticks >= SUSTAIN_TICKS:
        text = f"a motor has {body.thresholds.motor_stop:g} °C or more"
        remedy = "let it cool, then release the robot"
        found.append(Cause(code="motor_hot", text=text, latching=True, remedy=remedy))
    return tuple(found)


def _warnings(body: BodyDescription, state: RobotState) -> tuple[Cause, ...]:
    limits, found = body.thresholds, []
    if state.battery and state.battery.percentage <= limits.battery_warn:
        text = f"battery at {state.battery.percentage:.0f} %"
        found.append(Cause(code="battery_low", text=text, remedy="charge it soon"))
    for joint in state.joints:
        if joint.temperature is not None and joint.temperature >= limits.motor_warn:
            text = f"{joint.name} has {joint.temperature:.0f} °C"
            remedy = "drive more gently, or let it rest"
            found.append(Cause(code="motor_warm", text=text, remedy=remedy))
    return tuple(found)


async def run(bus: Bus, ready: Callable[[], None]) -> None:
    """A verdict per scan and per second state, and at once when it changes."""
    memory, said, said_tick = Memory(), SafetyState(verdict="stop"), 0

    def judge(_: Message) -> None:
        nonlocal memory, said, said_tick
        state, body = states.fresh(), bodies.current
        if state is None or body is None or state.tick < bus.time.tick:
            return  # a scan of a tick whose state is still on its way waits for that state
        before = memory
        inputs = Inputs(
            state=state,
            scan=scans.current,
            scan_age_ns=scans.age_ns(),
            silent=_silent_systems(body.description),
        )
        memory, verdict = step(body.description, memory, inputs)
        due = state.tick - said_tick >= REPEAT_TICKS or state.boot != before.boot
        new = memory.basis != before.basis
        if due or new or (verdict.causes, verdict.caps) != (said.causes, said.caps):
            _tell(state, said, verdict)
            said, said_tick = bus.publish(SAFETY, verdict, basis=memory.basis), state.tick

    def _silent_systems(body: BodyDescription) -> tuple[str, ...]:
        limits_ns = {"perception": scan_limit_ns(body) + WORLD_MARGIN_NS}
        return tuple(
            name for name in SYSTEMS if not systems[name].fresh(limits_ns.get(name, HEARTBEAT_NS))
        )

    def hear_command(_key: str, command: CmdVel) -> None:
        if command.source == BRAIN:
            commands.take(command)

    def hear_body(body: Body) -> None:
        topic = command_topic(body.description)
        if topic.key not in bus.listens:
            bus.subscribe(topic, hear_command)

    bodies = bus.latest(BODY, hear_body)
    states = bus.latest(STATE, judge)
    scans = bus.latest(SCAN, judge)
    commands = Latest(CMD_VEL, bus.clock, bus.time)
    bus.subscribe(CMD_VEL, hear_command)
    for topic in OVERHEARD:
        bus.subscribe(topic, lambda _key, _message: None)
    systems: dict[str, Latest[Any]] = {
        "perception": bus.latest(WORLD),
        "decision": bus.latest(INTENT),
        "control": commands,
    }
    ready()
    await bus.failed


def _tell(state: RobotState, before: SafetyState, now: SafetyState) -> None:
    """Log a cause once when it begins, and once when all have ended; not while all is starting."""
    if not state.gate.enables:
        return
    known = {cause.code for cause in before.causes}
    fresh = tuple(cause for cause in now.causes if cause.code not in known)
    if fresh:
        data = {"event": "held back", "causes": ",".join(cause.code for cause in fresh)}
        level = logging.WARNING if now.verdict == "stop" else logging.INFO
        log.log(level, "%s: %s", now.verdict, in_words(fresh), extra={"data": data})
    elif before.causes and not now.causes:
        log.info("nothing holds the body back", extra={"data": {"event": "free"}})
