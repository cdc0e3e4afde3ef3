"""Dictionaries whose keys others choose: they hold so many at most, and the oldest give way."""

from typing import TypeVar

K = TypeVar("K")
V = TypeVar("V")


def put(held: dict[K, V], key: K, value: V, most: int) -> None:
    """Set `held[key]`, as its newest entry of at most `most`."""
    held.pop(key, None)
    held[key] = value
    if len(held) > most:
        del held[next(iter(held))]
