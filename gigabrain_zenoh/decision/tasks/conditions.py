"""Conditions on messages: `battery.percentage < 20`, `state.gate.mode == enabled`."""

import operator
import re
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.topics import STATE, TOPICS, Topic
from gigabrain_zenoh.errors import unknown

Value = float | str | bool
Read = Callable[[Topic[Any]], Message | None]  # returns the newest message if it is fresh

OPERATORS: Mapping[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
FORM = re.compile(r"\s*([a-z_][\w.]*)\s*(<=|>=|==|!=|<|>)\s*([\w.+-]+)\s*", re.ASCII)
EXPECTED = "expected a field, one of < <= > >= == != and a value, as in 'battery.percentage < 20'"
WORDS = {"true": True, "false": False}


class Condition(msgspec.Struct, frozen=True):
    """One comparison of a field with a value."""

    topic: Topic[Any]
    path: tuple[str, ...]
    operator: str
    value: Value
    text: str

    def holds(self, read: Read) -> bool | None:
        """Return whether the condition holds; None while the value is unknown."""
        value: Any = read(self.topic)
        for part in self.path:
            if isinstance(value, tuple):
                value = value[int(part)] if int(part) < len(value) else None
            elif value is not None:
                value = getattr(value, part)
        return None if value is None else OPERATORS[self.operator](value, self.value)


def parse(text: str) -> Condition:
    """Return the condition in a text. Raises ValueError with the expected form."""
    match = FORM.fullmatch(text)
    if not match:
        raise ValueError(f"{EXPECTED}, got {text!r}")
    field, sign, literal = match.groups()
    topic, path = _topic_and_path(field)
    type_ = _type(topic.type, path, field)
    words = typing.get_args(type_)  # allowed ones; empty if it is no Literal
    kind = str if words else type_
    value = _value(literal)
    types_: tuple[type, ...] = (bool,) if kind is bool else (str,) if kind is str else (int, float)
    if not isinstance(value, types_) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{field} is {_type_name(kind)}; it cannot be compared with {literal!r}")
    if kind in (bool, str) and sign not in ("==", "!="):
        raise ValueError(f"{field} is {_type_name(kind)}; expected == or !=, got {sign}")
    if words and value not in words:
        raise ValueError(f"{field}: {unknown('word', literal, words)}")
    return Condition(topic, path, sign, value, " ".join(text.split()))


def _topic_and_path(field: str) -> tuple[Topic[Any], tuple[str, ...]]:
    """Return the topic of a field, and its path there; without a topic's name, of `robot/state`."""
    first, *rest = field.split(".")
    known = {topic.key.removeprefix("robot/"): topic for topic in TOPICS if not topic.many}
    if first in known and rest:
        return known[first], tuple(rest)
    if first not in RobotState.__struct_fields__:
        raise unknown("field", first, {*known, *RobotState.__struct_fields__})
    return STATE, (first, *rest)


def _type(type_: Any, path: tuple[str, ...], field: str) -> Any:
    """Return the type of a field's value. Raises ValueError if there is no such field."""
    for part in path:
        outer, type_ = type_, _bare(type_)
        if isinstance(type_, type) and issubclass(type_, msgspec.Struct):
            known = {f.name: f.type for f in msgspec.structs.fields(type_)}
            if part not in known:
                raise unknown("field", part, known)
            type_ = known[part]
        elif typing.get_origin(type_) is tuple and part.isdigit():
            inner = typing.get_args(type_)
            size = _max_length(outer) if inner[-1] is Ellipsis else len(inner)
            if int(part) >= size:
                raise ValueError(f"{field}: no index {part}; expected 0 to {size - 1}")
            type_ = inner[0]
        else:
            raise ValueError(f"{field}: no field {part!r}")
    kind = _bare(type_)
    if typing.get_origin(kind) is typing.Literal or kind in (bool, int, float, str):
        return kind
    raise ValueError(f"{field} is not a number, word or boolean; name one of its parts")


def _bare(type_: Any) -> Any:
    """Return a type without its bounds and without None."""
    if typing.get_origin(type_) is typing.Annotated:
        return _bare(typing.get_args(type_)[0])
    if typing.get_origin(type_) in (typing.Union, types.UnionType):
        return _bare(next(m for m in typing.get_args(type_) if m is not type(None)))
    return type_


def _max_length(type_: Any) -> int:
    """Return the maximum length of a tuple: each field of a message has one."""
    meta = next(arg for arg in typing.get_args(type_) if isinstance(arg, msgspec.Meta))
    assert meta.max_length is not None
    return meta.max_length


def _value(literal: str) -> Value:
    if literal in WORDS:
        return WORDS[literal]
    try:
        value = float(literal)
    except ValueError:
        return literal
    return value if value - value == 0.0 else literal  # `nan` and `inf` are words


def _type_name(kind: type) -> str:
    return "true or false" if kind is bool else "a word" if kind is str else "a number"
