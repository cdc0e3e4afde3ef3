"""Members of the type of a field, and their kinds."""

import types
import typing
from collections.abc import Collection, Mapping
from typing import Any

import msgspec


def members_of(type_: Any) -> list[Any]:
    """Return the members of an Annotated, Optional or Union type, or the type itself."""
    if typing.get_origin(type_) is typing.Annotated:
        return members_of(typing.get_args(type_)[0])
    if typing.get_origin(type_) in (typing.Union, types.UnionType):
        return [part for member in typing.get_args(type_) for part in members_of(member)]
    return [type_]


def structs_in(type_: Any) -> list[Any]:
    """Return the Structs among the members of a type."""
    return [member for member in members_of(type_) if is_struct(member)]


def is_struct(type_: Any) -> bool:
    """Return whether a type is a Struct."""
    return isinstance(type_, type) and issubclass(type_, msgspec.Struct)


def is_mapping(type_: Any) -> bool:
    """Return whether a type is a dict or another mapping."""
    return _is_a(type_, Mapping)


def is_list(type_: Any) -> bool:
    """Return whether a type is a list, a tuple or another collection."""
    return _is_a(type_, Collection) and not _is_a(type_, (Mapping, str, bytes))


def _is_a(type_: Any, families: type | tuple[type, ...]) -> bool:
    origin = typing.get_origin(type_) or type_
    return isinstance(origin, type) and issubclass(origin, families)
