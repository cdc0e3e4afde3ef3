"""Messages as text for people, and as JSON for programs."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.base import Message
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.sensors import Image, LaserScan
from gigabrain_zenoh.bus.headers import is_json
from gigabrain_zenoh.bus.listening import topic_of
from gigabrain_zenoh.codec import DECODE_ERRORS, Codec
from gigabrain_zenoh.errors import unknown
from gigabrain_zenoh.host import escaping

MAX_LISTED = 8  # numbers of a list; longer lists are summarised
MAX_RAW_BYTES = 64  # shown of a payload that cannot be decoded


class Summary(Struct, frozen=True, kw_only=True):
    """Statistics of an array; minimum, median and maximum of its finite values."""

    count: int
    min: float | None = None
    median: float | None = None
    max: float | None = None
    nan: int = 0
    inf: int = 0

    def __str__(self) -> str:
        parts = [f"{self.count} values"]
        for name in ("min", "median", "max"):
            value = getattr(self, name)
            if value is not None:
                parts.append(f"{name} {value:.6g}")
        parts += [f"{n} {kind}" for n, kind in ((self.nan, "nan"), (self.inf, "inf")) if n]
        return ", ".join(parts)


def summary(values: Sequence[float] | NDArray[np.generic]) -> Summary:
    """Return the statistics of numbers of any shape."""
    numbers = np.asarray(values, dtype=np.float64).ravel()
    finite = numbers[np.isfinite(numbers)]
    return Summary(
        count=numbers.size,
        min=float(finite.min()) if finite.size else None,
        median=float(np.median(finite)) if finite.size else None,
        max=float(finite.max()) if finite.size else None,
        nan=int(np.isnan(numbers).sum()),
        inf=int(np.isinf(numbers).sum()),
    )


def array_of(message: Message) -> tuple[str, NDArray[np.generic]] | None:
    """Return the name and the content of a message's array field; None without one."""
    if isinstance(message, LaserScan):
        return "ranges", message.ranges_m
    if isinstance(message, OccupancyGrid):
        return "cells", message.array()
    if isinstance(message, Image) and message.encoding != "jpeg":
        return "data", message.array()
    return None


def _json_number(value: float) -> float | str | None:
    """Return a number for JSON: null for nan, "inf" or "-inf" for infinity."""
    if math.isnan(value):
        return None
    return value if math.isfinite(value) else ("inf" if value > 0 else "-inf")


def read(key: str, payload: bytes, *, whole: bool) -> Any:
    """Decode a payload to a tree of plain values.

    Arrays are summarised unless `whole`; images always.
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
    """Return a message as a tree of plain values."""
    values: dict[str, Any] = msgspec.to_builtins(message, builtin_types=(bytes,))
    if found := array_of(message):
        name, array = found
        as_list = whole and not isinstance(message, Image)
        numbers = array.ravel().tolist() if as_list else ()
        values[name] = [_json_number(v) for v in numbers] if as_list else summary(array)
    return {name: _shortened(value, whole) for name, value in values.items()}


def _shortened(value: Any, whole: bool) -> Any:
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, Mapping):
        return {str(name): _shortened(inner, whole) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        if not whole and len(value) > MAX_LISTED and all(type(v) in (int, float) for v in value):
            return summary(value)
        return [_shortened(inner, whole) for inner in value]
    return value


def _foreign(payload: bytes) -> Any:
    try:
        decode = msgspec.json.decode if is_json(payload) else msgspec.msgpack.decode
        found = decode(payload)
    except DECODE_ERRORS:
        return {"raw": _raw(payload)}
    return found if isinstance(found, Mapping) else {"raw": found}


def _raw(payload: bytes) -> str:
    """Return the first bytes as ASCII, or as hex if they are not ASCII."""
    more = "" if len(payload) <= MAX_RAW_BYTES else f" … {len(payload)} bytes"
    try:
        return payload[:MAX_RAW_BYTES].decode("ascii") + more
    except UnicodeDecodeError:
        return payload[:MAX_RAW_BYTES].hex(" ") + more


def lines(value: Any, indent: int = 0) -> Iterator[str]:
    """Yield the lines of a tree, similar to YAML."""
    pad = "  " * indent
    for name, inner in value.items():
        shown = escaping.printable(name)
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
    """Return a tree on one line."""
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
    return escaping.printable(value) if value != "" else '""'


def pick(value: Mapping[str, Any], fields: Sequence[str]) -> dict[str, Any]:
    """Return the fields at dotted paths such as `velocity.linear_x` or `joints.0.name`.

    A field without a value, such as the charge of a body without a battery, is None. Raises
    UnknownName for a field that does not exist.
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
    """Return a tree as JSON on one line."""
    return escaping.printable_json(msgspec.json.encode(value, enc_hook=_encode_other).decode())


def _encode_other(value: object) -> object:
    return msgspec.to_builtins(value) if isinstance(value, Summary) else str(value)
