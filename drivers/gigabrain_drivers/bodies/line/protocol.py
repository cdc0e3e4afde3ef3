"""Lines of text with numbers in them, written and read by the same template.

A template is the line as it is on the wire, with `{FIELD}`, `{FIELD|UNIT}` or
`{FIELD|UNIT:FORMAT}` where the numbers are: `V,{linear_x:.3f},{angular_z:.3f}` and a newline. A
checksum (`{crc16}`, see checks.py) stands last and covers the text before it, as in NMEA 0183:
without a `$` at the beginning and without a `*` right before the checksum.
"""

import re
from collections.abc import Mapping, Sequence

from gigabrain_drivers.bodies.line.checks import CHECKS
from gigabrain_drivers.bodies.line.fields import COMMAND, IGNORED, STATE, UNITS
from gigabrain_drivers.bodies.line.number import field_of

LONGEST = 256  # bytes of a line
MOST = 1e8  # in SI units; beyond, either way, no number is a measurement. Counters may count on.
DIGITS = "0123456789."  # what is no end of a number
_FIELD = re.compile(r"\{([^{}|:]*)(?:\|([^{}|:]*))?(?::([^{}]*))?\}")


class Template:
    """One kind of line. Raises ValueError for a text that cannot be one.

    `known` are the fields that it may have and their quantities.
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
        self.fields = tuple(field_of(*triple, known, ticks_per_turn) for triple in triples)
        if not self.fields:
            raise ValueError(f"there is no field in it; known: {', '.join(known)}")
        self._check_gaps()
        names = [field.name for field in self.fields if field.name != IGNORED]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"{', '.join(twice)} stands in it twice")
        self.names = frozenset(names)
        self._expression = re.compile(self._regular())

    def encode(self, values: Mapping[str, float], *, toward_zero: bool = False) -> bytes:
        """The line for values in SI units; a field without a value is 0."""
        text = self._texts[0]
        for field, after in zip(self.fields, self._texts[1:], strict=False):
            text += field.write(values.get(field.name, 0.0), toward_zero=toward_zero) + after
        if self.check:
            text += self._sum(text)
        return (text + self._tail).encode("ascii")

    def decode(self, line: bytes) -> dict[str, float] | None:
        """The values of a line without its end, in SI units; None when it is no such line."""
        if len(line) > LONGEST or not line.isascii():
            return None
        text = line.decode("ascii")
        match = self._expression.fullmatch(text)
        if match is None:
            return None
        if self.check:
            digits = CHECKS[self.check].digits
            if text[-digits:].upper() != self._sum(text[:-digits]):
                return None
        pairs = zip(self.fields, match.groups(), strict=True)
        read = [(f, f.read(number)) for f, number in pairs if f.name != IGNORED]
        if any(abs(value) > MOST and not f.counts for f, value in read):
            return None
        return {f.name: value for f, value in read}

    def sent(self, name: str, value: float) -> float:
        """What is left of a commanded value [SI]: it is rounded towards zero."""
        for field in self.fields:
            if field.name == name:
                return field.read(field.write(value, toward_zero=True))
        return value

    def reads_all_of(self, other: "Template") -> bool:
        """Whether lines of the other template can be read as lines of this one."""
        nothing = other.encode({}).strip(b"\r\n")
        return self.decode(nothing) is not None

    def longest(self) -> int:
        """About how many bytes a line has."""
        return len(self.encode({field.name: -5.0 * field.factor for field in self.fields}))

    def _check_gaps(self) -> None:
        """Numbers that touch cannot be told apart."""
        pairs = zip(self.fields, self.fields[1:], self._texts[1:], strict=False)
        for before, after, between in pairs:
            if not between.strip(DIGITS) and not after.format.startswith("+"):
                raise ValueError(
                    f"{{{before.name}}} and {{{after.name}}} touch: expected something between "
                    "them that is no digit, such as a comma"
                )

    def _sum(self, text: str) -> str:
        check = CHECKS[self.check]
        covered = text.removeprefix("$").removesuffix("*").encode("ascii")
        return format(check.of(covered), f"0{check.digits}X")

    def _regular(self) -> str:
        """The expression of a whole line; its groups are the numbers."""
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
    if len(text) > LONGEST:
        raise ValueError(f"expected at most {LONGEST} characters, got {len(text)}")


def describe(values: Mapping[str, float]) -> str:
    """The numbers of a line in words, in SI units, volts, degrees C and percent."""
    told = []
    for name, value in values.items():
        quantity = {**STATE, **COMMAND}[name]
        unit = next(iter(UNITS[quantity]))
        number = f"{round(value):#x}" if quantity == "flags" else f"{value:.4g}"
        told.append(f"{name} {number} {unit}".strip())
    return ", ".join(told)


class Decoder:
    """Cuts bytes into lines and reads those that fit one of the templates.

    `errors` counts the others, from the first good line on: what comes before is a boot banner.
    At most LONGEST bytes are ever kept.
    """

    def __init__(self, templates: Sequence[Template]) -> None:
        self.errors = 0
        self._templates = templates
        self._end = templates[0].end
        self._rest = b""
        self._skipping = False  # to the end of a line that is too long
        self._begun = False

    def feed(self, data: bytes) -> list[dict[str, float]]:
        """The values of each good line that `data` completes."""
        *lines, rest = (self._rest + data).split(self._end)
        found = []
        for line in lines:
            if self._skipping:
                self._skipping = False
            elif (values := self._read(line)) is not None:
                found.append(values)
        if len(rest) > LONGEST:
            self.errors += self._begun and not self._skipping
            self._skipping, rest = True, b""
        self._rest = rest
        return found

    def clear(self) -> None:
        """Forget the beginning of a line; what comes next may be a banner."""
        self._rest, self._skipping, self._begun = b"", False, False

    def _read(self, line: bytes) -> dict[str, float] | None:
        line = line.strip(b"\r\n")
        for template in self._templates:
            values = template.decode(line)
            if values is not None:
                self._begun = True
                return values
        self.errors += bool(line) and self._begun
        return None
