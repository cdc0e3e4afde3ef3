"""Monitor of the tracking error: compares the measured with the commanded motion.

The gate's output is not on the bus, so it is computed here as well: the newest command within
limits and caps, ramped. The body may move at any speed between the lowest and the highest recent
output, within a tolerance.
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

WINDOW_TICKS = 15  # 0.3 s: the line's round trip, and the motors' delay
MAX_LATE_TICKS = 30  # added to the window for data that are late
WATCH_TICKS = 100  # 2 s after the gate was active; later a person may push the body

Axes = tuple[float, float, float]
Telemetry = tuple[Pose, Velocity, tuple[Joint, ...], ImuData | None]


class TrackingError(Struct, frozen=True, kw_only=True):
    """Compares commanded and measured motion."""

    commanded: Velocity = ZERO  # present output of the gate
    recent: tuple[Axes, ...] = ()  # outputs of the newest ticks
    telemetry: Telemetry | None = None
    watch_ticks: int = 0  # until motion is no longer judged
    runaway_ticks: int = 0
    slow_ticks: int = 0
    stuck_ticks: int = 0
    frozen_ticks: int = 0  # of commanded motion, since a value last changed

    @classmethod
    def start(cls, state: RobotState) -> "TrackingError":
        """Return the monitor for a first state; its motion counts as commanded."""
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
        """Return whether pose and velocity repeat although the velocity is not 0.

        They may repeat while the body stands, or is held.
        """
        repeats = self.telemetry is not None and self.telemetry[:2] == (state.pose, state.velocity)
        return repeats and not _rests(body, state.velocity)

    def causes(self, body: BodyDescription) -> tuple[Cause, ...]:
        """Return the causes that stop the body.

        Only a new value ends `telemetry_frozen`, even if the body rests in between. Otherwise the
        body could be driven blindly in short moves.
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
    """Return whether the body is faster than commanded, and whether it is slower.

    It is slower if its speed is below all recent outputs. Control corrects deviations, so a share
    of the speed is no fault.
    """
    share = body.control.max_correction
    fast = slow = False
    each = zip(zip(*recent, strict=True), _tolerances(body), axes(measured), strict=True)
    for outputs, tolerance, value in each:
        lowest, highest = min(outputs), max(outputs)
        margin = tolerance + share * max(abs(lowest), abs(highest))
        fast |= value > max(highest, 0.0) + margin or value < min(lowest, 0.0) - margin
        slow |= 0 <= value < lowest - margin or 0 >= value > highest + margin
    return fast, slow
