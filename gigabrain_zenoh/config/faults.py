"""Where a configuration does not fit its Struct, and what was expected there.

msgspec says what is wrong, but under a dict it does not say where, and an unknown field it puts
on the parent's line. This walks the document beside the type and finds the very line.
"""

import re
import types
import typing
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from gigabrain_zenoh.config.words import choices, expected, got, nearest, one_of
from gigabrain_zenoh.config.yaml_text import Entry, Node


@dataclass(frozen=True)
class Fault:
    """One line for people about one line of a file (from 1)."""

    line: int
    text: str


def find(root: Node, type_: Any) -> Fault | None:
    """The first place, in the order of the file, where `root` cannot be a `type_`."""
    return _find(root, type_, "", root.line)


def _find(node: Node, type_: Any, path: str, key_line: int) -> Fault | None:
    structs = _structs(type_) if node.entries is not None else []
    if fault := _wrong_tag(node, structs, path, key_line):
        return fault
    for fault in _inside(node, _meant(type_, node), path, key_line):
        return fault
    try:
        msgspec.convert(node.value, type_)
    except msgspec.ValidationError as error:
        line = key_line if node.entries or node.items else node.line
        if structs:  # its fields are right, so its own __post_init__ said no
            return _own_fault(node, path, line, re.sub(r" - at `[^`]*`$", "", str(error)))
        hint = nearest(node.value, choices(type_))
        return Fault(line, _at(path, f"expected {expected(type_)}, got {got(node)}{hint}"))
    return None


def _own_fault(node: Node, path: str, line: int, text: str) -> Fault:
    """What a Struct says of itself; `FIELD: ...` or `FIELD[2]: ...` is about that very line.

    Else it is about the first field that it names and that stands in the file.
    """
    match = re.match(r"(\w+)(?:\[(\d+)\])?: ", text)
    for entry in node.entries or ():
        if match and entry.key == match[1]:
            items = entry.node.items or ()
            number = int(match[2]) if match[2] else len(items)
            at = items[number].line if number < len(items) else entry.line
            return Fault(at, _join(path, text))
    lines = {entry.key: entry.line for entry in node.entries or ()}
    named = (lines[word] for word in re.findall(r"\w+", text) if word in lines)
    return Fault(next(named, line), _at(path, text))


def _wrong_tag(node: Node, structs: list[Any], path: str, key_line: int) -> Fault | None:
    """A union's Structs are told apart by a tag field; without a good one nothing else is said."""
    tags = [s.__struct_config__.tag for s in structs if s.__struct_config__.tag is not None]
    name = structs[0].__struct_config__.tag_field if tags else ""
    for entry in node.entries or ():
        if tags and entry.key == name and entry.node.value not in tags:
            hint = nearest(entry.node.value, tags)
            text = f"expected {one_of(tags)}, got {got(entry.node)}{hint}"
            return Fault(entry.line, _at(_join(path, name), text))
    if len(tags) > 1 and name not in node.value:
        return Fault(key_line, _at(path, f"missing field {name!r}; expected {one_of(tags)}"))
    return None


def _inside(node: Node, type_: Any, path: str, key_line: int) -> Iterator[Fault]:
    if node.entries is not None and _is_struct(type_):
        yield from _in_struct(node, node.entries, type_, path, key_line)
    elif node.entries is not None and _is_mapping(type_):
        for entry in node.entries:
            yield from _in_entry(entry, typing.get_args(type_), path)
    elif node.items is not None and _is_list(type_):
        for i, (item, of) in enumerate(zip(node.items, _item_types(type_, node), strict=False)):
            if fault := _find(item, of, f"{path}[{i}]", item.line):
                yield fault


def _in_struct(
    node: Node, entries: tuple[Entry, ...], type_: Any, path: str, key_line: int
) -> Iterator[Fault]:
    fields = {f.encode_name: f for f in msgspec.structs.fields(type_)}
    config = type_.__struct_config__
    known = sorted([*fields, config.tag_field] if config.tag is not None else fields)
    among = ", ".join(known) or "none"
    for entry in entries:
        if field := fields.get(entry.key):
            if fault := _find(entry.node, field.type, _join(path, entry.key), entry.line):
                yield fault
        elif entry.key not in known and config.forbid_unknown_fields:
            hint = nearest(entry.key, known) or ";"
            yield Fault(entry.line, f"unknown field {entry.key!r}{hint} known: {among}")
    for name, field in fields.items():
        if field.required and name not in node.value:
            text = f"missing field {name!r}; expected {expected(field.type)}"
            yield Fault(key_line, _at(path, text))


def _in_entry(entry: Entry, types_: tuple[Any, ...], path: str) -> Iterator[Fault]:
    key_type, value_type = types_ or (str, Any)
    if _find(Node(entry.line, entry.key, entry.key), key_type, "", entry.line):
        text = f"expected {expected(key_type)} as the name, got {entry.key!r}"
        yield Fault(entry.line, _at(path, text))
    if fault := _find(entry.node, value_type, _join(path, entry.key), entry.line):
        yield fault


def _item_types(type_: Any, node: Node) -> list[Any]:
    arguments = typing.get_args(type_) or (Any,)
    if typing.get_origin(type_) is tuple and arguments[-1] is not ...:
        return list(arguments)
    return [arguments[0]] * len(node.value)


def _meant(type_: Any, node: Node) -> Any:
    """The member of an Annotated, Optional or Union type that a value like `node` is meant for."""
    members = _members(type_)
    if node.entries is not None and (structs := _structs(type_)):
        name = structs[0].__struct_config__.tag_field
        tag = node.value.get(name) if len(structs) > 1 else structs[0].__struct_config__.tag
        return next(s for s in structs if s.__struct_config__.tag == tag)
    fits = _is_list if node.entries is None else _is_mapping
    return next((member for member in members if fits(member)), None)


def _members(type_: Any) -> list[Any]:
    if typing.get_origin(type_) is typing.Annotated:
        return _members(typing.get_args(type_)[0])
    if typing.get_origin(type_) in (typing.Union, types.UnionType):
        return [part for member in typing.get_args(type_) for part in _members(member)]
    return [type_]


def _structs(type_: Any) -> list[Any]:
    return [member for member in _members(type_) if _is_struct(member)]


def _is_struct(type_: Any) -> bool:
    return isinstance(type_, type) and issubclass(type_, msgspec.Struct)


def _is_mapping(type_: Any) -> bool:
    return _is_a(type_, Mapping)


def _is_list(type_: Any) -> bool:
    return _is_a(type_, Collection) and not _is_a(type_, (Mapping, str, bytes))


def _is_a(type_: Any, families: type | tuple[type, ...]) -> bool:
    origin = typing.get_origin(type_) or type_
    return isinstance(origin, type) and issubclass(origin, families)


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def _at(path: str, text: str) -> str:
    return f"{path}: {text}" if path else text
