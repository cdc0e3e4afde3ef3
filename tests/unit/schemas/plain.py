"""Example messages as plain maps, in which tests change one value."""

from collections.abc import Iterator
from typing import Any

from gigabrain_schemas.examples import EXAMPLES
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.qa.faults import hostile
from gigabrain_zenoh.qa.faults.hostile import Path, codec_of, leaves


def codec(name: str) -> Codec[Any]:
    """Return the codec with which the bus would decode message `name`."""
    return codec_of(type(EXAMPLES[name]))


def as_map(name: str) -> dict[str, Any]:
    """Return the example of message `name` as plain maps, lists and values."""
    return hostile.as_map(type(EXAMPLES[name]))


def maps(value: Any, path: Path = ()) -> Iterator[Path]:
    """Yield the path of every map of named fields."""
    if isinstance(value, dict):
        yield path
        for key, inner in value.items():
            yield from maps(inner, (*path, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from maps(inner, (*path, index))


def numbers(name: str) -> list[Path]:
    """Return the path of every number in message `name`."""
    return [
        path
        for path, value in leaves(as_map(name))
        if isinstance(value, int | float) and not isinstance(value, bool)
    ]


def at(plain: Any, path: Path) -> Any:
    """Return the value at `path`."""
    return at(plain[path[0]], path[1:]) if path else plain


def refuses(name: str, payload: bytes) -> bool:
    """Return whether `payload` is not a valid message `name`."""
    try:
        codec(name).decode(payload)
    except ValueError:
        return True
    return False


def dotted(name: str, path: Path) -> str:
    """Return a path as text, such as `RobotState.joints.0.effort`."""
    return ".".join((name, *map(str, path)))
