"""Settings from several places laid over one another; each value keeps the place it comes from."""

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

T = TypeVar("T")
DEFAULT = "default"


class Row(NamedTuple):
    """One setting as it is, and where its value comes from."""

    key: str  # dotted
    value: Any
    source: str


class Layers:
    """A tree of settings. Mappings of a later layer are merged in; other values replace."""

    def __init__(self, source: str) -> None:
        self.root = Node(0, {}, entries=())
        self._places = [source]  # by the number that stands for a line in the merged tree

    def add(self, root: Node, place: Callable[[int], str]) -> None:
        """Lay a tree over the others; `place` returns the words for one of its lines."""
        self.root = _merged(self.root, self._numbered(root, place))

    def add_values(self, values: Mapping[str, Any], source: str) -> None:
        """Lay plain values over the others."""
        self.add(_tree(values), lambda _: source)

    def convert(self, type_: type[T], at: Sequence[str] = ()) -> T:
        """Return the `type_` that a section describes. Raises ConfigError with its place."""
        return loading.converted(loading.part(self.root, at), type_, self.place)

    def value(self, *at: str) -> Any:
        """Return the value at a path; None where there is none."""
        node = self._find(at)
        return node.value if node else None

    def rows(self, settings: Struct, at: Sequence[str] = ()) -> Iterator[Row]:
        """Yield every value of `settings`, which a section describes, with its source."""
        prefix = "".join(f"{name}." for name in at)
        for path, value in _leaves(msgspec.json.decode(msgspec.json.encode(settings))):
            yield Row(prefix + ".".join(path), value, self.source_of((*at, *path)))

    def place(self, number: int) -> str:
        """Return the words for a number that stands for a line in the merged tree."""
        return self._places[number]

    def source_of(self, path: Sequence[str]) -> str:
        """Return where the value at a path comes from."""
        for end in range(len(path), 0, -1):  # a whole mapping or list may be given at once
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
        """Return the tree with numbers of places instead of lines."""

        def number(line: int) -> int:
            words = place(line)
            if self._places[-1] != words:
                self._places.append(words)
            return len(self._places) - 1

        def numbered(node: Node) -> Node:
            line = number(node.line)
            if node.entries is not None:
                entries = tuple(
                    Entry(one.key, number(one.line), numbered(one.node)) for one in node.entries
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
        entries = tuple(Entry(key, 0, _tree(one)) for key, one in value.items())
        return Node(0, {one.key: one.node.value for one in entries}, entries=entries)
    if isinstance(value, (list, tuple)):
        items = tuple(map(_tree, value))
        return Node(0, [one.value for one in items], items=items)
    return Node(0, value, text="" if value is None else str(value))


def _leaves(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield all values that are no mappings, with their paths; an empty mapping is a value."""
    if isinstance(value, Mapping) and (value or not path):
        for key, one in value.items():
            yield from _leaves(one, (*path, key))
    else:
        yield path, value


class Assignment(NamedTuple):
    """A setting given as KEY=VALUE."""

    key: str
    node: Node

    def nested(self) -> Node:
        """Return a tree with this value alone."""
        node = self.node
        for name in reversed(self.key.split(".")):
            node = Node(0, {name: node.value}, entries=(Entry(name, 0, node),))
        return node


def assignment(text: str) -> Assignment:
    """Parse KEY=VALUE, with the value as in YAML. Raises ConfigError."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"--set: expected KEY=VALUE, got {text!r}")
    root = loading.document(f"value: {value}", f"--set {text}")
    return Assignment(key.strip(), loading.part(root, ("value",)))


def keys_of(type_: Any, known: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield the dotted keys of a Struct, its sections too.

    `known` has the types of sections that are free mappings, by key. A key that ends with `.` is a
    mapping with names of one's own.
    """
    for field in msgspec.structs.fields(type_):
        key = f"{prefix}{field.encode_name}"
        yield key
        types = [known[key]] if key in known else members_of(field.type)
        for one in types:
            if is_struct(one):
                yield from keys_of(one, known, f"{key}.")
            elif is_mapping(one):
                yield f"{key}."


def full_key(name: str, keys: Iterable[str], preferred: str) -> str:
    """Return the key that `name` means: itself, or the only one that ends with it.

    Of several, the one in the section `preferred`. Raises UnknownName with the nearest key.
    """
    known = list(keys)
    if name in known or any(one.endswith(".") and name.startswith(one) for one in known):
        return name
    found = [one for one in known if one.endswith(f".{name}")]
    if len(found) > 1:
        found = [one for one in found if one == f"{preferred}.{name}"] or found
    if len(found) == 1:
        return found[0]
    if found:
        raise ConfigError(f"--set: {name!r} is in several places; write {' or '.join(found)}")
    raise UnknownName(f"--set: no setting {name!r}{_hint(name, known)}", value=name)


def _hint(name: str, known: Sequence[str]) -> str:
    last = {one.rstrip(".").rpartition(".")[2]: one.rstrip(".") for one in known}
    whole = difflib.get_close_matches(name, known, 1, 0.8)
    close = difflib.get_close_matches(name.rpartition(".")[2], last, 1, 0.6)
    meant = whole[0] if whole else last[close[0]] if close else ""
    suggestion = f"; did you mean {meant!r}?" if meant else ";"
    return f"{suggestion} `gigabrain config` lists all"
