"""Whether the measured motion is the one that was commanded.

The gate's speeds are not on the bus, so they are worked out again here: the newest command within
limits and caps, ramped. The body may be anywhere between the least and the most that it was told of
late, give or take a tolerance.
"""

import msgspec
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS, Cause, Pose, Velocity
from gigabrain_schemas.body import BodyDescription, Joint, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_schemas.sensors import ImuData
from gigabrain_zenoh.geometry.limits import ZERO, clamp, limits_of, ramp
from gigabrain_zenoh.safety.sustain import held, ticks_of
from gigabrain_zenoh.safety.words import say

WINDOW_TICKS = 15  # 0.3 s for the way to the body and back, and for its motors
MOST_LATE_TICKS = 30  # by which that may take longer where data are known to be late
WATCHED_TICKS = 100  # after it was last enabled; later a person may well push it
TICK_S = TICK_NS / 1e9

Bands = tuple[tuple[float, float, float], ...]
Telemetry = tuple[Pose, Velocity, tuple[Joint, ...], ImuData | None]


class Following(msgspec.Struct, frozen=True, kw_only=True):
    """What is remembered of commands and motion."""

    told: Velocity = ZERO  # what the gate lets through now
    recent: tuple[Velocity, ...] = ()  # that of the newest ticks
    telemetry: Telemetry | None = None
    watched_ticks: int = 0  # for how long it is judged yet
    runaway_ticks: int = 0
    slow_ticks: int = 0
    stuck_ticks: int = 0
    frozen_ticks: int = 0  # of motion, all together, since a value last changed


def begin(state: RobotState) -> Following:
    """Nothing is known yet of what it was told: it is taken to do just that."""
    return Following(told=state.velocity, recent=(state.velocity,))


def look(
    body: BodyDescription,
    before: Following,
    state: RobotState,
    command: CmdVel | None,
    caps: SpeedCaps,
    elapsed: int,
    late_ticks: int = 0,
) -> Following:
    """One state more, `elapsed` ticks after the last; its data are `late_ticks` late."""
    if not elapsed:
        return before
    told = ramp(before.told, _target(body, state, command, caps), limits_of(body), elapsed * TICK_S)
    recent = (*before.recent, told)[-WINDOW_TICKS - MOST_LATE_TICKS :]
    bands = _bands(body, recent[-WINDOW_TICKS - min(late_ticks, MOST_LATE_TICKS) :])
    active = state.gate.mode in ("enabled", "stopping")
    watched = WATCHED_TICKS if active else max(0, before.watched_ticks - elapsed)
    now = replace(before, told=told, recent=recent, watched_ticks=watched)
    if not state.link.connected:  # what the body said last is no evidence of what it does now
        return now
    telemetry = (state.pose, state.velocity, state.joints, state.imu)
    moving = _moves(body, told)
    still = moving and _rests(body, state.velocity)
    same = telemetry == before.telemetry
    return replace(
        now,
        telemetry=telemetry,
        runaway_ticks=held(
            before.runaway_ticks, bool(watched) and _too_fast(bands, state.velocity), elapsed
        ),
        slow_ticks=held(before.slow_ticks, active and _too_slow(bands, state.velocity), elapsed),
        stuck_ticks=held(before.stuck_ticks, active and still, elapsed),
        frozen_ticks=before.frozen_ticks + elapsed * moving if same else 0,
    )


def causes(body: BodyDescription, now: Following) -> tuple[Cause, ...]:
    """Why the body must stop."""
    limits = body.thresholds
    found = []
    if now.runaway_ticks >= ticks_of(limits.follow_sustain):
        found.append(say("runaway"))
    if _is_frozen(body, now):
        found.append(say("telemetry_frozen"))
    if now.slow_ticks >= ticks_of(limits.follow_sustain):
        found.append(say("not_following"))
    if now.stuck_ticks >= ticks_of(limits.stuck_sustain):
        found.append(say("stuck"))
    return tuple(found)


def _is_frozen(body: BodyDescription, now: Following) -> bool:
    """Whether the body has repeated itself for too long while it was to move.

    Only a new value ends that, however often the body rests in between: one that was stopped for
    it, or is told to move in short moves, would otherwise be driven blindly.
    """
    return now.frozen_ticks >= ticks_of(body.thresholds.frozen_sustain)


def _target(
    body: BodyDescription, state: RobotState, command: CmdVel | None, caps: SpeedCaps
) -> Velocity:
    gate = state.gate
    if gate.mode != "enabled" or command is None or command.source != gate.commander:
        return ZERO
    wanted = Velocity(
        linear_x=command.linear_x, linear_y=command.linear_y, angular_z=command.angular_z
    )
    return clamp(wanted, limits_of(body), caps)


def _axes(of: Velocity) -> tuple[float, float, float]:
    return of.linear_x, of.linear_y, of.angular_z


def _tolerances(body: BodyDescription) -> tuple[float, float, float]:
    limits = body.thresholds
    return limits.follow_linear, limits.follow_linear, limits.follow_angular


def _moves(body: BodyDescription, told: Velocity) -> bool:
    pairs = zip(_axes(told), _tolerances(body), strict=True)
    return any(abs(value) > tolerance for value, tolerance in pairs)


def _rests(body: BodyDescription, measured: Velocity) -> bool:
    pairs = zip(_axes(measured), _tolerances(body), strict=True)
    return all(abs(value) < tolerance / 2 for value, tolerance in pairs)


def _bands(body: BodyDescription, recent: tuple[Velocity, ...]) -> Bands:
    """Per axis: the least and the most that it was told of late, and the tolerance round them.

    Control corrects a body that is too slow or too fast, so a share of the speed is no fault.
    """
    share = body.control.max_correction
    axes = zip(*map(_axes, recent), strict=True)
    return tuple(
        (min(told), max(told), tolerance + share * max(abs(min(told)), abs(max(told))))
        for told, tolerance in zip(axes, _tolerances(body), strict=True)
    )


def _too_fast(bands: Bands, measured: Velocity) -> bool:
    """Whether it moves or turns farther from rest than it was told."""
    return any(
        value > max(most, 0.0) + margin or value < min(least, 0.0) - margin
        for (least, most, margin), value in zip(bands, _axes(measured), strict=True)
    )


def _too_slow(bands: Bands, measured: Velocity) -> bool:
    """Whether it moves or turns less than it was told all the while."""
    return any(
        0 <= value < least - margin or 0 >= value > most + margin
        for (least, most, margin), value in zip(bands, _axes(measured), strict=True)
    )
