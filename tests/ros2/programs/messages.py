"""Converts messages of any installed type to JSON and back, by their fields."""

import importlib
from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def find(name: str) -> Any:
    """Return the class of a type such as `std_msgs/msg/String` or `std_srvs/srv/SetBool`.

    `_Request`, `_Response`, `_Goal`, `_Result`, `_Feedback` and longer endings, as in
    `nav2_msgs/action/NavigateToPose_SendGoal_Request`, name the parts.
    """
    package, kind, short = name.split("/")
    outer, *parts = short.split("_")
    found = getattr(importlib.import_module(f"{package}.{kind}"), outer)
    for part in parts:
        inner = found if hasattr(found, part) else found.Impl
        found = getattr(inner, part, None) or getattr(inner, f"{part}Service")
    return found


def to_json(value: Any) -> Any:
    """Return a message as dicts, lists, numbers and strings."""
    if hasattr(value, "get_fields_and_field_types"):
        names = value.get_fields_and_field_types()
        return {name: to_json(getattr(value, name)) for name in names}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (array, bytes, bytearray, memoryview)):
        return list(value)
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [to_json(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def make(message_type: Any, values: Mapping[str, Any]) -> Any:
    """Return a message with these values; omitted fields have their defaults."""
    message = message_type()
    types = message.get_fields_and_field_types()
    for name, value in values.items():
        setattr(message, name, _field(types[name], getattr(message, name), value))
    return message


def _field(type_name: str, default: Any, value: Any) -> Any:
    """Return a field's value: a message, a sequence of messages, bytes, an array, or plain."""
    if hasattr(default, "get_fields_and_field_types"):
        return make(type(default), value)
    inner = type_name.removeprefix("sequence<").partition(">")[0].partition("[")[0]
    inner = inner.partition(",")[0].strip()
    if isinstance(value, list) and "/" in inner:
        package, short = inner.split("/")
        item = find(f"{package}/msg/{short}")
        return [make(item, each) for each in value]
    if "octet" in type_name:
        return [bytes([each]) for each in value] if isinstance(value, list) else bytes([value])
    if isinstance(default, np.ndarray):
        return np.array(value, default.dtype)
    return value
