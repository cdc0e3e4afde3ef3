"""One number of a line of text: how it is written, and what it looks like."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from gigabrain_drivers.bodies.line.checks import CHECKS
from gigabrain_drivers.bodies.line.fields import DEFAULT_FORMATS, factor
from gigabrain_zenoh.errors import unknown

EXACT = 1e-6  # of a digit: what binary fractions miss
_FORMAT = re.compile(r"\+?0?[0-9]{0,2}(?:(?:\.[0-9])?f|d|[xX])")
_ANY_NUMBER = r" *[-+]?[0-9]{1,12}(?:\.[0-9]{0,9})?"


@dataclass(frozen=True)
class Field:
    """One number of a line."""

    name: str
    unit: str
    factor: float  # wire * factor is in SI units
    format: str  # of Python's format(); whole numbers and hexadecimals are rounded first
    pattern: str  # of a regular expression

    @property
    def counts(self) -> bool:
        """Whether it is a counter or a set of flags, which may be as large as they like."""
        return self.unit.endswith("tick") or self.format[-1] in "xX"

    @property
    def step(self) -> float:
        """The least by which two values on the wire differ, in SI units."""
        if self.format[-1] != "f":
            return abs(self.factor)
        return abs(self.factor) * 10.0 ** -_places(self.format)

    def write(self, value: float, *, toward_zero: bool = False) -> str:
        """The text for a value in SI units, rounded to its digits; zero has no sign."""
        wire = value / self.factor
        if toward_zero:
            places = 10.0 ** _places(self.format) if self.format[-1] == "f" else 1.0
            wire = math.copysign(math.floor(abs(wire) * places + EXACT), wire) / places
        if self.format[-1] != "f":
            return format(round(wire), self.format)
        text = format(wire, self.format)
        return format(0.0, self.format) if float(text) == 0 else text

    def read(self, text: str) -> float:
        """The value in SI units of a text that fits the pattern."""
        return (int(text, 16) if self.format[-1] in "xX" else float(text)) * self.factor + 0.0


def field_of(
    name: str, unit: str | None, form: str | None, known: Mapping[str, str], turn: float | None
) -> Field:
    """What stands between two braces. Raises ValueError naming the field."""
    if name in CHECKS:
        raise ValueError(f"the checksum {{{name}}} must stand last in the line")
    if name not in known:
        raise ValueError(str(unknown("field", name, [*known, *CHECKS])))
    quantity, unit = known[name], (unit or "").strip()
    try:
        scale = factor(quantity, unit, turn)
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
    """The decimals that a format ending in `f` writes."""
    _, dot, digits = form.rstrip("f").partition(".")
    return int(digits) if dot else 6


def _pattern(form: str) -> str:
    """What a number of this format looks like, and nothing else."""
    sign = "[-+]" if form.startswith("+") else "-?"
    padding = " *" if len(form.rstrip("fdxX").partition(".")[0].lstrip("+0")) else ""
    if form[-1] in "xX":
        return f"{padding}[0-9A-Fa-f]{{1,8}}"
    if form[-1] == "d":
        return f"{padding}{sign}[0-9]{{1,12}}"
    places = _places(form)
    return rf"{padding}{sign}[0-9]{{1,12}}" + (rf"\.[0-9]{{{places}}}" if places else "")
