"""Options of `driver: line` in a robot's file, and checks that the lines fit the body.

Each check raises ValueError as `FIELD: what is wrong; what was expected`.
"""

from collections.abc import Iterable
from typing import Annotated, Literal

from msgspec import Meta

from gigabrain_drivers.bodies.line.protocol import (
    ANGLES,
    COMMAND,
    IGNORED,
    MAX_LINE_BYTES,
    STATE,
    Template,
)
from gigabrain_drivers.driver.robot import LinkOptions, RobotFile
from gigabrain_drivers.kinematics.wheels import (
    Ackermann,
    Base,
    Differential,
    SkidSteer,
    Twist,
    missing_measures,
    wheels_of,
)
from gigabrain_drivers.links.serial_link import AUTO, check_port
from gigabrain_schemas.base import Name, Positive

Text = Annotated[str, Meta(max_length=MAX_LINE_BYTES)]
Rate = Annotated[float, Meta(ge=10, le=200)]

BITS_PER_BYTE = 10  # 8N1

MAX_STEP_SHARE = 0.1  # largest resolution of a command, as a share of the maximum speed
WHEEL_PARTS = ("_position", "_velocity", "_effort", "_temperature")
SIDES = ("wheel_left", "wheel_right")
POSE = ("x", "y", "yaw")


class LineOptions(LinkOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The lines to and from the body; see docs/reference/firmware_line.md."""

    port: str = AUTO  # a path, usb:VID:PID[:SERIAL], or auto
    baud: Annotated[int, Meta(ge=1200, le=4_000_000)] = 115200
    command: Text  # template of the command line
    state: Annotated[tuple[Text, ...], Meta(min_length=1, max_length=8)]  # templates of state lines
    start: Text = ""  # sent unchanged before the first command, also after a stop
    stop: Text = ""  # sent unchanged when the body is stopped, after a command of zero
    command_hz: Rate = 50.0  # repetition of an unchanged command; a new one is sent at once
    state_hz: Rate = 50.0  # rate of the firmware; the link is lost after three missing lines
    ticks_per_turn: Positive | None = None  # of a wheel's encoder; for the unit `tick`
    tick_bits: Literal[16, 32] = 32  # width of the encoder's counter
    battery_empty: Positive | None = None  # [V], 0 %; for a firmware that reports only the voltage
    battery_full: Positive | None = None  # [V], 100 %
    flags: Annotated[tuple[Name, ...], Meta(max_length=32)] = ()  # names of the bits, from bit 0

    def __post_init__(self) -> None:
        command = _template("command", self.command, COMMAND, self.ticks_per_turn)
        if command.names <= {"seq"}:
            raise ValueError("command: it moves nothing; expected {linear_x} or wheel speeds")
        state = self.state_templates()
        reported = frozenset().union(*(template.names for template in state))
        self._check_ends(command, state)
        check_port(self.port)
        self._check_battery(reported)
        self._check_flags(reported)
        self._check_baud(command, state)

    def battery_volts(self) -> tuple[float, float] | None:
        """Return the voltages for 0 % and 100 %, if both are given."""
        if self.battery_empty is None or self.battery_full is None:
            return None
        return self.battery_empty, self.battery_full

    def command_template(self) -> Template:
        """Return the template of the command line."""
        return _template("command", self.command, COMMAND, self.ticks_per_turn)

    def state_templates(self) -> tuple[Template, ...]:
        """Return the templates of the state lines."""
        per_turn = self.ticks_per_turn
        return tuple(
            _template(f"state[{i}]", text, STATE, per_turn) for i, text in enumerate(self.state)
        )

    def strings(self) -> dict[bytes, str]:
        """Return the names of the start and stop strings."""
        both = {self.start.encode(): "start", self.stop.encode(): "stop"}
        return {text: name for text, name in both.items() if text}

    def _check_ends(self, command: Template, state: tuple[Template, ...]) -> None:
        for i, template in enumerate(state):
            if template.end != state[0].end:
                raise ValueError(f"state[{i}]: it must end as the first one does")
            if not template.names:
                raise ValueError(
                    f"state[{i}]: {{{IGNORED}}} alone reports nothing; expected a field"
                )
            for earlier in range(i):
                if state[earlier].reads_all_of(template):
                    raise ValueError(
                        f"state[{i}]: its lines look like those of state[{earlier}]; expected "
                        "another beginning, or another number of fields"
                    )
        for name in ("start", "stop"):
            text = getattr(self, name)
            if text and not text.endswith(("\n", "\r")):
                raise ValueError(f"{name}: expected a newline (\\n) at its end")

    def _check_battery(self, reported: frozenset[str]) -> None:
        if self.battery_empty and self.battery_full and self.battery_empty >= self.battery_full:
            raise ValueError("battery_full: expected more than battery_empty")
        if "battery_voltage" in reported and "battery_percentage" not in reported:
            for name in ("battery_empty", "battery_full"):
                if getattr(self, name) is None:
                    raise ValueError(f"{name}: it is needed where only battery_voltage is reported")

    def _check_flags(self, reported: frozenset[str]) -> None:
        if self.flags and "flags" not in reported:
            raise ValueError("flags: there is no {flags} in any state line")

    def _check_baud(self, command: Template, state: tuple[Template, ...]) -> None:
        for name, longest, rate in (
            ("command", command.longest(), 2 * self.command_hz),  # new ones between repeated ones
            ("state", max(template.longest() for template in state), self.state_hz),
        ):
            needed = longest * rate * BITS_PER_BYTE
            if needed > self.baud:
                raise ValueError(
                    f"baud: {name} lines of {longest} bytes at {rate:g} Hz need {needed:.0f}"
                )


def _template(field: str, text: str, known: dict[str, str], per_turn: float | None) -> Template:
    try:
        return Template(text, known, per_turn)
    except ValueError as error:
        raise ValueError(f"{field}: {error}") from None


def check_lines(options: LineOptions, robot: RobotFile) -> None:
    """Check the lines against the body: its wheels, steps, odometry and lidar."""
    base, command, state = (
        base_of(options, robot), options.command_template(), options.state_templates(),
    )  # fmt: skip
    for field, template in {"command": command, **_by_name(state)}.items():
        _check_wheels(field, template, robot, base)
    _check_command(command, robot, base)
    _check_steps(command, robot, base)
    _check_odometry(state, base)
    _check_motion(state, robot, base)
    if robot.lidar and options.scan is None:
        raise ValueError(
            "scan: `lidar` says that the body has one; expected where its scans come from, such "
            "as {driver: ld19, port: usb:10c4:ea60}, or no `lidar`"
        )


def base_of(options: LineOptions, robot: RobotFile) -> Base | None:
    """Return the base whose wheels are in the lines; of skid steer, perhaps one per side."""
    base = wheels_of(robot)
    templates = (options.command_template(), *options.state_templates())
    sides = any(name.startswith(SIDES) for template in templates for name in template.names)
    if isinstance(base, SkidSteer) and sides:
        return Differential(base.radius, base.effective_track)
    return base


def speed_fields(base: Base) -> tuple[str, ...]:
    """Return the state fields with a base's velocity; for steering, its angle."""
    return tuple(f"wheel_{n}_{'position' if n in ANGLES else 'velocity'}" for n in base.wheels)


def position_fields(base: Base) -> tuple[str, ...]:
    """Return the state fields with a base's wheel angles."""
    return tuple(f"wheel_{name}_position" for name in base.wheels)


def velocity_fields(options: LineOptions, robot: RobotFile) -> frozenset[str]:
    """Return the state fields, in all lines, that determine the body's velocity."""
    reported = frozenset[str]().union(*(template.names for template in options.state_templates()))
    axes, base = _axes(robot), base_of(options, robot)
    direct = reported.intersection(axes)
    if len(direct) == len(axes):
        return direct
    speeds, positions = ((speed_fields(base),), (position_fields(base),)) if base else ((), ())
    return direct.union(next(filter(reported.issuperset, (*speeds, POSE, *positions)), ()))


def _by_name(state: tuple[Template, ...]) -> dict[str, Template]:
    return {f"state[{i}]": template for i, template in enumerate(state)}


def _check_wheels(field: str, template: Template, robot: RobotFile, base: Base | None) -> None:
    known = {f"wheel_{n}{part}" for n in base.wheels for part in ("", *WHEEL_PARTS)} if base else ()
    for name in sorted(template.names):
        if not name.startswith("wheel_") or name in known:
            continue
        if missing := missing_measures(robot):
            raise ValueError(
                f"{field}: {{{name}}} on a {robot.drive_type} base needs its "
                f"{' and '.join(missing)} at the top of this file, above 0"
            )
        wheels = ", ".join(base.wheels) if base else "none"
        raise ValueError(f"{field}: no {name} on a {robot.drive_type} base; its wheels: {wheels}")


def _check_command(command: Template, robot: RobotFile, base: Base | None) -> None:
    body = _axes(robot)
    choices = [body]
    if base:
        choices.append([f"wheel_{name}" for name in base.wheels])
    if isinstance(base, Ackermann):
        choices.append(["linear_x", "wheel_steering"])
    names = command.names - {"seq"}
    if any(names == set(choice) for choice in choices) or names == {*body, "linear_y"}:
        return
    nearest = max(choices, key=lambda choice: len(names & set(choice)))
    if missing := [name for name in nearest if name not in names]:
        wrong = f"no {_braced(missing)}"
    else:
        wrong = f"{_braced(sorted(names - set(nearest)))} beside {_braced(nearest)}"
    needs = ", or ".join(_braced(choice) for choice in choices)
    raise ValueError(f"command: {wrong}; a {robot.drive_type} base needs {needs}")


def _check_steps(command: Template, robot: RobotFile, base: Base | None) -> None:
    limits = {
        "linear_x": robot.max_linear_speed,
        "linear_y": robot.max_lateral_speed,
        "angular_z": robot.max_angular_speed,
    }
    if base:
        fastest = base.to_wheels(Twist(robot.max_linear_speed, 0.0, 0.0))
        limits |= {f"wheel_{n}": abs(v) for n, v in zip(base.wheels, fastest, strict=True)}
    if isinstance(base, Ackermann):
        limits["wheel_steering"] = base.max_steering
    for field in command.fields:
        limit = limits.get(field.name, 0.0)
        if limit and field.step > MAX_STEP_SHARE * limit:
            raise ValueError(
                f"command: {{{field.name}}}: its smallest step is {field.step:.3g}, the most that "
                f"the body does {limit:.3g} (in SI units); expected more decimals or a smaller unit"
            )


def _check_odometry(state: tuple[Template, ...], base: Base | None) -> None:
    """Check that one line has the whole pose, or all wheel positions, if any line has one."""
    for fields in (POSE, position_fields(base) if base else ()):
        distances = {
            n for n in fields if n.removeprefix("wheel_").removesuffix("_position") not in ANGLES
        }
        for i, template in enumerate(state):
            missing = [name for name in fields if name not in template.names]
            if template.names & distances and missing:
                raise ValueError(
                    f"state[{i}]: {_braced(fields)} must stand in one line, or none of them; "
                    f"in this one there is no {_braced(missing)}"
                )


def _check_motion(state: tuple[Template, ...], robot: RobotFile, base: Base | None) -> None:
    """Check that every motion of the body is measured."""
    reported = frozenset[str]().union(*(template.names for template in state))
    alternatives = [POSE, *((position_fields(base), speed_fields(base)) if base else ())]
    if any(reported.issuperset(fields) for fields in alternatives):
        return
    axes = _axes(robot)
    missing = [name for name in axes if name not in reported]
    if missing:
        what = _braced(missing) if len(missing) < len(axes) else "how the body moves"
        choices = ", or ".join(_braced(fields) for fields in (axes, *alternatives))
        raise ValueError(f"state: no field reports {what}; expected {choices}")


def _axes(robot: RobotFile) -> list[str]:
    """Return the names of the body's velocity components."""
    return ["linear_x", *(["linear_y"] if robot.max_lateral_speed else []), "angular_z"]


def _braced(names: Iterable[str]) -> str:
    texts = [f"{{{name}}}" for name in names]
    return " and ".join(filter(None, (", ".join(texts[:-1]), texts[-1])))
