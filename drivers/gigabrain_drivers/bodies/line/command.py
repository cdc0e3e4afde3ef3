"""A velocity as the numbers of a command line, and what the body makes of those numbers."""

from collections.abc import Mapping

from gigabrain_drivers.bodies.line.protocol import Decoder, Template, describe
from gigabrain_drivers.kinematics import Base, Twist
from gigabrain_schemas.base import Velocity

WHEEL = "wheel_"


class LineCommand:
    """Writes velocities with a template, and knows what its digits leave of them."""

    def __init__(self, template: Template, base: Base | None) -> None:
        self.template, self._base = template, base
        self._by_wheels = any(name.startswith(WHEEL) for name in template.names)

    def line(self, wanted: Velocity, seq: int) -> bytes:
        """The line that asks for a velocity, rounded so that no limit is exceeded."""
        values = {**self._values(wanted), "seq": float(seq)}
        return self.template.encode(values, toward_zero=True)

    def sent(self, wanted: Velocity) -> Velocity:
        """What is left of a velocity after it was written with the line's digits."""
        values = self._values(wanted).items()
        names, sent = self.template.names, self.template.sent
        return self.means({name: sent(name, value) for name, value in values if name in names})

    def means(self, values: Mapping[str, float]) -> Velocity:
        """What a line with these values tells the body; what it does not say is 0."""
        twist = Twist(*(values.get(name, 0.0) for name in Twist._fields))
        if self._base and self._by_wheels:
            wheels = zip(self._base.wheels, self._base.to_wheels(twist), strict=True)
            told = tuple(values.get(WHEEL + name, speed) for name, speed in wheels)
            twist = self._base.to_body(told)
        return Velocity(**{name: value + 0.0 for name, value in twist._asdict().items()})  # no -0

    def _values(self, velocity: Velocity) -> dict[str, float]:
        """All that a command line may say of a velocity."""
        twist = Twist(velocity.linear_x, velocity.linear_y, velocity.angular_z)
        values = twist._asdict()
        if self._base:
            speeds = zip(self._base.wheels, self._base.to_wheels(twist), strict=True)
            values.update({WHEEL + name: speed for name, speed in speeds})
        return values


class Spoken:
    """What goes out on the line, byte after byte: commands, and strings that have a name."""

    def __init__(self, template: Template, named: Mapping[bytes, str]) -> None:
        self._decoder, self._named = Decoder([template]), named
        self._longest = max(map(len, named), default=0)
        self._held = b""

    def feed(self, data: bytes) -> list[str]:
        """In words, what `data` completes."""
        self._held = (self._held + data)[-self._longest - 1 :]
        if name := self._named.get(self._held):
            self._held = b""
            self._decoder.clear()
            return [name]
        found = [describe(values) for values in self._decoder.feed(data)]
        if found:
            self._held = b""
        return found
