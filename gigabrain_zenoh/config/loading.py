"""Configuration: a YAML file becomes a frozen msgspec Struct, or an error of one line.

Own code: msgspec, like pydantic, names a path and no line, and under a dict not even a path. This
walks the document beside the type and finds the line.
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
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import expanded, read_bounded

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
}


def expected(type_: Any) -> str:
    """Return words for the values of `type_`, with its limits."""
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
    """Return the content of the file as it is written there."""
    if node.entries is not None:
        return "a mapping"
    if node.items is not None:
        return f"a list of {len(node.items)}"
    if node.value is None:
        return node.text or "nothing"
    text = node.text if len(node.text) <= _LONGEST else node.text[: _LONGEST - 3] + "..."
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
    """One line for people about one line of a file (from 1)."""

    line: int
    text: str


def find_fault(root: Node, type_: Any) -> FieldFault | None:
    """Return the first fault, in the order of the file, that keeps `root` from being a `type_`."""
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
        if structs:  # its fields are valid, so its own __post_init__ refused it
            return _own_fault(node, path, line, re.sub(r" - at `[^`]*`$", "", str(error)))
        hint = nearest(node.value, choices(type_)) or _as_field(node.value, structs_in(type_))
        return FieldFault(line, _at(path, f"expected {expected(type_)}, got {got(node)}{hint}"))
    return None


def _no_value(entries: tuple[Entry, ...], structs: list[Any], path: str) -> FieldFault | None:
    """Return the fault of the first field if none has a value, as where `explore:` stands alone."""
    of = {field.encode_name: field.type for field in msgspec.structs.fields(structs[0])}
    first = next(iter(entries), None)
    if first is None or first.key not in of or any(one.node.value is not None for one in entries):
        return None
    wanted = expected(of[first.key]).removesuffix(" or null")
    text = f"expected {wanted}, got {got(first.node)}{_as_field(first.key, structs)}"
    return FieldFault(first.line, _at(_join(path, first.key), text))


def _as_field(name: object, structs: list[Any]) -> str:
    """Return `; write `explore: {}`` if one of the Structs has a field of that name."""
    for field in (one for struct in structs for one in msgspec.structs.fields(struct)):
        if field.encode_name == name:
            inner = [msgspec.structs.fields(one) for one in structs_in(field.type)]
            bare = any(not any(one.required for one in fields) for fields in inner)
            return f"; write `{name}: {'{}' if bare else '...'}`"
    return ""


def _own_fault(node: Node, path: str, line: int, text: str) -> FieldFault:
    """Return the line of a Struct's own error, which may begin with a path: `FIELD.PART[2]: `.

    Otherwise it is the line of the first field of the file that the error names.
    """
    match = re.match(r"(\w+(?:\.\w+|\[\d+\])*): ", text)
    if match and (at := line_of(node, re.findall(r"\w+", match[1]))):
        return FieldFault(at, _join(path, text))
    lines = {entry.key: entry.line for entry in node.entries or ()}
    named = (lines[word] for word in re.findall(r"\w+", text) if word in lines)
    return FieldFault(next(named, line), _at(path, text))


def line_of(node: Node, path: Sequence[str]) -> int | None:
    """Return the line of the last part of `path` that the document has; None if it has none."""
    found = None
    for part in path:
        entry = next((one for one in node.entries or () if one.key == part), None)
        if entry:
            found, node = entry.line, entry.node
        elif node.items and part.isdecimal() and int(part) < len(node.items):
            node = node.items[int(part)]
            found = node.line
        else:
            break
    return found


def line_in(path: Path, place: Sequence[str]) -> int | None:
    """Return the line of a part of a YAML file, or of the nearest part around it that is there."""
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
    type_ = _meant(of, node)
    if node.entries is not None and is_struct(type_):
        others = [one for one in members_of(of) if not is_struct(one) and one is not types.NoneType]
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
    among = ", ".join(known) or "none"
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


def _meant(type_: Any, node: Node) -> Any:
    """Return the member of an Annotated, Optional or Union type that fits a value like `node`."""
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
MAX_BYTES = 256 * 1024  # a hundred times what a large robot's file holds


def load(path: Path, type: type[T]) -> T:
    """Return the `type` that a YAML file describes.

    Raises ConfigError, whose one line reads `FILE:LINE: what is wrong; what was expected`.
    """
    return loads(read(path), type, str(path))


FILE_ENDINGS = (".yaml", ".yml", ".xml", ".mjcf", ".png", ".pgm")


def names_file(name: str) -> bool:
    """Return whether a setting that is a name or a file is a file."""
    return name.endswith(FILE_ENDINGS)


def beside(name: str, folder: Path) -> str:
    """Return a setting with its path, if it is one, taken from `folder`."""
    return str(folder.absolute() / expanded(name)) if names_file(name) else name


def read(path: Path) -> str:
    """Return the text of a YAML file. Raises ConfigError."""
    try:
        data = read_bounded(path, MAX_BYTES)
        return data.decode()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file{_nearest(path)}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        byte = data[error.start]
        raise ConfigError(f"{path}:{line}: byte 0x{byte:02x}; expected UTF-8 text") from None


def loads(text: str, type: type[T], source: str, at: Sequence[str] = ()) -> T:
    """Return the `type` that a YAML text describes; `source` is the file name in errors.

    With `at`, such as ("decision", "settings"), only that section is read; missing ones are empty.
    """
    root = part(document(text, source), at)
    return converted(root, type, lambda line: f"{source}:{line}")


def document(text: str, source: str) -> Node:
    """Return the tree of a YAML text, in present words. Raises ConfigError with its line."""
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
    """Return the `type` that a tree describes; `place` returns the words for one of its lines.

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
    there = path.parent.iterdir() if path.parent.is_dir() else ()
    names = {each.stem: each.name for each in there}
    close = difflib.get_close_matches(path.stem, names, 1)
    if not close:
        return "; expected a YAML file"
    return f"; did you mean '{path.with_name(names[close[0]])}'?"


def located(path: Path, error: ConfigError) -> ConfigError:
    """Return `error` with the line of its invalid value in the file, if that is found."""
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
