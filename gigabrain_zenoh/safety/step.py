"""One verdict: the monitors side by side. A pure function; what they remember is in Memory."""

import msgspec
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS, Cause, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.limits import NO_CAPS, ZERO
from gigabrain_zenoh.geometry.pose import PoseHistory
from gigabrain_zenoh.geometry.stopping import scan_limit_ns
from gigabrain_zenoh.safety import (
    attitude,
    following,
    host,
    late,
    power,
    progress,
    round_trip,
    zones,
)
from gigabrain_zenoh.safety.attitude import Attitude
from gigabrain_zenoh.safety.following import Following
from gigabrain_zenoh.safety.host import Host
from gigabrain_zenoh.safety.late import Late
from gigabrain_zenoh.safety.power import Power
from gigabrain_zenoh.safety.progress import Bases, Progress
from gigabrain_zenoh.safety.round_trip import RoundTrip
from gigabrain_zenoh.safety.sustain import LONGEST_STEP_TICKS
from gigabrain_zenoh.safety.words import say
from gigabrain_zenoh.safety.zones import Field, Motion

SCANS_TO_START = 2  # whoever answers the first has been heard by the second, however slow


class Inputs(msgspec.Struct, frozen=True, kw_only=True):
    """What safety looks at."""

    state: RobotState
    scan: LaserScan | None = None  # newest of this boot, however old
    scan_age_ns: int | None = None
    silent: tuple[str, ...] = ()  # of which of the three systems nothing is heard
    bases: Bases = Bases()
    command: CmdVel | None = None  # newest of an earlier tick, whoever sent it
    echo_ages: tuple[int, ...] = ()  # of the commander's commands since the last verdict [ticks]
    shock: float = 0.0  # hardest horizontal acceleration since then [m/s2]
    host: Host = Host()


class Memory(msgspec.Struct, frozen=True, kw_only=True):
    """What safety remembers from tick to tick."""

    boot: int = 0
    tick: int = 0
    caps: SpeedCaps = NO_CAPS  # as last said
    power: Power = Power()
    attitude: Attitude = Attitude()
    following: Following = Following()
    round_trip: RoundTrip = RoundTrip()
    late: Late = Late()
    progress: Progress = Progress()
    history: PoseHistory = PoseHistory()
    field: Field = Field()


def step(body: BodyDescription, memory: Memory, inputs: Inputs) -> tuple[Memory, SafetyState]:
    """One verdict. Asked again within a tick, it has changed only by what has come since."""
    state = inputs.state
    if state.boot != memory.boot:  # the driver has started anew
        memory = Memory(boot=state.boot, tick=state.tick, following=following.begin(state))
    memory = _look(body, memory, inputs)
    stop = _stops(body, memory, inputs)
    slow = (
        *round_trip.causes(body.thresholds, memory.round_trip),
        *late.slows(body, memory.late),
    )
    caps = zones.caps(body, memory.field)
    if slow:
        caps = round_trip.halved(body, caps)
    verdict = SafetyState(
        verdict="stop" if stop else "slow" if caps != NO_CAPS else "ok",
        caps=caps,
        causes=(*stop, *slow, *zones.causes(memory.field)),
        warnings=(
            *power.warnings(body.thresholds, memory.power, state),
            *host.warnings(body.thresholds, inputs.host),
        ),
    )
    return replace(memory, caps=caps), verdict


def _look(body: BodyDescription, memory: Memory, inputs: Inputs) -> Memory:
    """Every monitor takes in what is new."""
    state, limits = inputs.state, body.thresholds
    elapsed = min(max(0, state.tick - memory.tick), LONGEST_STEP_TICKS)
    history = memory.history.then(state)
    lateness = late.look(body, memory.late, state, inputs.scan, history, elapsed)
    followed = following.look(
        body,
        memory.following,
        state,
        inputs.command,
        memory.caps,
        elapsed,
        late.ticks_of_body(body, lateness),
    )
    motion = Motion(
        measured=state.velocity, told=followed.told, wanted=_wanted(state, inputs.command)
    )
    return Memory(
        boot=memory.boot,
        tick=state.tick,
        caps=memory.caps,
        power=power.look(limits, memory.power, state, elapsed),
        attitude=attitude.look(limits, memory.attitude, state, inputs.shock, elapsed),
        following=followed,
        round_trip=round_trip.look(limits, memory.round_trip, inputs.echo_ages, elapsed),
        late=lateness,
        progress=progress.look(memory.progress, inputs.bases, elapsed),
        history=history,
        field=zones.look(body, memory.field, inputs.scan, state, history, motion),
    )


def _wanted(state: RobotState, command: CmdVel | None) -> Velocity:
    if command is None or command.source != state.gate.commander:
        return ZERO
    return Velocity(
        linear_x=command.linear_x, linear_y=command.linear_y, angular_z=command.angular_z
    )


def _stops(body: BodyDescription, memory: Memory, inputs: Inputs) -> tuple[Cause, ...]:
    """All that the body must stop for."""
    limits, state = body.thresholds, inputs.state
    first = 0 < memory.field.scans < SCANS_TO_START
    return (
        *_blind(body, memory, inputs),
        *_starting(body, memory),
        *progress.causes(limits, memory.progress, state, inputs.silent, first=first),
        *power.causes(limits, memory.power),
        *attitude.causes(memory.attitude),
        *late.stops(body, memory.late),
        *following.causes(body, memory.following),
    )


def _starting(body: BodyDescription, memory: Memory) -> tuple[Cause, ...]:
    return (say("starting"),) if body.lidar and memory.field.scans < SCANS_TO_START else ()


def _of_the_future(inputs: Inputs) -> str:
    scan, tick = inputs.scan, inputs.state.tick
    if scan is None or scan.basis <= tick:
        return ""
    return f"; the newest claims to be of tick {scan.basis}, and it is tick {tick}"


def _blind(body: BodyDescription, memory: Memory, inputs: Inputs) -> tuple[Cause, ...]:
    """A scan must have come of late, by its arrival and by its own tick, and be believable.

    One that claims to be of the future is never looked at, and does not hide that none has come.
    """
    if body.lidar is None:
        return ()
    if inputs.scan_age_ns is None:
        return (say("scan_lost", "no scan has come yet"),)
    limit_ns = scan_limit_ns(body)
    looked_ns = (inputs.state.tick - memory.field.basis) * TICK_NS if memory.field.scans else 0
    if max(inputs.scan_age_ns, looked_ns) > limit_ns:
        lost = f"no scan for more than {limit_ns // 1_000_000} ms"
        return (say("scan_lost", f"{lost}{_of_the_future(inputs)}"),)
    if memory.field.problem:
        return (say("scan_blind", memory.field.problem),)
    return ()
