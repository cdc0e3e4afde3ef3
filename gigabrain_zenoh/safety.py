"""Safety: listens to all, trusts none, and says whether and how fast the body may move."""

import logging
import math
from collections.abc import Callable
from typing import Any

import msgspec
from msgspec.structs import replace

from gigabrain_schemas.arrays import ranges
from gigabrain_schemas.base import TICK_NS, Cause, Message
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import BODY, CMD_VEL, INTENT, SAFETY, SCAN, STATE, WORLD
from gigabrain_zenoh.bus import Bus, Latest
from gigabrain_zenoh.gate import BRAIN
from gigabrain_zenoh.perception import beams, scan_problem

log = logging.getLogger(__name__)

TICK_S = TICK_NS / 1e9
SIDE_MARGIN = 0.03  # [m], kept free beside the body as it moves on
RESUME_MARGIN = 0.10  # [m], more than the stop zone before the body may go on
SUSTAIN_TICKS = 25  # how long a battery or motor must be out of bounds (0.5 s)
REPEAT_TICKS = 2  # the verdict is repeated every 40 ms, and at once when it changes
HEARTBEAT_NS = 150_000_000  # how long decision and control may be silent
NEAREST = 0.1  # [m], nearer hits are the lidar's own housing


class Inputs(msgspec.Struct, frozen=True, kw_only=True):
    """What safety looks at."""

    state: RobotState
    scan: LaserScan | None = None  # newest of this boot, however old
    scan_age_ns: int | None = None
    silent: tuple[str, ...] = ()  # which of the three systems have stopped sending


class Memory(msgspec.Struct, frozen=True, kw_only=True):
    """What safety remembers from tick to tick."""

    tick: int = 0
    basis: int = 0  # the scan that `free` was read from
    problem: str = ""  # why that scan cannot be believed
    free_ahead: float | None = None  # [m] until the body would touch, None for nothing in the way
    free_behind: float | None = None  # [m]
    stopped_ahead: bool = False
    stopped_behind: bool = False
    low_ticks: int = 0  # how long the battery has been empty
    hot_ticks: int = 0  # how long a motor has been too hot


def step(body: BodyDescription, memory: Memory, inputs: Inputs) -> tuple[Memory, SafetyState]:
    """One verdict."""
    state = inputs.state
    elapsed = max(0, state.tick - memory.tick)
    memory = replace(memory, tick=state.tick)
    memory = _look(body, memory, inputs)
    memory = _count(body, memory, state, elapsed)
    causes = (*_blind(body, memory, inputs), *_silent(inputs), *_worn(body, memory))
    zones = _zone_causes(memory)
    caps = _caps(body, memory)
    verdict = SafetyState(
        verdict="stop" if causes else "slow" if zones or caps != SpeedCaps() else "ok",
        caps=caps,
        causes=(*causes, *zones),
        warnings=_warnings(body, state),
    )
    return memory, verdict


def stopping_distance(body: BodyDescription, speed: float) -> float:
    """L(v) = v T + v² / 2a + margin [m]: how far ahead must be free at `speed` [m/s]."""
    t, a = body.thresholds.reaction_time, body.max_linear_deceleration
    return speed * t + speed * speed / (2 * a) + body.thresholds.stop_margin


def speed_within(body: BodyDescription, free: float) -> float:
    """The speed [m/s] from which the body stops within `free` [m]: L(v) solved for v."""
    t, a = body.thresholds.reaction_time, body.max_linear_deceleration
    room = max(0.0, free - body.thresholds.stop_margin)
    return -a * t + math.sqrt((a * t) ** 2 + 2 * a * room)


def free_distances(body: BodyDescription, scan: LaserScan) -> tuple[float | None, float | None]:
    """How far the footprint can go forwards and backwards until it touches a hit of `scan` [m]."""
    lidar = body.lidar
    if lidar is None:
        return None, None
    values = ranges(scan)
    directions = beams(len(values), scan.angle_min, scan.angle_increment, lidar.yaw)
    hits = (values >= NEAREST) & (values <= scan.range_max)  # nan and inf are neither
    x = lidar.x + values[hits] * directions[hits, 0]
    y = lidar.y + values[hits] * directions[hits, 1]
    half_width = max(abs(corner[1]) for corner in body.footprint) + SIDE_MARGIN
    front = max(corner[0] for corner in body.footprint)
    rear = min(corner[0] for corner in body.footprint)
    x = x[abs(y) <= half_width]
    ahead, behind = x[x > 0], x[x < 0]
    return (
        max(0.0, float(ahead.min()) - front) if ahead.size else None,
        max(0.0, rear - float(behind.max())) if behind.size else None,
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
    ahead, behind = (None, None) if problem else free_distances(body, scan)
    speed = inputs.state.velocity.linear_x
    return replace(
        memory,
        basis=scan.basis,
        problem=problem,
        free_ahead=ahead,
        free_behind=behind,
        stopped_ahead=_in_zone(body, ahead, max(0.0, speed), memory.stopped_ahead),
        stopped_behind=_in_zone(body, behind, max(0.0, -speed), memory.stopped_behind),
    )


def _in_zone(body: BodyDescription, free: float | None, speed: float, stopped: bool) -> bool:
    """Once stopped, only a clear margin opens the zone again."""
    if free is None:
        return False
    margin = RESUME_MARGIN if stopped else 0.0
    return free < stopping_distance(body, speed) + margin


def _caps(body: BodyDescription, memory: Memory) -> SpeedCaps:
    return SpeedCaps(
        forward=_cap(body, memory.free_ahead, memory.stopped_ahead),
        backward=_cap(body, memory.free_behind, memory.stopped_behind),
    )


def _cap(body: BodyDescription, free: float | None, stopped: bool) -> float | None:
    if stopped:
        return 0.0
    if free is None:
        return None
    allowed = speed_within(body, free)
    return allowed if allowed < body.max_linear_speed else None


def _zone_causes(memory: Memory) -> tuple[Cause, ...]:
    """They hold back only what goes towards the obstacle; the gate does not stop for them."""
    zones = (
        ("zone_ahead", "ahead", memory.stopped_ahead, memory.free_ahead),
        ("zone_behind", "behind", memory.stopped_behind, memory.free_behind),
    )
    return tuple(
        Cause(code=code, text=f"obstacle {free or 0.0:.2f} m {where} of the body")
        for code, where, stopped, free in zones
        if stopped
    )


def _blind(body: BodyDescription, memory: Memory, inputs: Inputs) -> tuple[Cause, ...]:
    if body.lidar is None:
        return ()
    limit_ns = scan_limit_ns(body)
    if inputs.scan_age_ns is None or inputs.scan_age_ns > limit_ns:
        text = f"no scan for more than {limit_ns // 1_000_000} ms"
        return (Cause(code="scan_lost", text=text),)
    if memory.problem:
        return (Cause(code="scan_blind", text=memory.problem),)
    return ()


def scan_limit_ns(body: BodyDescription) -> int:
    """How old sensor data may be that moves the body: 250 ms, or 1.5 scans where that is more."""
    period_ns = 1e9 / body.lidar.rate_hz if body.lidar else 0.0
    return round(max(250e6, 1.5 * period_ns))


def _silent(inputs: Inputs) -> tuple[Cause, ...]:
    """The brain's processes matter while the brain drives; a person or a script looks itself."""
    if inputs.state.gate.commander not in ("", BRAIN):
        return ()
    return tuple(Cause(code=f"{name}_silent", text=f"{name} is silent") for name in inputs.silent)


def _count(body: BodyDescription, memory: Memory, state: RobotState, elapsed: int) -> Memory:
    limits = body.thresholds
    low = state.battery is not None and state.battery.percentage <= limits.battery_stop
    hot = any(
        joint.temperature is not None and joint.temperature >= limits.motor_stop
        for joint in state.joints
    )
    return replace(
        memory,
        low_ticks=memory.low_ticks + elapsed if low else 0,
        hot_ticks=memory.hot_ticks + elapsed if hot else 0,
    )


def _worn(body: BodyDescription, memory: Memory) -> tuple[Cause, ...]:
    found = []
    if memory.low_ticks >= SUSTAIN_TICKS:
        text = f"battery at or below {body.thresholds.battery_stop:g} %; charge it"
        found.append(Cause(code="battery_empty", text=text, latching=True))
    if memory.hot_ticks >= SUSTAIN_TICKS:
        text = f"a motor has {body.thresholds.motor_stop:g} °C or more; let it cool"
        found.append(Cause(code="motor_hot", text=text, latching=True))
    return tuple(found)


def _warnings(body: BodyDescription, state: RobotState) -> tuple[Cause, ...]:
    limits, found = body.thresholds, []
    if state.battery and state.battery.percentage <= limits.battery_warn:
        text = f"battery at {state.battery.percentage:.0f} %"
        found.append(Cause(code="battery_low", text=text))
    for joint in state.joints:
        if joint.temperature is not None and joint.temperature >= limits.motor_warn:
            text = f"{joint.name} has {joint.temperature:.0f} °C"
            found.append(Cause(code="motor_warm", text=text))
    return tuple(found)


async def run(bus: Bus, ready: Callable[[], None]) -> None:
    """A verdict per scan and per second state, and at once when it changes."""
    memory, said, said_tick = Memory(), SafetyState(verdict="stop"), -REPEAT_TICKS

    def judge(_: Message) -> None:
        nonlocal memory, said, said_tick
        state, body = states.fresh(), bodies.current
        if state is None or body is None:
            return
        if state.tick < memory.tick or state.boot != said.boot:
            memory, said_tick = Memory(), -REPEAT_TICKS  # the driver has started anew
        before = memory.basis
        inputs = Inputs(
            state=state,
            scan=scans.current,
            scan_age_ns=scans.age_ns(),
            silent=_silent_systems(body.description),
        )
        memory, verdict = step(body.description, memory, inputs)
        due = state.tick - said_tick >= REPEAT_TICKS or memory.basis != before
        if due or (verdict.causes, verdict.caps) != (said.causes, said.caps):
            said, said_tick = bus.publish(SAFETY, verdict, basis=memory.basis), state.tick

    def _silent_systems(body: BodyDescription) -> tuple[str, ...]:
        limit_ns = {"perception": scan_limit_ns(body) + 50_000_000}
        return tuple(
            name
            for name, heard in systems.items()
            if not heard.fresh(limit_ns.get(name, HEARTBEAT_NS))
        )

    bodies = bus.latest(BODY)
    states = bus.latest(STATE, judge)
    scans = bus.latest(SCAN, judge)
    systems: dict[str, Latest[Any]] = {
        "perception": bus.latest(WORLD),
        "decision": bus.latest(INTENT),
        "control": bus.latest(CMD_VEL),
    }
    ready()
    await bus.failed
