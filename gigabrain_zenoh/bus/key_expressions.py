"""Key expressions of Zenoh: their syntax, matching keys, and those of topic names."""

import re
from collections.abc import Iterable

from gigabrain_zenoh.bus.listening import topic_named
from gigabrain_zenoh.errors import ConfigError

PART = re.compile(r"\*\*?|(?!\$\*\Z)(?:\$\*(?!\$)|[^*$#?])+")


def check_key_expression(text: str) -> None:
    """Raise ConfigError if Zenoh refuses `text` as a key expression."""
    if "**/*" in text or not all(map(PART.fullmatch, text.split("/"))):
        raise ConfigError(
            f"expected a key expression, got {text!r}: names joined by /, without #, ? and $; "
            "* is any name, ** any number of names (*/** one or more), $* any characters of a name",
            value=text,
        )


def key_expressions(names: Iterable[str]) -> list[str]:
    """Return the key expressions of topic names; those with a `*` stay as given.

    Raises ConfigError for an unknown name or an invalid key expression.
    """
    found = [name if "*" in name else topic_named(name).at("**") for name in names]
    for expression in found:
        check_key_expression(expression)
    return found


def matches(pattern: str, key: str) -> bool:
    """Return whether a key expression covers `key`: `*` is one part, `**` any number."""
    return _matches(pattern.split("/"), key.split("/"))


def _matches(pattern: list[str], key: list[str]) -> bool:
    if not pattern:
        return not key
    first, rest = pattern[0], pattern[1:]
    if first == "**":
        return any(_matches(rest, key[i:]) for i in range(len(key) + 1))
    return bool(key) and _matches_part(first, key[0]) and _matches(rest, key[1:])


def _matches_part(part: str, name: str) -> bool:
    if "$*" in part:
        return bool(re.fullmatch(".*".join(map(re.escape, part.split("$*"))), name, re.DOTALL))
    return part in ("*", name)
