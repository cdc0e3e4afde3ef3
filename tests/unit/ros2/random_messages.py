"""Random messages of any type, as JSON values with bytes as lists."""

import random
import struct
from collections.abc import Sequence
from typing import Any

from rosbags.interfaces import Nodetype

from gigabrain_zenoh.ros2.type_files import DUMMY
from gigabrain_zenoh.ros2.types import Types

RANGES = {
    "int8": (-(2**7), 2**7 - 1),
    "uint8": (0, 2**8 - 1),
    "char": (0, 2**8 - 1),
    "int16": (-(2**15), 2**15 - 1),
    "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
    "int64": (-(2**63), 2**63 - 1),
    "uint64": (0, 2**64 - 1),
    "byte": (0, 127),  # signed here, unsigned in ROS
}
TEXTS = ("", "map", "ä€ 😀", "x" * 17)


def random_fields(
    types: Types, name: str, source: random.Random, texts: Sequence[str] = TEXTS
) -> dict[str, Any]:
    """Return random values of all fields."""
    return {
        field: _value(types, kind, source, texts)
        for field, kind in types.fields(name)
        if field != DUMMY
    }


def _value(types: Types, kind: Any, source: random.Random, texts: Sequence[str]) -> Any:
    if kind[0] == Nodetype.NAME:
        return random_fields(types, kind[1], source, texts)
    if kind[0] == Nodetype.BASE:
        return _scalar(*kind[1], source, texts)
    inner, size = kind[1]
    count = size if kind[0] == Nodetype.ARRAY else source.randint(0, min(size or 3, 3))
    return [_value(types, inner, source, texts) for _ in range(count)]


def _scalar(primitive: str, max_length: int, source: random.Random, texts: Sequence[str]) -> Any:
    if primitive == "string":
        text = source.choice(texts)
        return text[:max_length] if max_length and text.isascii() else "" if max_length else text
    if primitive == "bool":
        return source.random() < 0.5
    if primitive == "float64":
        return source.uniform(-1e9, 1e9)
    if primitive == "float32":
        return struct.unpack("<f", struct.pack("<f", source.uniform(-1e6, 1e6)))[0]
    return source.randint(*RANGES[primitive])
