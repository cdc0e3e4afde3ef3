"""Configuration: a YAML file becomes a frozen msgspec Struct, or an error of one line.

Own code: msgspec, like pydantic, reports a path but no line, and inside a dict not even a path.
This module compares the document with the type, and finds the line.
"""

import difflib
import re
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import inspect as mi

from gigabrain_zenoh.config import yaml_text
from gigabrain_zenoh.config.name_words import words_of
from gigabrain_zenoh.config.renames import renamed_fields
from gigabrain_zenoh.config.type_members import (
    is_list,
    is_mapping,
    is_struct,
    members_of,
    structs_in,
)
from gigabrain_zenoh.config.yaml_text import Entry, Node
from gigabrain_zenoh.errors import MAX_UNKNOWN_CHARS, ConfigError, listed
from gigabrain_zenoh.host.files import cannot_read, expanded, read_bounded
from gigabrain_zenoh.host.network import host_shown

_MAX_SHOWN_CHARS = 60  # of a value in an error
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
}


def expected(type_: Any) -> str:
    """Return a text for the values of `type_`, with its limits, such as `a number >= 0`."""
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
    found = [f"{words} {limit}" for words, limit in given if limit is not None]
    if pattern := getattr(info, "pattern", None):
        found.append(words_of(pattern))
    return " " + " and ".join(found) if found else ""


def choices(type_: Any) -> list[Any]:
    """Return the values of a Literal or an Enum (also in a Union); empty for other types."""
    return _choices(mi.type_info(type_))


def _choices(info: mi.Type) -> list[Any]:
    if isinstance(info, mi.UnionType):
        return [value for member in info.types for value in _choices(member)]
    if isinstance(info, mi.LiteralType):
        return list(info.values)
    return [member.value for member in info.cls] if isinstance(info, mi.EnumType) else []


def one_of(values: Sequence[Any]) -> str:
    """Return `one of 'left', 'right'`, or the only value."""
    return "one of " + ", ".join(map(repr, values)) if len(values) > 1 else repr(values[0])


def got(node: Node) -> str:
    """Return a text for a node's content as it is written in the file."""
    if node.entries is not None:
        return "a mapping"
    if node.items is not None:
        return f"a list of {len(node.items)}"
    if node.value is None:
        return node.text or "nothing"
    longest, text = _MAX_SHOWN_CHARS, host_shown(node.text)
    text = text if len(text) <= longest else text[: longest - 3] + "..."
    if isinstance(node.value, bool) and text in ("on", "off"):
        return f"{text}, which is read as {str(node.value).lower()}; quote it for a text"
    return repr(text) if isinstance(node.value, str) else text


def nearest(name: object, known: Iterable[Any]) -> str:
    """Return `; did you mean 'turn'?` if a known name is similar, else an empty text."""
    names = [k for k in known if isinstance(k, str)]
    close = difflib.get_close_matches(name, names, 1, 0.6) if isinstance(name, str) else []
    return f"; did you mean {close[0]!r}?" if close else ""


@dataclass(frozen=True)
class FieldFault:
    """An error text of one line, with the line number in the file (from 1)."""

    line: int
    text: str


def find_fault(root: Node, type_: Any) -> FieldFault | None:
    """Return the first fault in `root`, in the order of the file; None for a valid `type_`."""
    return _find(root, type_, "", root.line)


def _find(node: Node, type_: Any, path: str, key_line: int) -> FieldFault | None:
    structs = structs_in(type_) if node.entries is not None else []
    if fault := _wrong_tag(node, structs, path, key_line):
        return fault
    for fault in _inside(node, type_, path, key_line):
        return fault
    try:
        msgspec.convert(node.value, type_)
    except msgspec.ValidationError as error:
        line = key_line if node.entries or node.items else node.line
        if structs and (fault := _no_value(node.entries or (), structs, path)):
            return fault
        if structs:  # its fields are valid, so its __post_init__ raised the error
            return _own_fault(node, path, line, re.sub(r" - at `[^`]*`$", "", str(error)))
        hint = nearest(node.value, choices(type_)) or _as_field(node.value, structs_in(type_))
        return FieldFault(line, _at(path, f"expected {expected(type_)}, got {got(node)}{hint}"))
    return None


def _no_value(entries: tuple[Entry, ...], structs: list[Any], path: str) -> FieldFault | None:
    """Return the fault of the first field if no field has a value, as in `explore:` alone."""
    field_types = {field.encode_name: field.type for field in msgspec.structs.fields(structs[0])}
    first = next(iter(entries), None)
    if first is None or first.key not in field_types:
        return None
    if any(entry.node.value is not None for entry in entries):
        return None
    wanted = expected(field_types[first.key]).removesuffix(" or null")
    text = f"expected {wanted}, got {got(first.node)}{_as_field(first.key, structs)}"
    return FieldFault(first.line, _at(_join(path, first.key), text))


def _as_field(name: object, structs: list[Any]) -> str:
    """Return `; write `explore: {}`` if one of the Structs has a field of that name."""
    for field in (each for struct in structs for each in msgspec.structs.fields(struct)):
        if field.encode_name == name:
            inner = [msgspec.structs.fields(struct) for struct in structs_in(field.type)]
            may_be_empty = any(not any(each.required for each in fields) for fields in inner)
            return f"; write `{name}: {'{}' if may_be_empty else '...'}`"
    return ""


def _own_fault(node: Node, path: str, line: int, text: str) -> FieldFault:
    """Return the fault for an error of a Struct's __post_init__.

    The text may begin with a path: `FIELD.PART[2]: `. Otherwise the line is that of the first field
    in the text, else `line`.
    """
    match = re.match(r"(\w+(?:\.\w+|\[\d+\])*): ", text)
    if match and (at := line_of(node, re.findall(r"\w+", match[1]))):
        return FieldFault(at, _join(path, text))
    lines = {entry.key: entry.line for entry in node.entries or ()}
    named = (lines[word] for word in re.findall(r"\w+", text) if word in lines)
    return FieldFault(next(named, line), _at(path, text))


def line_of(node: Node, path: Sequence[str]) -> int | None:
    """Return the line of the last part of `path` that exists in the document, or None."""
    found = None
    for part in path:
        entry = next((each for each in node.entries or () if each.key == part), None)
        if entry:
            found, node = entry.line, entry.node
        elif node.items and part.isdecimal() and int(part) < len(node.items):
            node = node.items[int(part)]
            found = node.line
        else:
            break
    return found


def line_in(path: Path, place: Sequence[str]) -> int | None:
    """Return the line of a part of a YAML file, or of the nearest part around it."""
    return line_of(yaml_text.read(read(path)), place)


def _wrong_tag(node: Node, structs: list[Any], path: str, key_line: int) -> FieldFault | None:
    """Return the fault of a union's tag field, which selects one of its Structs."""
    tags = [s.__struct_config__.tag for s in structs if s.__struct_config__.tag is not None]
    name = structs[0].__struct_config__.tag_field if tags else ""
    for entry in node.entries or ():
        if tags and entry.key == name and entry.node.value not in tags:
            hint = nearest(entry.node.value, tags)
            text = f"expected {one_of(tags)}, got {got(entry.node)}{hint}"
            return FieldFault(entry.line, _at(_join(path, name), text))
    if len(tags) > 1 and name not in node.value:
        return FieldFault(key_line, _at(path, f"missing field {name!r}; expected {one_of(tags)}"))
    return None


def _inside(node: Node, of: Any, path: str, key_line: int) -> Iterator[FieldFault]:
    type_ = _matching_member(of, node)
    if node.entries is not None and is_struct(type_):
        others = [t for t in members_of(of) if not is_struct(t) and t is not types.NoneType]
        instead = f"; without fields: {' or '.join(map(expected, others))}" if others else ""
        yield from _in_struct(node, node.entries, type_, path, key_line, instead)
    elif node.entries is not None and is_mapping(type_):
        for entry in node.entries:
            yield from _in_entry(entry, typing.get_args(type_), path)
    elif node.items is not None and is_list(type_):
        for i, (item, of) in enumerate(zip(node.items, _item_types(type_, node), strict=False)):
            if fault := _find(item, of, f"{path}[{i}]", item.line):
                yield fault


def _in_struct(
    node: Node, entries: tuple[Entry, ...], type_: Any, path: str, key_line: int, instead: str
) -> Iterator[FieldFault]:
    fields = {f.encode_name: f for f in msgspec.structs.fields(type_)}
    config = type_.__struct_config__
    known = sorted([*fields, config.tag_field] if config.tag is not None else fields)
    among = listed(known, MAX_UNKNOWN_CHARS)
    for entry in entries:
        if field := fields.get(entry.key):
            if fault := _find(entry.node, field.type, _join(path, entry.key), entry.line):
                yield fault
        elif entry.key not in known and config.forbid_unknown_fields:
            hint = nearest(entry.key, known) or ";"
            text = f"unknown field {entry.key!r}{hint} known: {among}{instead}"
            yield FieldFault(entry.line, text)
    for name, field in fields.items():
        if field.required and name not in node.value:
            text = f"missing field {name!r}; expected {expected(field.type)}"
            yield FieldFault(key_line, _at(path, text))


def _in_entry(entry: Entry, types_: tuple[Any, ...], path: str) -> Iterator[FieldFault]:
    key_type, value_type = types_ or (str, Any)
    if _find(Node(entry.line, entry.key, entry.key), key_type, "", entry.line):
        text = f"expected {expected(key_type)} as the name, got {entry.key!r}"
        yield FieldFault(entry.line, _at(path, text))
    if fault := _find(entry.node, value_type, _join(path, entry.key), entry.line):
        yield fault


def _item_types(type_: Any, node: Node) -> list[Any]:
    arguments = typing.get_args(type_) or (Any,)
    if typing.get_origin(type_) is tuple and arguments[-1] is not ...:
        return list(arguments)
    return [arguments[0]] * len(node.value)


def _matching_member(type_: Any, node: Node) -> Any:
    """Return the member of an Annotated, Optional or Union type that matches the kind of `node`."""
    members = members_of(type_)
    if node.entries is not None and (structs := structs_in(type_)):
        name = structs[0].__struct_config__.tag_field
        tag = node.value.get(name) if len(structs) > 1 else structs[0].__struct_config__.tag
        return next(s for s in structs if s.__struct_config__.tag == tag)
    fits = is_list if node.entries is None else is_mapping
    return next((member for member in members if fits(member)), None)


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def _at(path: str, text: str) -> str:
    return f"{path}: {text}" if path else text


T = TypeVar("T")
MAX_BYTES = 256 * 1024  # a hundred times the size of a large robot's file


def load(path: Path, type: type[T]) -> T:
    """Read a YAML file as a `type`.

    Raises ConfigError, with one line: `FILE:LINE: what is wrong; what was expected`.
    """
    return loads(read(path), type, str(path))


FILE_ENDINGS = (".yaml", ".yml", ".xml", ".mjcf", ".png", ".pgm")


def names_file(name: str) -> bool:
    """Return whether a setting, which may be a name or a file, is a file."""
    return name.endswith(FILE_ENDINGS)


def beside(name: str, folder: Path) -> str:
    """Return a setting; if it is a path, make it absolute, relative to `folder`."""
    return str(folder.absolute() / expanded(name)) if names_file(name) else name


def read(path: Path) -> str:
    """Return the text of a YAML file. Raises ConfigError."""
    try:
        data = read_bounded(path, MAX_BYTES)
        return data.decode()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file{_nearest(path)}") from None
    except OSError as error:
        raise cannot_read(path, error) from None
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        byte = data[error.start]
        raise ConfigError(f"{path}:{line}: byte 0x{byte:02x}; expected UTF-8 text") from None


def loads(text: str, type: type[T], source: str, at: Sequence[str] = ()) -> T:
    """Read a YAML text as a `type`; `source` is the file name in errors.

    With `at`, such as ("decision", "settings"), only that section is read. A missing section is
    empty.
    """
    root = part(document(text, source), at)
    return converted(root, type, lambda line: f"{source}:{line}")


def document(text: str, source: str) -> Node:
    """Return the tree of a YAML text, in current words. Raises ConfigError with the line."""
    try:
        return renamed_fields(yaml_text.read(text), source)
    except yaml_text.YamlFault as fault:
        raise _error(f"{source}:{fault.line}", str(fault)) from None


def part(root: Node, at: Sequence[str]) -> Node:
    """Return a section of a tree; a missing one is empty."""
    for name in at:
        found = (entry.node for entry in root.entries or () if entry.key == name)
        root = next(found, Node(root.line, {}, entries=()))
    return root


def converted(root: Node, type: type[T], place: Callable[[int], str]) -> T:
    """Convert a tree to a `type`; `place` returns the text of one of its lines.

    Raises ConfigError.
    """
    try:
        return msgspec.convert(root.value, type)
    except msgspec.ValidationError as error:
        where = find_fault(root, type) or FieldFault(root.line, str(error))
        raise _error(place(where.line), where.text) from None


def _error(place: str, text: str) -> ConfigError:
    return ConfigError(" ".join(f"{place}: {text}".split()))


def _nearest(path: Path) -> str:
    siblings = path.parent.iterdir() if path.parent.is_dir() else ()
    names = {each.stem: each.name for each in siblings}
    close = difflib.get_close_matches(path.stem, names, 1)
    if not close:
        return "; expected a YAML file"
    return f"; did you mean '{path.with_name(names[close[0]])}'?"


def located(path: Path, error: ConfigError) -> ConfigError:
    """Return `error` with the line of its invalid value in the file, if it is found."""
    if error.value is not None:
        for node in _scalars(yaml_text.read(read(path))):
            if node.value == error.value:
                return type(error)(f"{path}:{node.line}: {error}")
    return error


def _scalars(node: yaml_text.Node) -> Iterator[yaml_text.Node]:
    children = [entry.node for entry in node.entries or ()] + list(node.items or ())
    if not children:
        yield node
    for child in children:
        yield from _scalars(child)
