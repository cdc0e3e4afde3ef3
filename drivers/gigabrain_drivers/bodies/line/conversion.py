"""Converts velocities to command lines, and state lines to a body's state."""

import math
from collections import deque
from collections.abc import Mapping

from gigabrain_drivers.bodies.line.options import POSE, LineOptions, position_fields, speed_fields
from gigabrain_drivers.bodies.line.protocol import (
    ANGLES,
    BODY,
    STATE,
    LineDecoder,
    Template,
    describe,
)
from gigabrain_drivers.kinematics.wheels import Base, Twist, advance_pose, step_between
from gigabrain_drivers.links.recent import Recent
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import Battery, BodyDescription, Joint

WHEEL = "wheel_"
EXPIRING_FIELDS = tuple(  # their values expire, so that safety does not use old ones
    name for name in STATE if name.startswith("battery_") or name.endswith("_temperature")
)

MIN_REPEATED_FLAGS = 10  # unchanged in a row; then the firmware is known to repeat its flags

VELOCITY_WINDOW_S = 0.05  # for a velocity from positions; single lines show noise
MAX_STEP_FACTOR = 3.0  # a step is rejected if it is faster than the maximum speed by this factor,
STEP_SLACK_M = 0.05  # plus this tolerance for uneven lines
RESTART_GAP_NS = 100_000_000  # after this time without a line, the firmware may have restarted
MAX_INTEGRATION_S = 0.2  # a speed is integrated over at most this time
AT_REST = Twist(0.0, 0.0, 0.0)
ORIGIN = Pose(x=0.0, y=0.0, yaw=0.0)


class LineCommand:
    """Encodes velocities with a template, and computes how its digits round them."""

    def __init__(self, template: Template, base: Base | None) -> None:
        self.template, self._base = template, base
        self._by_wheels = any(name.startswith(WHEEL) for name in template.names)

    def line(self, wanted: Velocity, seq: int) -> bytes:
        """Return the command line for a velocity, rounded toward zero to keep all limits."""
        values = {**self._values(wanted), "seq": float(seq)}
        return self.template.encode(values, toward_zero=True)

    def sent(self, wanted: Velocity) -> Velocity:
        """Return the velocity that the line's digits can express."""
        values = self._values(wanted).items()
        names, sent = self.template.names, self.template.sent
        return self.means({name: sent(name, value) for name, value in values if name in names})

    def means(self, values: Mapping[str, float]) -> Velocity:
        """Return the velocity that a line with these values commands; missing values are 0."""
        twist = Twist(*(values.get(name, 0.0) for name in Twist._fields))
        if self._base and self._by_wheels:
            wheels = zip(self._base.wheels, self._base.to_wheels(twist), strict=True)
            wheel_speeds = tuple(values.get(WHEEL + name, speed) for name, speed in wheels)
            twist = self._base.to_body(wheel_speeds)
        return Velocity(**{name: value + 0.0 for name, value in twist._asdict().items()})  # no -0

    def _values(self, velocity: Velocity) -> dict[str, float]:
        """Return all values that a command line may contain for a velocity."""
        twist = Twist(velocity.linear_x, velocity.linear_y, velocity.angular_z)
        values = twist._asdict()
        if self._base:
            speeds = zip(self._base.wheels, self._base.to_wheels(twist), strict=True)
            values.update({WHEEL + name: speed for name, speed in speeds})
        return values


class SentWording:
    """Describes sent bytes: commands, and the start and stop strings."""

    def __init__(self, template: Template, named: Mapping[bytes, str]) -> None:
        self._decoder, self._named = LineDecoder([template]), named
        self._max_length = max(map(len, named), default=0)
        self._newest = b""

    def feed(self, data: bytes) -> list[str]:
        """Describe the commands and strings that `data` completes."""
        self._newest = (self._newest + data)[-self._max_length - 1 :]
        if name := self._named.get(self._newest):
            self._newest = b""
            self._decoder.clear()
            return [name]
        found = [describe(values) for values in self._decoder.feed(data)]
        if found:
            self._newest = b""
        return found


class LineReport:
    """Collects the newest values of all lines, and integrates the pose.

    It unwraps counters. After a jump, such as a restart of the firmware, it counts from the new
    value.
    """

    def __init__(self, options: LineOptions, body: BodyDescription, base: Base | None) -> None:
        self._options, self._body, self._base = options, body, base
        self._wheels = base.wheels if base else ()
        self._spans = _spans(options, self._wheels)
        self._positions = position_fields(base) if base else ()
        self._speeds = speed_fields(base) if base else ()
        self._pose_fields = frozenset(POSE)
        self._velocity_fields = {*BODY, *self._speeds}
        self._values: dict[str, float] = {}
        self._recent = {name: Recent[float]() for name in EXPIRING_FIELDS}
        self._flags, self._flags_unchanged = Recent[int](), 0  # number of lines in a row
        self._angles: tuple[float, ...] | None = None  # newest reported wheel angles [rad]
        self._pose: Pose | None = None  # newest reported pose
        self._now_ns = 0
        self._period_s, self._spare_s = 1 / options.state_hz, 0.0  # spare time of delayed lines
        self._turned = dict.fromkeys(self._wheels, 0.0)  # rotations since the start [rad]
        self._steps: deque[tuple[float, Twist]] = deque()  # duration [s] and motion of newest lines
        self.pose = ORIGIN  # since the start

    @property
    def flags(self) -> int:
        """The firmware's flags, as bits."""
        return int(self._values.get("flags", 0))

    def flags_overdue(self, now_ns: int) -> bool:
        """Return whether repeated flags are no longer received."""
        return self._flags_unchanged >= MIN_REPEATED_FLAGS and self._flags.get(now_ns) is None

    def update(self, values: Mapping[str, float], now_ns: int) -> None:
        """Handle one line."""
        if "flags" in values:
            unchanged = int(values["flags"]) == self.flags
            self._flags_unchanged = self._flags_unchanged + 1 if unchanged else 0
            self._flags.put(int(values["flags"]), now_ns)
        for name, value in values.items():
            if recent := self._recent.get(name):
                recent.put(value, now_ns)
            else:
                self._values[name] = value
        if self._pose_fields <= values.keys():
            pose = Pose(x=values["x"], y=values["y"], yaw=values["yaw"])
            last, self._pose = self._pose or pose, pose
            step = step_between(last, pose)
            if self._after_gap(now_ns) and _length(step_between(ORIGIN, pose)) < _length(step):
                step = step_between(ORIGIN, pose)
            self._move(step, now_ns)
        elif (angles := _all_of(self._positions, values)) and self._base:
            self._move_wheels(angles, now_ns)
        elif self._velocity_fields & values.keys() and self._pose is None and self._angles is None:
            self._integrate(now_ns)

    def restart(self) -> None:
        """Start counting at the next line, because the connection was cut."""
        self._angles = self._pose = None
        self._now_ns, self._spare_s = 0, 0.0
        self._steps.clear()

    def velocity(self) -> Velocity:
        """Return each part as reported; otherwise from wheel speeds, or from positions."""
        reported, (linear_x, linear_y, angular_z) = self._values, self._measured()
        return Velocity(
            linear_x=reported.get("linear_x", linear_x),
            linear_y=reported.get("linear_y", linear_y),
            angular_z=reported.get("angular_z", angular_z),
        )

    def joints(self, now_ns: int) -> tuple[Joint, ...]:
        """Return the reported wheels."""
        found, known = [], {**self._values, **self._not_expired(now_ns)}
        for name in self._wheels:
            prefix = f"wheel_{name}_"
            values = {k.removeprefix(prefix): v for k, v in known.items() if k.startswith(prefix)}
            if values:
                values["position"] = self._turned[name]
                found.append(Joint(name=f"wheel_{name}_joint", **values))
        return tuple(found)

    def battery(self, now_ns: int) -> Battery | None:
        """Return the battery, with its reported percentage, or one from its voltage."""
        values, volts = self._not_expired(now_ns), self._options.battery_volts()
        voltage, percentage = values.get("battery_voltage"), values.get("battery_percentage")
        if voltage is not None and percentage is None and volts:
            empty, full = volts
            percentage = 100 * (voltage - empty) / (full - empty)
        if percentage is None:
            return None
        return Battery(
            voltage=max(voltage or 0.0, 0.0),
            percentage=min(max(percentage, 0.0), 100.0),
            current=values.get("battery_current", 0.0),
        )

    def _not_expired(self, now_ns: int) -> dict[str, float]:
        found = ((name, recent.get(now_ns)) for name, recent in self._recent.items())
        return {name: value for name, value in found if value is not None}

    def _measured(self) -> Twist:
        """Return the velocity from the wheels' speeds, or from the motion of the newest lines."""
        if self._base and (speeds := _all_of(self._speeds, self._values)):
            return self._base.to_body(speeds)
        seconds = sum(duration for duration, _ in self._steps)
        if not seconds:
            return AT_REST
        motion = Twist(*map(sum, zip(*(step for _, step in self._steps), strict=True)))
        return _scaled(motion, 1 / seconds)

    def _integrate(self, now_ns: int) -> None:
        """Integrate the newest speeds, if the lines report neither pose nor positions."""
        seconds = min((now_ns - (self._now_ns or now_ns)) / 1e9, MAX_INTEGRATION_S)
        v = self.velocity()
        self._move(_scaled(Twist(v.linear_x, v.linear_y, v.angular_z), seconds), now_ns)
        speeds = _all_of(self._speeds, self._values)
        for name, speed in zip(self._wheels if speeds else (), speeds, strict=True):
            turned = self._turned[name] + speed * seconds
            self._turned[name] = speed if name in ANGLES else turned

    def _move_wheels(self, angles: tuple[float, ...], now_ns: int) -> None:
        """Move by the rotation of the wheels to these angles [rad]."""
        assert self._base is not None
        last, self._angles = self._angles or angles, angles
        turned = self._differences(angles, last)
        if self._after_gap(now_ns) and sum(map(abs, angles)) < sum(map(abs, turned)):
            turned = angles
        if self._move(self._base.to_body(turned), now_ns):
            for name, angle in zip(self._wheels, turned, strict=True):
                self._turned[name] = angle if name in ANGLES else self._turned[name] + angle

    def _differences(self, now: tuple[float, ...], before: tuple[float, ...]) -> tuple[float, ...]:
        """Return the rotation of each wheel, and the angles of steering wheels [rad]."""
        steps = []
        for name, angle, last, span in zip(self._wheels, now, before, self._spans, strict=True):
            step = angle if name in ANGLES else angle - last
            steps.append(math.remainder(step, span) if span else step)
        return tuple(steps)

    def _after_gap(self, now_ns: int) -> bool:
        """Return whether the firmware may have restarted since the last line.

        If so, the shorter motion is used: from the last value, or from zero.
        """
        return now_ns - (self._now_ns or now_ns) > RESTART_GAP_NS

    def _move(self, step: Twist, now_ns: int) -> bool:
        """Add a step since the last line to the pose, unless it is too fast; return whether added.

        Delayed lines arrive together, so they share the time before the first of them.
        """
        seconds = (now_ns - (self._now_ns or now_ns)) / 1e9
        self._now_ns = now_ns
        delayed = seconds < self._period_s / 2
        step_s = seconds + self._spare_s if delayed else seconds
        self._spare_s = max(step_s - self._period_s, 0.0)
        body, max_step_s = self._body, MAX_STEP_FACTOR * step_s
        speed = max(body.max_linear_speed, body.max_lateral_speed)
        too_far = math.hypot(step.linear_x, step.linear_y) > speed * max_step_s + STEP_SLACK_M
        if too_far or abs(step.angular_z) > body.max_angular_speed * max_step_s + STEP_SLACK_M:
            step = AT_REST
        self.pose = advance_pose(self.pose, step)
        self._steps.append((seconds, step))
        while sum(duration for duration, _ in self._steps) - self._steps[0][0] >= VELOCITY_WINDOW_S:
            self._steps.popleft()
        return step is not AT_REST


def _all_of(names: tuple[str, ...], values: Mapping[str, float]) -> tuple[float, ...]:
    """Return the values of all names, or an empty tuple if one is missing."""
    return tuple(values[n] for n in names) if all(n in values for n in names) else ()


def _length(step: Twist) -> float:
    return math.hypot(step.linear_x, step.linear_y)


def _scaled(twist: Twist, factor: float) -> Twist:
    return Twist(*(part * factor for part in twist))


def _spans(options: LineOptions, wheels: tuple[str, ...]) -> tuple[float, ...]:
    """Return the angle [rad] where each wheel's counter wraps; 0 without a counter."""
    spans = dict.fromkeys(wheels, 0.0)
    for template in options.state_templates():
        for field in template.fields:
            name = field.name.removeprefix("wheel_").removesuffix("_position")
            if name in spans and field.unit.endswith("tick"):
                spans[name] = abs(field.factor) * 2.0**options.tick_bits
    return tuple(spans[name] for name in wheels)
