"""Merges settings from several sources; each value keeps its source."""

import difflib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import msgspec
from msgspec import Struct

from gigabrain_zenoh.config import loading
from gigabrain_zenoh.config.type_members import is_mapping, is_struct, members_of
from gigabrain_zenoh.config.yaml_text import Entry, Node
from gigabrain_zenoh.errors import ConfigError, UnknownName
from gigabrain_zenoh.host.network import host_shown

T = TypeVar("T")
DEFAULT = "default"


class Row(NamedTuple):
    """One setting, with its value and the source of the value."""

    key: str  # dotted
    value: Any  # of an address only its host
    source: str


class Layers:
    """A tree of settings. A later layer merges its mappings, and replaces other values."""

    def __init__(self, source: str) -> None:
        self.root = Node(0, {}, entries=())
        self._places = [source]  # texts of places; a node's `line` is its index here

    def add(self, root: Node, place: Callable[[int], str]) -> None:
        """Merge a tree into the others; `place` returns the text of one of its lines."""
        self.root = _merged(self.root, self._numbered(root, place))

    def add_values(self, values: Mapping[str, Any], source: str) -> None:
        """Merge plain values into the others."""
        self.add(_tree(values), lambda _: source)

    def convert(self, type_: type[T], at: Sequence[str] = ()) -> T:
        """Convert a section to a `type_`. Raises ConfigError with the place."""
        return loading.converted(loading.part(self.root, at), type_, self.place)

    def value(self, *at: str) -> Any:
        """Return the value at a path; None without one."""
        node = self._find(at)
        return node.value if node else None

    def rows(self, settings: Struct, at: Sequence[str] = ()) -> Iterator[Row]:
        """Yield every value of `settings`, the converted section `at`, with its source."""
        prefix = "".join(f"{name}." for name in at)
        for path, value in _leaves(msgspec.json.decode(msgspec.json.encode(settings))):
            yield Row(prefix + ".".join(path), _shown(value), self.source_of((*at, *path)))

    def place(self, number: int) -> str:
        """Return the text of the place that a node of the merged tree has as its `line`."""
        return self._places[number]

    def source_of(self, path: Sequence[str]) -> str:
        """Return the source of the value at a path."""
        for end in range(len(path), 0, -1):  # a source may give a whole list at once
            node = self._find(path[:end])
            if node and (node.entries is None or end == len(path)):
                return self._places[node.line]
        return DEFAULT

    def _find(self, path: Sequence[str]) -> Node | None:
        node: Node | None = self.root
        for name in path:
            entries = (node.entries if node else None) or ()
            node = {entry.key: entry.node for entry in entries}.get(name)
        return node

    def _numbered(self, node: Node, place: Callable[[int], str]) -> Node:
        """Return the tree with indices of places instead of lines."""

        def number(line: int) -> int:
            text = place(line)
            if self._places[-1] != text:
                self._places.append(text)
            return len(self._places) - 1

        def numbered(node: Node) -> Node:
            line = number(node.line)
            if node.entries is not None:
                entries = tuple(
                    Entry(entry.key, number(entry.line), numbered(entry.node))
                    for entry in node.entries
                )
                return replace(node, line=line, entries=entries)
            if node.items is not None:
                return replace(node, line=line, items=tuple(map(numbered, node.items)))
            return replace(node, line=line)

        return numbered(node)


def _merged(under: Node, over: Node) -> Node:
    if under.entries is None or over.entries is None:
        return over
    entries = {entry.key: entry for entry in under.entries}
    for entry in over.entries:
        known = entries.get(entry.key)
        node = _merged(known.node, entry.node) if known else entry.node
        entries[entry.key] = replace(entry, node=node)
    values = {key: entry.node.value for key, entry in entries.items()}
    return replace(over, value=values, entries=tuple(entries.values()))


def _tree(value: Any) -> Node:
    if isinstance(value, Mapping):
        entries = tuple(Entry(key, 0, _tree(inner)) for key, inner in value.items())
        return Node(0, {entry.key: entry.node.value for entry in entries}, entries=entries)
    if isinstance(value, (list, tuple)):
        items = tuple(map(_tree, value))
        return Node(0, [item.value for item in items], items=items)
    return Node(0, value, text="" if value is None else str(value))


def _leaves(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield all paths and values, without mappings; but an empty mapping is a value."""
    if isinstance(value, Mapping) and (value or not path):
        for key, inner in value.items():
            yield from _leaves(inner, (*path, key))
    else:
        yield path, value


def _shown(value: Any) -> Any:
    """Return plain values with only the hosts of addresses."""
    if isinstance(value, str):
        return host_shown(value)
    if isinstance(value, Mapping):
        return {key: _shown(inner) for key, inner in value.items()}
    return [_shown(inner) for inner in value] if isinstance(value, list) else value


class Assignment(NamedTuple):
    """A setting from KEY=VALUE."""

    key: str
    node: Node

    def nested(self) -> Node:
        """Return a tree with only this value."""
        node = self.node
        for name in reversed(self.key.split(".")):
            node = Node(0, {name: node.value}, entries=(Entry(name, 0, node),))
        return node


def assignment(text: str) -> Assignment:
    """Parse KEY=VALUE, with a YAML value. Raises ConfigError."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"--set: expected KEY=VALUE, got {host_shown(text)!r}")
    root = loading.document(f"value: {value}", f"--set {host_shown(text)}")
    return Assignment(key.strip(), loading.part(root, ("value",)))


def keys_of(type_: Any, known: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield the dotted keys of a Struct and its sections.

    `known` contains the types of sections that are free mappings, by key. A key that ends with `.`
    is a mapping with any names.
    """
    for field in msgspec.structs.fields(type_):
        key = f"{prefix}{field.encode_name}"
        yield key
        types = [known[key]] if key in known else members_of(field.type)
        for member in types:
            if is_struct(member):
                yield from keys_of(member, known, f"{key}.")
            elif is_mapping(member):
                yield f"{key}."


def full_key(name: str, keys: Iterable[str], preferred: str) -> str:
    """Return the key for `name`: the same, or the only key that ends with it.

    Among several it is the key in the section `preferred`. Raises UnknownName with the nearest key,
    and ConfigError for an ambiguous name.
    """
    known = list(keys)
    if name in known or any(key.endswith(".") and name.startswith(key) for key in known):
        return name
    found = [key for key in known if key.endswith(f".{name}")]
    if len(found) > 1:
        found = [key for key in found if key == f"{preferred}.{name}"] or found
    if len(found) == 1:
        return found[0]
    if found:
        raise ConfigError(f"--set: {name!r} is in several places; write {' or '.join(found)}")
    raise UnknownName(f"--set: no setting {name!r}{_hint(name, known)}", value=name)


def _hint(name: str, known: Sequence[str]) -> str:
    last = {key.rstrip(".").rpartition(".")[2]: key.rstrip(".") for key in known}
    whole = difflib.get_close_matches(name, known, 1, 0.8)
    close = difflib.get_close_matches(name.rpartition(".")[2], last, 1, 0.6)
    meant = whole[0] if whole else last[close[0]] if close else ""
    suggestion = f"; did you mean {meant!r}?" if meant else ";"
    return f"{suggestion} `gigabrain config` lists all"
