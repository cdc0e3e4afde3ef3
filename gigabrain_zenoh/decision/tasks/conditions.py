"""Conditions on what the robot says: `battery.percentage < 20`, `state.gate.mode == enabled`."""

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
Read = Callable[[Topic[Any]], Message | None]  # the newest of a topic while it counts

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
        """Whether it does; None while that is not known."""
        here: Any = read(self.topic)
        for part in self.path:
            if isinstance(here, tuple):
                here = here[int(part)] if int(part) < len(here) else None
            elif here is not None:
                here = getattr(here, part)
        return None if here is None else OPERATORS[self.operator](here, self.value)


def parse(text: str) -> Condition:
    """The condition that a text states. Raises ValueError, which says what was expected."""
    found = FORM.fullmatch(text)
    if not found:
        raise ValueError(f"{EXPECTED}, got {text!r}")
    field, sign, literal = found.groups()
    topic, path = _place(field)
    kind = _kind(topic.type, path, field)
    value = _value(literal)
    wanted: tuple[type, ...] = (bool,) if kind is bool else (str,) if kind is str else (int, float)
    if not isinstance(value, wanted) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{field} is {_named(kind)}; it cannot be compared with {literal!r}")
    if kind in (bool, str) and sign not in ("==", "!="):
        raise ValueError(f"{field} is {_named(kind)}; expected == or !=, got {sign}")
    return Condition(topic, path, sign, value, " ".join(text.split()))


def _place(field: str) -> tuple[Topic[Any], tuple[str, ...]]:
    """The topic, and the way to the field in it; what names no topic is of the robot's state."""
    first, *rest = field.split(".")
    known = {topic.key.removeprefix("robot/"): topic for topic in TOPICS if not topic.many}
    if first in known and rest:
        return known[first], tuple(rest)
    if first not in RobotState.__struct_fields__:
        raise unknown("field", first, {*known, *RobotState.__struct_fields__})
    return STATE, (first, *rest)


def _kind(type_: Any, path: tuple[str, ...], field: str) -> type:
    """What kind of value lies at the end of the way. Raises ValueError where none does."""
    for part in path:
        type_ = _bare(type_)
        if isinstance(type_, type) and issubclass(type_, msgspec.Struct):
            of = {f.name: f.type for f in msgspec.structs.fields(type_)}
            if part not in of:
                raise unknown("field", part, of)
            type_ = of[part]
        elif typing.get_origin(type_) is tuple and part.isdigit():
            type_ = typing.get_args(type_)[0]
        else:
            raise ValueError(f"{field}: no field {part!r}")
    kind = _bare(type_)
    if typing.get_origin(kind) is typing.Literal:
        return str
    if kind in (bool, int, float, str):
        return kind  # type: ignore[no-any-return]
    raise ValueError(f"{field} is no number, word or truth value; name one of its parts")


def _bare(type_: Any) -> Any:
    """A type without its bounds, and without the None that it may be as well."""
    if typing.get_origin(type_) is typing.Annotated:
        return _bare(typing.get_args(type_)[0])
    if typing.get_origin(type_) in (typing.Union, types.UnionType):
        return _bare(next(m for m in typing.get_args(type_) if m is not type(None)))
    return type_


def _value(literal: str) -> Value:
    if literal in WORDS:
        return WORDS[literal]
    try:
        value = float(literal)
    except ValueError:
        return literal
    return value if value - value == 0.0 else literal  # nan and inf are words here


def _named(kind: type) -> str:
    return "true or false" if kind is bool else "a word" if kind is str else "a number"
