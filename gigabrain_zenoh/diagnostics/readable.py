"""Messages for people, and for pipes."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.sensors import Image
from gigabrain_zenoh.codec import DECODE_ERRORS, Codec
from gigabrain_zenoh.diagnostics.arrays_in_words import Summary, array_of, plain, summary
from gigabrain_zenoh.diagnostics.names import topic_of
from gigabrain_zenoh.errors import unknown
from gigabrain_zenoh.host import terminal
from gigabrain_zenoh.recording.headers import is_json

LONG = 8  # numbers; more of them are summarised
SHOWN = 64  # bytes of what nobody can read
NOTHING = object()


def read(key: str, payload: bytes, *, whole: bool) -> Any:
    """What a payload says, as a tree of plain values.

    Arrays are summarised, or `whole` for programs; a picture is summarised for either.
    """
    topic = topic_of(key)
    if topic is None:
        return _foreign(payload)
    try:
        message = Codec(topic.type, topic.max_bytes).decode(payload)
    except ValueError as error:
        return {"invalid": f"not a valid {topic.type.__name__}: {error}", "raw": _raw(payload)}
    return tree(message, whole=whole)


def tree(message: Message, *, whole: bool) -> dict[str, Any]:
    """A message as plain values."""
    values: dict[str, Any] = msgspec.to_builtins(message, builtin_types=(bytes,))
    if found := array_of(message):
        name, array = found
        as_list = whole and not isinstance(message, Image)
        values[name] = [plain(v) for v in array.ravel().tolist()] if as_list else summary(array)
    return {name: _tidy(value, whole) for name, value in values.items()}


def _tidy(value: Any, whole: bool) -> Any:
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, Mapping):
        return {str(name): _tidy(inner, whole) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        if not whole and len(value) > LONG and all(type(v) in (int, float) for v in value):
            return summary(value)
        return [_tidy(inner, whole) for inner in value]
    return value


def _foreign(payload: bytes) -> Any:
    try:
        decode = msgspec.json.decode if is_json(payload) else msgspec.msgpack.decode
        found = decode(payload)
    except DECODE_ERRORS:
        return {"raw": _raw(payload)}
    return found if isinstance(found, Mapping) else {"raw": found}


def _raw(payload: bytes) -> str:
    """Bytes as people can read them: text where it is text."""
    more = "" if len(payload) <= SHOWN else f" … {len(payload)} bytes"
    try:
        return payload[:SHOWN].decode("ascii") + more
    except UnicodeDecodeError:
        return payload[:SHOWN].hex(" ") + more


def lines(value: Any, indent: int = 0) -> Iterator[str]:
    """A tree as lines in the manner of YAML."""
    pad = "  " * indent
    for name, inner in value.items():
        shown = terminal.printable(name)
        if isinstance(inner, Mapping) and inner:
            yield f"{pad}{shown}:"
            yield from lines(inner, indent + 1)
        elif isinstance(inner, list) and any(isinstance(i, Mapping | list) for i in inner):
            yield f"{pad}{shown}:"
            for item in inner:
                yield from _item(item, indent + 1)
        else:
            yield f"{pad}{shown}: {in_a_line(inner)}"


def _item(item: Any, indent: int) -> Iterator[str]:
    pad = "  " * indent
    if not isinstance(item, Mapping) or not item:
        yield f"{pad}- {in_a_line(item)}"
        return
    for i, line in enumerate(lines(item)):
        yield f"{pad}{'- ' if i == 0 else '  '}{line}"


def in_a_line(value: Any) -> str:
    """Any plain value, short."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k}: {in_a_line(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(in_a_line, value)) + "]"
    if value is None:
        return "-"
    if isinstance(value, bool):
        return str(value).lower()
    return terminal.printable(value) if value != "" else '""'


def pick(value: Mapping[str, Any], fields: Sequence[str]) -> dict[str, Any]:
    """The fields at dotted paths, as in `velocity.linear_x` or `joints.0.name`.

    What is missing for now, such as the charge of a body without a battery, is None. Raises
    UnknownName for a field that there is not.
    """
    return {field: _at(value, field) for field in fields}


def _at(value: Mapping[str, Any], field: str) -> Any:
    here: Any = value
    for part in field.split("."):
        if here is None or (isinstance(here, list | tuple) and part.isdigit()):
            items = here or ()
            here = items[int(part)] if part.isdigit() and int(part) < len(items) else None
        elif isinstance(here, Mapping) and part in here:
            here = here[part]
        else:
            raise unknown("field", field, _paths(value))
    return here


def _paths(value: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for name, inner in value.items():
        yield f"{prefix}{name}"
        if isinstance(inner, Mapping):
            yield from _paths(inner, f"{prefix}{name}.")


def as_json(value: Any) -> str:
    """On one line."""
    return msgspec.json.encode(value, enc_hook=_hook).decode()


def _hook(value: object) -> object:
    return msgspec.to_builtins(value) if isinstance(value, Summary) else str(value)
