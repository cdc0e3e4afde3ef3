"""Options that are counted in whole numbers: 1.5 of something is refused, not rounded."""

from typing import Any, get_args

from cyclopts import App, ArgumentCollection

from gigabrain_zenoh.errors import ConfigError


def refuse_fractions(_app: App, _command: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Called with what was typed, before it becomes values. Raises ConfigError."""
    for argument in arguments:
        if _is_counted(argument.hint):
            for token in argument.tokens:
                if _is_fraction(token.value):
                    got = f"expected a whole number, got {token.value}"
                    raise ConfigError(f"{argument.name}: {got}")


def _is_counted(hint: Any) -> bool:
    """Whether it is an int, perhaps one of several, or None."""
    return hint is int or any(_is_counted(part) for part in get_args(hint))


def _is_fraction(text: str) -> bool:
    try:
        return not float(text).is_integer()
    except ValueError:  # 0x10, or no number at all, which is told as such
        return False
