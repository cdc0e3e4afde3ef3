"""Zenoh's key expressions, as far as tools have to understand them by themselves."""


def matches(pattern: str, key: str) -> bool:
    """Whether `key` is one of `pattern`: `*` is any one part, `**` any number of them."""
    return _matches(pattern.split("/"), key.split("/"))


def _matches(pattern: list[str], key: list[str]) -> bool:
    if not pattern:
        return not key
    first, rest = pattern[0], pattern[1:]
    if first == "**":
        return any(_matches(rest, key[i:]) for i in range(len(key) + 1))
    return bool(key) and first in ("*", key[0]) and _matches(rest, key[1:])
