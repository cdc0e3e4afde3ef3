"""A body on a text line, described in YAML: the `driver: line` part of a robot's file."""

from typing import Annotated, Literal

from msgspec import Meta

from gigabrain_drivers.bodies.line.fields import COMMAND, IGNORED, STATE
from gigabrain_drivers.bodies.line.protocol import LONGEST, Template
from gigabrain_drivers.driver.robot import LinkOptions
from gigabrain_drivers.links.port_name import AUTO, check_port
from gigabrain_schemas.base import Name, Positive

Text = Annotated[str, Meta(max_length=LONGEST)]
Rate = Annotated[float, Meta(ge=10, le=200)]

BITS_PER_BYTE = 10  # 8N1


class LineOptions(LinkOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is said to the body and what it says; see docs/firmware_line.md."""

    port: str = AUTO  # a path, usb:VID:PID[:SERIAL], or auto
    baud: Annotated[int, Meta(ge=1200, le=4_000_000)] = 115200
    command: Text  # a template: how a velocity is written
    state: Annotated[tuple[Text, ...], Meta(min_length=1, max_length=8)]  # templates, any of which
    start: Text = ""  # sent as it is before the first command, also after a stop
    stop: Text = ""  # sent as it is when the body is stopped, after a command of zero
    command_hz: Rate = 50.0  # how often an unchanged command is repeated; a new one goes at once
    state_hz: Rate = 50.0  # what the firmware promises; three missing ones are a lost link
    ticks_per_turn: Positive | None = None  # of a wheel's encoder; for the unit `tick`
    tick_bits: Literal[16, 32] = 32  # where its count wraps
    battery_empty: Positive | None = None  # [V], 0 %; where the firmware reports the voltage alone
    battery_full: Positive | None = None  # [V], 100 %
    flags: Annotated[tuple[Name, ...], Meta(max_length=32)] = ()  # names of the bits, from bit 0

    def __post_init__(self) -> None:
        command = _template("command", self.command, COMMAND, self.ticks_per_turn)
        if command.names <= {"seq"}:
            raise ValueError("command: it moves nothing; expected {linear_x} or wheel speeds")
        state = self.state_templates()
        seen = frozenset().union(*(template.names for template in state))
        self._check_ends(command, state)
        check_port(self.port)
        self._check_battery(seen)
        self._check_flags(seen)
        self._check_baud(command, state)

    def command_template(self) -> Template:
        """How a velocity is written."""
        return _template("command", self.command, COMMAND, self.ticks_per_turn)

    def state_templates(self) -> tuple[Template, ...]:
        """How what the body measures is read."""
        turn = self.ticks_per_turn
        return tuple(
            _template(f"state[{i}]", text, STATE, turn) for i, text in enumerate(self.state)
        )

    def strings(self) -> dict[bytes, str]:
        """What is sent as it is, and what it is called."""
        both = {self.start.encode(): "start", self.stop.encode(): "stop"}
        return {text: name for text, name in both.items() if text}

    def _check_ends(self, command: Template, state: tuple[Template, ...]) -> None:
        for i, template in enumerate(state):
            if template.end != state[0].end:
                raise ValueError(f"state[{i}]: it must end as the first one does")
            if not template.names:
                raise ValueError(f"state[{i}]: {{{IGNORED}}} alone says nothing; expected a field")
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

    def _check_battery(self, seen: frozenset[str]) -> None:
        if self.battery_empty and self.battery_full and self.battery_empty >= self.battery_full:
            raise ValueError("battery_full: expected more than battery_empty")
        if "battery_voltage" in seen and "battery_percentage" not in seen:
            for name in ("battery_empty", "battery_full"):
                if getattr(self, name) is None:
                    raise ValueError(f"{name}: it is needed where only battery_voltage is reported")

    def _check_flags(self, seen: frozenset[str]) -> None:
        if self.flags and "flags" not in seen:
            raise ValueError("flags: there is no {flags} in any state line")

    def _check_baud(self, command: Template, state: tuple[Template, ...]) -> None:
        for name, longest, rate in (
            ("command", command.longest(), 2 * self.command_hz),  # a new one between two repeats
            ("state", max(template.longest() for template in state), self.state_hz),
        ):
            needed = longest * rate * BITS_PER_BYTE
            if needed > self.baud:
                raise ValueError(
                    f"baud: {name} lines of {longest} bytes at {rate:g} Hz need {needed:.0f}"
                )


def _template(field: str, text: str, known: dict[str, str], turn: float | None) -> Template:
    try:
        return Template(text, known, turn)
    except ValueError as error:
        raise ValueError(f"{field}: {error}") from None
