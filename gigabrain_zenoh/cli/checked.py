"""Options of a command as a Struct, refused in one line that names the option."""

import math
from collections.abc import Mapping
from typing import TypeVar

import msgspec

from gigabrain_zenoh.errors import ConfigError

T = TypeVar("T")


def checked(values: Mapping[str, object], type: type[T]) -> T:
    """`values` as a `type`. Raises ConfigError for the first that does not fit."""
    try:
        return msgspec.convert(values, type)
    except msgspec.ValidationError as error:
        text, _, path = str(error).partition(" - at `$.")
        name = path.rstrip("`").replace("_", "-")
        raise ConfigError(f"--{name}: {text[0].lower()}{text[1:]}" if name else text) from None


def finite(name: str, value: float) -> None:
    """Raises ConfigError where the option `name` is no number."""
    if not math.isfinite(value):
        shown = name.replace("_", "-")
        raise ConfigError(f"--{shown}: expected a number, got {value:g}")


def above_zero(name: str, value: float | None) -> None:
    """Raises ConfigError where the option `name` is no number above 0; None is none given."""
    if value is not None and not 0 < value < 1e9:
        raise ConfigError(f"--{name}: expected a number above 0, got {value:g}")
