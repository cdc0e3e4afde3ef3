"""Types and values of a configuration in words: `a number >= 0.01`, `one of 'left', 'right'`."""

import difflib
from collections.abc import Iterable, Sequence
from typing import Any

from msgspec import inspect as mi

from gigabrain_zenoh.config.yaml_text import Node

_LONGEST = 60  # characters of a value that are shown
_NAMES: tuple[tuple[tuple[type, ...], str], ...] = (
    ((mi.IntType,), "a whole number"),
    ((mi.FloatType,), "a number"),
    ((mi.StrType,), "a string"),
    ((mi.BoolType,), "true or false"),
    ((mi.NoneType,), "null"),
    ((mi.ListType, mi.VarTupleType, mi.SetType, mi.FrozenSetType), "a list"),
    ((mi.StructType, mi.DictType), "a mapping"),
)
_LIMITS = {
    "ge": ">=",
    "gt": ">",
    "le": "<=",
    "lt": "<",
    "multiple_of": "a multiple of",
    "min_length": "of length >=",
    "max_length": "of length <=",
    "pattern": "matching",
}


def expected(type_: Any) -> str:
    """What a value of `type_` looks like, with its limits."""
    return _words(mi.type_info(type_))


def _words(info: mi.Type) -> str:
    if isinstance(info, mi.Metadata):
        return _words(info.type)
    if isinstance(info, mi.UnionType):
        words = dict.fromkeys(_words(t) for t in info.types if not isinstance(t, mi.NoneType))
        return " or ".join([*words, *(["null"] if info.includes_none else [])])
    if choices := _choices(info):
        return one_of(choices)
    if isinstance(info, mi.TupleType):
        return f"a list of {len(info.item_types)}"
    for kinds, name in _NAMES:
        if isinstance(info, kinds):
            return name + _limits(info)
    return type(info).__name__.removesuffix("Type").lower()


def _limits(info: mi.Type) -> str:
    given = [(words, getattr(info, name, None)) for name, words in _LIMITS.items()]
    said = [f"{words} {limit}" for words, limit in given if limit is not None]
    return " " + " and ".join(said) if said else ""


def choices(type_: Any) -> list[Any]:
    """The values that a Literal or an Enum (also inside a Union) allows; empty for other types."""
    return _choices(mi.type_info(type_))


def _choices(info: mi.Type) -> list[Any]:
    if isinstance(info, mi.UnionType):
        return [value for member in info.types for value in _choices(member)]
    if isinstance(info, mi.LiteralType):
        return list(info.values)
    return [member.value for member in info.cls] if isinstance(info, mi.EnumType) else []


def one_of(values: Sequence[Any]) -> str:
    """`one of 'left', 'right'`, or the only value there is."""
    return "one of " + ", ".join(map(repr, values)) if len(values) > 1 else repr(values[0])


def got(node: Node) -> str:
    """What the file holds, as it is written there."""
    if node.entries is not None:
        return "a mapping"
    if node.items is not None:
        return f"a list of {len(node.items)}"
    if node.value is None:
        return node.text or "nothing"
    text = node.text if len(node.text) <= _LONGEST else node.text[: _LONGEST - 3] + "..."
    return repr(text) if isinstance(node.value, str) else text


def nearest(name: object, known: Iterable[Any]) -> str:
    """`; did you mean 'turn'?` where something known is near, or nothing."""
    names = [k for k in known if isinstance(k, str)]
    close = difflib.get_close_matches(name, names, 1, 0.6) if isinstance(name, str) else []
    return f"; did you mean {close[0]!r}?" if close else ""
