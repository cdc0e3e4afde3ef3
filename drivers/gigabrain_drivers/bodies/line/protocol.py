"""Lines of text with numbers, which a template encodes and decodes.

A template is the line on the wire, with `{FIELD}`, `{FIELD|UNIT}` or `{FIELD|UNIT:FORMAT}` in place
of each number: `V,{linear_x:.3f},{angular_z:.3f}` and a newline. A checksum (`{crc16}`, see CHECKS)
is the last field, and covers the text before it. As in NMEA 0183, it does not cover a `$` at the
start, nor a `*` right before the checksum.
"""

import binascii
import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from gigabrain_drivers.kinematics.wheels import Ackermann, Differential, Mecanum, Omni
from gigabrain_drivers.links.frames import crc_table, xor_of
from gigabrain_zenoh.errors import unknown

_CRC8_TABLE = crc_table(0x07, bits=8)

DRIVES = (Differential, Mecanum, Omni, Ackermann)
WHEELS = tuple(dict.fromkeys(name for drive in DRIVES for name in drive.wheels))
ANGLES = ("steering",)  # names in WHEELS that are commanded by angle, not speed
IGNORED = "_"  # name of ignored numbers in a state line
UNITS = {
    "length": {"m": 1.0, "cm": 0.01, "mm": 0.001},
    "speed": {"m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001},
    "angle": {
        "rad": 1.0, "mrad": 0.001, "deg": math.radians(1), "turn": math.tau, "tick": math.nan,
    },
    "turning speed": {
        "rad/s": 1.0, "mrad/s": 0.001, "deg/s": math.radians(1), "rpm": math.tau / 60,
        "tick/s": math.nan,
    },
    "torque": {"Nm": 1.0, "mNm": 0.001},
    "temperature": {"C": 1.0},
    "voltage": {"V": 1.0, "mV": 0.001},
    "current": {"A": 1.0, "mA": 0.001},
    "share": {"%": 1.0},
    "count": {"": 1.0},
    "flags": {"": 1.0},
    "number": {"": 1.0},
}  # fmt: skip
BODY = {"linear_x": "speed", "linear_y": "speed", "angular_z": "turning speed"}
COMMAND = {
    **BODY,
    "seq": "count",
    **{f"wheel_{name}": "angle" if name in ANGLES else "turning speed" for name in WHEELS},
}
STATE = {
    **BODY,
    "x": "length",
    "y": "length",
    "yaw": "angle",
    **{f"wheel_{name}_position": "angle" for name in WHEELS},
    **{f"wheel_{name}_velocity": "turning speed" for name in WHEELS},
    **{f"wheel_{name}_effort": "torque" for name in WHEELS},
    **{f"wheel_{name}_temperature": "temperature" for name in WHEELS},
    "battery_voltage": "voltage",
    "battery_current": "current",
    "battery_percentage": "share",
    "flags": "flags",
    IGNORED: "number",
}
DEFAULT_FORMATS = {"count": "d", "flags": "x"}
_UNIT = re.compile(r"\s*([-+]?[0-9]*\.?[0-9]*)\s*([A-Za-z%].*?)?\s*")
ROUNDING = 1e-6  # of the last digit: error of binary fractions
_FORMAT = re.compile(r"\+?0?[0-9]{0,2}(?:(?:\.[0-9])?f|d|[xX])")
_ANY_NUMBER = r" *[-+]?[0-9]{1,12}(?:\.[0-9]{0,9})?"
MAX_LINE_BYTES = 256
MAX_VALUE = 1e8  # in SI units; larger numbers are invalid, except counters
DIGITS = "0123456789."  # characters that would continue a number
_FIELD = re.compile(r"\{([^{}|:]*)(?:\|([^{}|:]*))?(?::([^{}]*))?\}")


class Check(NamedTuple):
    """A checksum, and its number of hexadecimal digits."""

    of: Callable[[bytes], int]
    digits: int


def crc8(data: bytes) -> int:
    """Return the CRC-8: polynomial 0x07, initial 0, not reflected; 0xF4 for "123456789"."""
    crc = 0
    for byte in data:
        crc = _CRC8_TABLE[crc ^ byte]
    return crc


def crc16(data: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE: polynomial 0x1021, initial 0xFFFF; 0x29B1 for "123456789"."""
    return binascii.crc_hqx(data, 0xFFFF)


def crc32(data: bytes) -> int:
    """Return the CRC-32 of Ethernet and zlib; 0xCBF43926 for "123456789"."""
    return zlib.crc32(data)


CHECKS = {
    "xor8": Check(xor_of, 2),
    "crc8": Check(crc8, 2),
    "crc16": Check(crc16, 4),
    "crc32": Check(crc32, 8),
}


def factor(quantity: str, unit: str, ticks_per_turn: float | None) -> float:
    """Return the factor from a number on the wire to SI units (also volts, degrees C, percent).

    A unit may have a number or sign before it: with `0.1C`, the wire counts tenths of degrees, and
    with `-tick`, negative ticks. Raises ValueError with the expected units.
    """
    known = UNITS[quantity]
    match = _UNIT.fullmatch(unit)
    name = (match[2] or "") if match else ""
    if match is None or (name not in known and not (name == "" and not unit.strip())):
        choices = " or ".join(filter(None, known)) or "no unit"
        raise ValueError(f"it is a {quantity}: expected {choices}, got {unit!r}")
    unit_factor = known[name] if name in known else next(iter(known.values()))
    if name.startswith("tick"):
        if not ticks_per_turn:
            raise ValueError(f"{name!r} needs `ticks_per_turn`")
        unit_factor = math.tau / ticks_per_turn
    number = match[1] + "1" if match[1] in ("", "+", "-") else match[1]
    try:
        scale = float(number)
    except ValueError:
        scale = 0.0
    if scale == 0.0:
        raise ValueError(f"expected a number other than 0 before the unit, got {unit!r}")
    return scale * unit_factor


@dataclass(frozen=True)
class Field:
    """A number in a line."""

    name: str
    unit: str
    factor: float  # SI value / number on the wire
    format: str  # for Python's format(); values of d, x and X are rounded first
    pattern: str  # regular expression of the number

    @property
    def is_counter(self) -> bool:
        """True for ticks or flags, whose value is not limited."""
        return self.unit.endswith("tick") or self.format[-1] in "xX"

    @property
    def step(self) -> float:
        """The resolution on the wire, in SI units."""
        if self.format[-1] != "f":
            return abs(self.factor)
        return abs(self.factor) * 10.0 ** -_places(self.format)

    def write(self, value: float, *, toward_zero: bool = False) -> str:
        """Return the text of a value in SI units, rounded to the format; zero has no sign."""
        wire = value / self.factor
        if toward_zero:
            places = 10.0 ** _places(self.format) if self.format[-1] == "f" else 1.0
            wire = math.copysign(math.floor(abs(wire) * places + ROUNDING), wire) / places
        if self.format[-1] != "f":
            return format(round(wire), self.format)
        text = format(wire, self.format)
        return format(0.0, self.format) if float(text) == 0 else text

    def read(self, text: str) -> float:
        """Return the value of a text, in SI units. The text must match the pattern."""
        return (int(text, 16) if self.format[-1] in "xX" else float(text)) * self.factor + 0.0


def parse_field(
    name: str, unit: str | None, form: str | None, known: Mapping[str, str], per_turn: float | None
) -> Field:
    """Return the field between two braces. Raises ValueError with the field's name."""
    if name in CHECKS:
        raise ValueError(f"the checksum {{{name}}} must stand last in the line")
    if name not in known:
        raise ValueError(str(unknown("field", name, [*known, *CHECKS])))
    quantity, unit = known[name], (unit or "").strip()
    try:
        scale = factor(quantity, unit, per_turn)
    except ValueError as error:
        raise ValueError(f"{{{name}}}: {error}") from None
    if form is None:
        pattern = "[0-9A-Fa-f]{1,8}" if quantity == "flags" else _ANY_NUMBER
        plain = "d" if unit.lstrip("-") in ("tick", "tick/s") else ".3f"
        return Field(name, unit, scale, DEFAULT_FORMATS.get(quantity, plain), pattern)
    if not _FORMAT.fullmatch(form):
        raise ValueError(f"{{{name}}}: expected a format such as .3f, d or 02x, got {form!r}")
    if form[-1] in "xX" and quantity not in DEFAULT_FORMATS:
        raise ValueError(f"{{{name}}}: a {quantity} has a sign; expected .3f or d, got {form!r}")
    return Field(name, unit, scale, form, _pattern(form))


def _places(form: str) -> int:
    """Return the number of decimals of a format ending in `f`."""
    _, dot, digits = form.rstrip("f").partition(".")
    return int(digits) if dot else 6


def _pattern(form: str) -> str:
    """Return a regular expression that matches exactly the numbers of this format."""
    sign = "[-+]" if form.startswith("+") else "-?"
    padding = " *" if len(form.rstrip("fdxX").partition(".")[0].lstrip("+0")) else ""
    if form[-1] in "xX":
        return f"{padding}[0-9A-Fa-f]{{1,8}}"
    if form[-1] == "d":
        return f"{padding}{sign}[0-9]{{1,12}}"
    places = _places(form)
    return rf"{padding}{sign}[0-9]{{1,12}}" + (rf"\.[0-9]{{{places}}}" if places else "")


class Template:
    """A template of a line. Raises ValueError for an invalid text.

    `known` maps the possible fields to their quantities.
    """

    def __init__(
        self, text: str, known: Mapping[str, str], ticks_per_turn: float | None = None
    ) -> None:
        _check_text(text)
        self.end = text[-1].encode()
        parts = _FIELD.split(text.rstrip("\r\n"))  # text, name, unit, format, text, ...
        self._tail = text[len(text.rstrip("\r\n")) :]
        self._texts = parts[0::4]
        triples = list(zip(parts[1::4], parts[2::4], parts[3::4], strict=True))
        self.check = triples.pop()[0] if triples and triples[-1][0] in CHECKS else ""
        if self.check and self._texts[-1]:
            raise ValueError(f"the checksum {{{self.check}}} must stand last in the line")
        if any("{" in part or "}" in part for part in self._texts):
            raise ValueError("a brace without its partner; expected {FIELD|UNIT:FORMAT}")
        self.fields = tuple(parse_field(*triple, known, ticks_per_turn) for triple in triples)
        if not self.fields:
            raise ValueError(f"there is no field in it; known: {', '.join(known)}")
        self._check_gaps()
        names = [field.name for field in self.fields if field.name != IGNORED]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"{', '.join(repeated)} stands in it twice")
        self.names = frozenset(names)
        self._expression = re.compile(self._line_pattern())

    def encode(self, values: Mapping[str, float], *, toward_zero: bool = False) -> bytes:
        """Return the line for values in SI units; a field without a value is 0."""
        text = self._texts[0]
        for field, after in zip(self.fields, self._texts[1:], strict=False):
            text += field.write(values.get(field.name, 0.0), toward_zero=toward_zero) + after
        if self.check:
            text += self._checksum(text)
        return (text + self._tail).encode("ascii")

    def decode(self, line: bytes) -> dict[str, float] | None:
        """Return the values of a line without its end, in SI units; None if it does not match."""
        if len(line) > MAX_LINE_BYTES or not line.isascii():
            return None
        text = line.decode("ascii")
        match = self._expression.fullmatch(text)
        if match is None:
            return None
        if self.check:
            digits = CHECKS[self.check].digits
            if text[-digits:].upper() != self._checksum(text[:-digits]):
                return None
        pairs = zip(self.fields, match.groups(), strict=True)
        read = [(f, f.read(number)) for f, number in pairs if f.name != IGNORED]
        if any(abs(value) > MAX_VALUE and not f.is_counter for f, value in read):
            return None
        return {f.name: value for f, value in read}

    def sent(self, name: str, value: float) -> float:
        """Return a commanded value [SI] as rounded towards zero on the line."""
        for field in self.fields:
            if field.name == name:
                return field.read(field.write(value, toward_zero=True))
        return value

    def reads_all_of(self, other: "Template") -> bool:
        """Return whether this template matches the lines of the other one."""
        zeros = other.encode({}).strip(b"\r\n")
        return self.decode(zeros) is not None

    def longest(self) -> int:
        """Return the approximate size of a long line [bytes]."""
        return len(self.encode({field.name: -5.0 * field.factor for field in self.fields}))

    def _check_gaps(self) -> None:
        """Refuse adjacent fields: their numbers could not be separated."""
        pairs = zip(self.fields, self.fields[1:], self._texts[1:], strict=False)
        for before, after, between in pairs:
            if not between.strip(DIGITS) and not after.format.startswith("+"):
                raise ValueError(
                    f"{{{before.name}}} and {{{after.name}}} touch: expected something between "
                    "them that is no digit, such as a comma"
                )

    def _checksum(self, text: str) -> str:
        check = CHECKS[self.check]
        covered = text.removeprefix("$").removesuffix("*").encode("ascii")
        return format(check.of(covered), f"0{check.digits}X")

    def _line_pattern(self) -> str:
        """Return the regular expression of a line; its groups are the numbers."""
        pattern = re.escape(self._texts[0])
        for field, after in zip(self.fields, self._texts[1:], strict=False):
            pattern += f"({field.pattern})" + re.escape(after)
        if self.check:
            pattern += f"[0-9A-Fa-f]{{{CHECKS[self.check].digits}}}"
        return pattern


def _check_text(text: str) -> None:
    if not text.endswith(("\n", "\r")):
        quotes = "; in YAML, write it in double quotes" if text.endswith((r"\n", r"\r")) else ""
        raise ValueError(f"expected a newline (\\n) at its end{quotes}")
    if not text.isascii() or any(ord(c) < 32 for c in text.rstrip("\r\n")):
        raise ValueError("expected printable ASCII")
    if len(text) > MAX_LINE_BYTES:
        raise ValueError(f"expected at most {MAX_LINE_BYTES} characters, got {len(text)}")


def describe(values: Mapping[str, float]) -> str:
    """Describe the values of a line, in SI units, volts, degrees C and percent."""
    words = []
    for name, value in values.items():
        quantity = {**STATE, **COMMAND}[name]
        unit = next(iter(UNITS[quantity]))
        number = f"{round(value):#x}" if quantity == "flags" else f"{value:.4g}"
        words.append(f"{name} {number} {unit}".strip())
    return ", ".join(words)


class LineDecoder:
    """Splits bytes into lines, and decodes those that match a template.

    `errors` counts invalid lines after the first valid one; lines before it are a boot banner. It
    buffers at most MAX_LINE_BYTES.
    """

    def __init__(self, templates: Sequence[Template]) -> None:
        self.errors = 0
        self._templates = templates
        self._end = templates[0].end
        self._rest = b""
        self._skipping = False  # True until the end of a line that is too long
        self._after_banner = False  # True after a valid line

    def feed(self, data: bytes) -> list[dict[str, float]]:
        """Return the values of each valid line that `data` completes."""
        *lines, rest = (self._rest + data).split(self._end)
        found = []
        for line in lines:
            if self._skipping:
                self._skipping = False
            elif (values := self._read(line)) is not None:
                found.append(values)
        if len(rest) > MAX_LINE_BYTES:
            self.errors += self._after_banner and not self._skipping
            self._skipping, rest = True, b""
        self._rest = rest
        return found

    def clear(self) -> None:
        """Drop a partial line; the next lines may be a banner."""
        self._rest, self._skipping, self._after_banner = b"", False, False

    def _read(self, line: bytes) -> dict[str, float] | None:
        line = line.strip(b"\r\n")
        for template in self._templates:
            values = template.decode(line)
            if values is not None:
                self._after_banner = True
                return values
        self.errors += bool(line) and self._after_banner
        return None
