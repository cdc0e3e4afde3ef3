"""RIHS01, the hash of a type's definition in ROS 2 (REP-2016).

The hashes of rosbags are wrong for `char`, which `rosidl` converts to `uint8` first.
"""

import json
from collections.abc import Callable
from hashlib import sha256
from typing import Any

from rosbags.interfaces import Nodetype

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.ros2.type_files import Description, Fields

# constants of type_description_interfaces/msg/FieldType
TYPE_IDS = {
    "int8": 2,
    "uint8": 3,
    "int16": 4,
    "uint16": 5,
    "int32": 6,
    "uint32": 7,
    "int64": 8,
    "uint64": 9,
    "float32": 10,
    "float64": 11,
    "char": 3,
    "bool": 15,
    "byte": 16,
    "string": 17,
}
NESTED, BOUNDED_STRING = 1, 21
ARRAY, BOUNDED_SEQUENCE, SEQUENCE = 48, 96, 144  # added to the id of the element's type


def rihs01(name: str, fields_of: Callable[[str], Fields]) -> str:
    """Return the hash of a message, service or action.

    Raises the errors of `fields_of`, and ConfigError for a message that contains itself.
    """
    described: dict[str, Any] = {}
    waiting = [name]
    while waiting:
        each = waiting.pop()
        if each in described:
            continue
        fields = [_field(field, kind) for field, kind in fields_of(each)]
        described[each] = {"type_name": each, "fields": fields}
        nested = {field["type"]["nested_type_name"] for field in fields} - {""}
        if name in nested:
            raise ConfigError(f"{name} contains itself, which ROS does not allow")
        waiting.extend(nested)
    description = {
        "type_description": described[name],
        "referenced_type_descriptions": [described[k] for k in sorted(described) if k != name],
    }
    return f"RIHS01_{sha256(json.dumps(description).encode()).hexdigest()}"


def _field(name: str, description: Description) -> dict[str, Any]:
    kind, inner, offset, capacity = description[0], description, 0, 0
    if kind == Nodetype.ARRAY:
        inner, capacity = description[1]
        offset = ARRAY
    elif kind == Nodetype.SEQUENCE:
        inner, capacity = description[1]
        offset = BOUNDED_SEQUENCE if capacity else SEQUENCE
    type_id, max_length, nested = NESTED, 0, ""
    if inner[0] == Nodetype.NAME:
        nested = inner[1]
    else:
        primitive, max_length = inner[1]
        type_id = BOUNDED_STRING if max_length else TYPE_IDS[primitive]
    return {
        "name": name,
        "type": {
            "type_id": offset + type_id,
            "capacity": capacity,
            "string_capacity": max_length,
            "nested_type_name": nested,
        },
    }
