"""Combines all monitors into one verdict. Pure functions; SafetyMemory has the state."""

from msgspec import Struct
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS, Cause
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.limits import NO_CAPS, ZERO
from gigabrain_zenoh.geometry.pose import PoseHistory, velocity_of
from gigabrain_zenoh.geometry.stopping import scan_limit_ns
from gigabrain_zenoh.safety.arm import ArmMonitor
from gigabrain_zenoh.safety.arm_motion import ArmShape
from gigabrain_zenoh.safety.cameras import NO_PICTURES, Pictures
from gigabrain_zenoh.safety.catalogue import MAX_STEP_TICKS, cause
from gigabrain_zenoh.safety.health import (
    SYSTEMS,
    Attitude,
    Bases,
    Host,
    PipelineProgress,
    Power,
    RoundTrip,
    halved,
)
from gigabrain_zenoh.safety.latency import DataLatency
from gigabrain_zenoh.safety.tracking_error import TrackingError
from gigabrain_zenoh.safety.zones import Motion, ProtectiveField

LATCHING_TICKS = 10  # a latching cause is repeated, as a busy gate may miss a verdict
SCANS_TO_START = 2  # by the second, even a slow brain has answered the first


class SafetyInputs(Struct, frozen=True, kw_only=True):
    """Inputs of one verdict."""

    state: RobotState
    scan: LaserScan | None = None  # newest of this boot, however old
    scan_age_ns: int | None = None
    pictures: Pictures = NO_PICTURES  # newest of this boot by camera, however old
    silent: tuple[str, ...] = ()  # systems of the brain without fresh messages
    bases: Bases = Bases()
    command: CmdVel | None = None  # the commander's newest of an earlier tick
    echo_ages: tuple[int, ...] = ()  # of the commander's commands since the last verdict [ticks]
    shock: float = 0.0  # largest horizontal acceleration since then [m/s2]
    host: Host = Host()
    arm: ArmShape | None = None  # from the model of a body with an arm
    arm_problem: str = ""  # why `arm` is missing


class SafetyMemory(Struct, frozen=True, kw_only=True):
    """State of all monitors."""

    boot: int = 0
    tick: int = 0
    caps: SpeedCaps = NO_CAPS  # of the last verdict
    power: Power = Power()
    attitude: Attitude = Attitude()
    tracking: TrackingError = TrackingError()
    round_trip: RoundTrip = RoundTrip()
    latency: DataLatency = DataLatency()
    progress: PipelineProgress = PipelineProgress()
    history: PoseHistory = PoseHistory()
    field: ProtectiveField = ProtectiveField()
    arm: ArmMonitor = ArmMonitor()
    latching: tuple[tuple[int, Cause], ...] = ()  # recent causes, each with its tick


def step(
    body: BodyDescription, memory: SafetyMemory, inputs: SafetyInputs
) -> tuple[SafetyMemory, SafetyState]:
    """Return the next memory and the verdict. Within a tick, only new inputs change it."""
    state, limits = inputs.state, body.thresholds
    if state.boot != memory.boot:  # the driver has restarted
        memory = SafetyMemory(boot=state.boot, tick=state.tick, tracking=TrackingError.start(state))
    memory = _observe(body, memory, inputs)
    stop = _stop_causes(body, memory, inputs)
    latching = _latching(memory.latching, stop, state.tick)
    stop = (*stop, *(one for _, one in latching if one not in stop))
    slow = (*memory.round_trip.causes(limits), *memory.latency.slow_causes(body))
    caps = memory.field.caps(body)
    if slow:
        caps = halved(body, caps)
    held = memory.arm.limits.causes
    verdict = SafetyState(
        verdict="stop" if stop else "slow" if held or caps != NO_CAPS else "ok",
        caps=caps,
        joints=memory.arm.limits.caps,
        causes=(*stop, *slow, *memory.field.causes, *held),
        warnings=(*memory.power.warnings(limits, state), *inputs.host.warnings(limits)),
    )
    return replace(memory, caps=caps, latching=latching), verdict


def _latching(
    recent: tuple[tuple[int, Cause], ...], stop: tuple[Cause, ...], tick: int
) -> tuple[tuple[int, Cause], ...]:
    """Return present and recent latching causes, each code with its newest tick."""
    now = {one.code: (tick, one) for one in stop if one.latching}
    before = (
        (since, one)
        for since, one in recent
        if one.code not in now and 0 <= tick - since < LATCHING_TICKS
    )
    return (*now.values(), *before)


def _observe(body: BodyDescription, memory: SafetyMemory, inputs: SafetyInputs) -> SafetyMemory:
    """Update every monitor."""
    state, limits, command = inputs.state, body.thresholds, inputs.command
    passed = max(0, state.tick - memory.tick)
    elapsed = min(passed, MAX_STEP_TICKS)
    history = memory.history.then(state)
    latency = memory.latency.then(body, state, inputs.scan, history, elapsed)
    late_ticks = latency.late_ticks(body)
    tracking = memory.tracking.then(body, state, command, memory.caps, elapsed, late_ticks)
    obeyed = command if command and command.source == state.gate.commander else None
    motion = Motion(
        measured=state.velocity,
        commanded=tracking.commanded,
        requested=velocity_of(obeyed) if obeyed else ZERO,
    )
    return SafetyMemory(
        boot=memory.boot,
        tick=state.tick,
        caps=memory.caps,
        power=memory.power.then(limits, state, elapsed),
        attitude=memory.attitude.then(limits, state, inputs.shock, elapsed),
        tracking=tracking,
        round_trip=memory.round_trip.then(limits, state.gate.commander, inputs.echo_ages, elapsed),
        latency=latency,
        progress=memory.progress.then(inputs.bases, elapsed),
        history=history,
        field=memory.field.then(body, inputs.scan, state, history, motion, inputs.pictures),
        arm=memory.arm.then(body, state, elapsed, passed, inputs.arm, inputs.arm_problem),
        latching=memory.latching,
    )


def _stop_causes(
    body: BodyDescription, memory: SafetyMemory, inputs: SafetyInputs
) -> tuple[Cause, ...]:
    limits, state, scans = body.thresholds, inputs.state, memory.field.scans
    first = 0 < scans < SCANS_TO_START
    return (
        *_scan_causes(body, memory, inputs),
        *((cause("starting"),) if body.lidar and scans < SCANS_TO_START else ()),
        *memory.progress.causes(limits, state, inputs.silent, first=first, needed=needed(body)),
        *memory.power.causes(limits),
        *memory.attitude.causes,
        *memory.latency.stop_causes(body),
        *memory.tracking.causes(body),
        *memory.arm.causes(body),
    )


def needed(body: BodyDescription) -> tuple[str, ...]:
    """Return the systems that a body needs: without base and lidar, all but perception."""
    return SYSTEMS if body.has_base or body.lidar else SYSTEMS[1:]


def _scan_causes(
    body: BodyDescription, memory: SafetyMemory, inputs: SafetyInputs
) -> tuple[Cause, ...]:
    """Return a cause unless there is a plausible scan, recent by its arrival and its tick.

    A scan with a future tick does not count.
    """
    if body.lidar is None:
        return ()
    if inputs.scan_age_ns is None:
        return (cause("scan_lost", "no scan has come yet"),)
    limit_ns, field = scan_limit_ns(body), memory.field
    seen_ns = (inputs.state.tick - field.basis) * TICK_NS if field.scans else 0
    if max(inputs.scan_age_ns, seen_ns) > limit_ns:
        lost = f"no scan for more than {limit_ns // 1_000_000} ms"
        return (cause("scan_lost", f"{lost}{_future_scan(inputs)}"),)
    return (cause("scan_blind", field.problem),) if field.problem else ()


def _future_scan(inputs: SafetyInputs) -> str:
    scan, tick = inputs.scan, inputs.state.tick
    if scan is None or scan.basis <= tick:
        return ""
    return f"; the newest has the future tick {scan.basis} at tick {tick}"
