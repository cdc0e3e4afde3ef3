"""Monitor of the tracking error: whether the measured motion is the commanded one.

The gate's output is not on the bus, so it is computed again here: the newest command within limits
and caps, ramped. The body may move at any speed between the least and the greatest of the recent
outputs, within a tolerance.
"""

from msgspec import Struct
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_S, Cause, Pose, Velocity
from gigabrain_schemas.body import BodyDescription, Joint, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_schemas.sensors import ImuData
from gigabrain_zenoh.geometry.limits import ZERO, Limits, clamp, limits_of, ramp
from gigabrain_zenoh.geometry.pose import axes, velocity_of
from gigabrain_zenoh.safety.catalogue import cause, lasting, ticks_of

WINDOW_TICKS = 15  # 0.3 s for the line to the body and back, and for its motors
MAX_LATE_TICKS = 30  # added to that where data are known to be late
WATCH_TICKS = 100  # after it was last enabled; later a person may push it

Axes = tuple[float, float, float]
Telemetry = tuple[Pose, Velocity, tuple[Joint, ...], ImuData | None]


class TrackingError(Struct, frozen=True, kw_only=True):
    """Compares commanded and measured motion."""

    commanded: Velocity = ZERO  # present output of the gate
    recent: tuple[Axes, ...] = ()  # those of the newest ticks
    telemetry: Telemetry | None = None
    watch_ticks: int = 0  # for which motion is still judged
    runaway_ticks: int = 0
    slow_ticks: int = 0
    stuck_ticks: int = 0
    frozen_ticks: int = 0  # of commanded motion, since a value last changed

    @classmethod
    def start(cls, state: RobotState) -> "TrackingError":
        """Return the monitor for a first state, whose motion is taken as the commanded one."""
        return cls(commanded=state.velocity, recent=(axes(state.velocity),))

    def then(
        self,
        body: BodyDescription,
        state: RobotState,
        command: CmdVel | None,
        caps: SpeedCaps,
        elapsed: int,
        late_ticks: int = 0,
    ) -> "TrackingError":
        """Return the monitor after one more state, whose data are `late_ticks` late."""
        if not elapsed:
            return self
        limits = limits_of(body)
        target = _target(limits, state, command, caps)
        commanded = ramp(self.commanded, target, limits, elapsed * TICK_S)
        recent = (*self.recent, axes(commanded))[-WINDOW_TICKS - MAX_LATE_TICKS :]
        active = state.gate.mode in ("enabled", "stopping")
        watch = WATCH_TICKS if active else max(0, self.watch_ticks - elapsed)
        now = replace(self, commanded=commanded, recent=recent, watch_ticks=watch)
        if not state.link.connected:  # the last values say nothing about the present motion
            return now
        telemetry = (state.pose, state.velocity, state.joints, state.imu)
        moving = _moves(body, commanded)
        stuck = active and moving and _rests(body, state.velocity)
        outputs = recent[-WINDOW_TICKS - min(late_ticks, MAX_LATE_TICKS) :]
        fast, slow = _disobeys(body, outputs, state.velocity)
        same = telemetry == self.telemetry or self._odometry_repeats(body, state)
        return replace(
            now,
            telemetry=telemetry,
            runaway_ticks=lasting(self.runaway_ticks, fast and bool(watch), elapsed),
            slow_ticks=lasting(self.slow_ticks, slow and active, elapsed),
            stuck_ticks=lasting(self.stuck_ticks, stuck, elapsed),
            frozen_ticks=self.frozen_ticks + elapsed * moving if same else 0,
        )

    def _odometry_repeats(self, body: BodyDescription, state: RobotState) -> bool:
        """Return whether pose and velocity repeat while the velocity says that the body moves.

        Those of a body that stands, or is held, may repeat.
        """
        repeats = self.telemetry is not None and self.telemetry[:2] == (state.pose, state.velocity)
        return repeats and not _rests(body, state.velocity)

    def causes(self, body: BodyDescription) -> tuple[Cause, ...]:
        """Return why the body must stop.

        Only a new value ends `telemetry_frozen`, however often the body rests in between: it would
        otherwise be driven blindly in short moves.
        """
        limits = body.thresholds
        found = (
            ("runaway", self.runaway_ticks, limits.follow_sustain),
            ("telemetry_frozen", self.frozen_ticks, limits.frozen_sustain),
            ("not_following", self.slow_ticks, limits.follow_sustain),
            ("stuck", self.stuck_ticks, limits.stuck_sustain),
        )
        return tuple(cause(code) for code, ticks, limit_s in found if ticks >= ticks_of(limit_s))


def _target(limits: Limits, state: RobotState, command: CmdVel | None, caps: SpeedCaps) -> Velocity:
    gate = state.gate
    if gate.mode != "enabled" or command is None or command.source != gate.commander:
        return ZERO
    return clamp(velocity_of(command), limits, caps)


def _tolerances(body: BodyDescription) -> Axes:
    limits = body.thresholds
    return limits.follow_linear, limits.follow_linear, limits.follow_angular


def _moves(body: BodyDescription, commanded: Velocity) -> bool:
    pairs = zip(axes(commanded), _tolerances(body), strict=True)
    return any(abs(value) > tolerance for value, tolerance in pairs)


def _rests(body: BodyDescription, measured: Velocity) -> bool:
    pairs = zip(axes(measured), _tolerances(body), strict=True)
    return all(abs(value) < tolerance / 2 for value, tolerance in pairs)


def _disobeys(
    body: BodyDescription, recent: tuple[Axes, ...], measured: Velocity
) -> tuple[bool, bool]:
    """Return whether the body moves or turns farther from rest than commanded, and less.

    Less counts where it is less than all recent outputs. Control corrects a body that is too slow
    or too fast, so a share of the speed is no fault.
    """
    share = body.control.max_correction
    fast = slow = False
    each = zip(zip(*recent, strict=True), _tolerances(body), axes(measured), strict=True)
    for outputs, tolerance, value in each:
        least, most = min(outputs), max(outputs)
        margin = tolerance + share * max(abs(least), abs(most))
        fast |= value > max(most, 0.0) + margin or value < min(least, 0.0) - margin
        slow |= 0 <= value < least - margin or 0 >= value > most + margin
    return fast, slow
