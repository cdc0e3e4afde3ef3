"""Every message as a foreign client would build it, to be damaged in one place."""

from collections.abc import Iterator
from typing import Any

import msgspec

from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.topics import TOPICS
from gigabrain_zenoh.codec import Codec

Path = tuple[str | int, ...]  # fields and places on the way to a value


def codec(name: str) -> Codec[Any]:
    """What the bus would decode message `name` with."""
    limits = {topic.type: topic.max_bytes for topic in TOPICS}
    message = type(EXAMPLES[name])
    return Codec(message, limits.get(message, 64 * 1024))


def as_map(name: str) -> dict[str, Any]:
    """The example as plain maps, lists and values."""
    plain = msgspec.msgpack.decode(msgspec.msgpack.encode(EXAMPLES[name]))
    assert isinstance(plain, dict)
    return plain


def leaves(value: Any, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Every value that is neither map nor list, with the way to it."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, (*path, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from leaves(inner, (*path, index))
    else:
        yield path, value


def maps(value: Any, path: Path = ()) -> Iterator[Path]:
    """The way to every map of named fields."""
    if isinstance(value, dict):
        yield path
        for key, inner in value.items():
            yield from maps(inner, (*path, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from maps(inner, (*path, index))


def numbers(name: str) -> list[Path]:
    """The way to every number in message `name`."""
    return [
        path
        for path, value in leaves(as_map(name))
        if isinstance(value, int | float) and not isinstance(value, bool)
    ]


def replaced(plain: Any, path: Path, value: Any) -> Any:
    """A copy of `plain` with `value` at `path`."""
    if not path:
        return value
    copy: Any = dict(plain) if isinstance(plain, dict) else list(plain)
    copy[path[0]] = replaced(plain[path[0]], path[1:], value)
    return copy


def at(plain: Any, path: Path) -> Any:
    """What is at `path`."""
    return at(plain[path[0]], path[1:]) if path else plain


def refuses(name: str, payload: bytes) -> bool:
    """Whether `payload` is no valid message `name`."""
    try:
        codec(name).decode(payload)
    except ValueError:
        return True
    return False


def dotted(name: str, path: Path) -> str:
    """`RobotState.joints.0.effort`."""
    return ".".join((name, *map(str, path)))
