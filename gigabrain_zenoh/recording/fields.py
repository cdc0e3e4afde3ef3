"""Messages as flat rows of named values, for tables and plots."""

from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from gigabrain_schemas import arrays
from gigabrain_schemas.base import Message
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import TOPICS
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.recording.reading import Sample

Value = float | int | str | bool | None
DECODERS = {f"gigabrain.{t.type.__name__}": Codec(t.type, t.max_bytes).decode for t in TOPICS}


def message_of(sample: Sample) -> Message | None:
    """The message, whatever key it came on; None where it is not a valid one of ours."""
    decode = DECODERS.get(sample.schema)
    try:
        return decode(sample.payload) if decode else None
    except ValueError:
        return None


def row(message: Message) -> dict[str, Value]:
    """All values of a message by their dotted names; bytes by their number, but for a scan's."""
    values = dict(_flat("", msgspec.to_builtins(message, builtin_types=(bytes,))))
    if isinstance(message, LaserScan):
        del values["ranges"]
        values |= {f"ranges.{i}": float(r) for i, r in enumerate(arrays.ranges(message))}
    return values


def _flat(name: str, value: Any) -> Iterator[tuple[str, Value]]:
    if isinstance(value, bytes):
        yield name, len(value)
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _flat(f"{name}.{key}" if name else str(key), inner)
    elif isinstance(value, list | tuple):
        for i, inner in enumerate(value):
            yield from _flat(f"{name}.{i}", inner)
    else:
        yield name, value
