"""Strict YAML: one document of plain values, each with its line.

YAML 1.1 reads `12:30` as 750, `010` as 8 and `no` as false, and ignores the first of two equal
keys. That is dangerous in a robot's limits, so all of these are errors.
"""

import math
import re
from dataclasses import dataclass
from typing import Any

import yaml

# libyaml's loader is nine times faster than the Python one; not every platform's wheel has it.
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_BOOLEANS = {"true": True, "on": True, "false": False, "off": False}
_MAX_DEPTH = 32  # libyaml's composer recurses in C; deep nesting overflows the stack
_TOO_DEEP = f"nested too deeply; expected at most {_MAX_DEPTH} levels"
_MAX_NUMBER_CHARS = 64
_NUMBER = re.compile(r"[-+]?(?:(?:0|[1-9][0-9]*)(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")


class YamlFault(Exception):
    """An error in a text, with its line (from 1)."""

    def __init__(self, line: int, text: str) -> None:
        super().__init__(text)
        self.line = line


@dataclass(frozen=True)
class Entry:
    """One `key: value` of a mapping, with the line of the key (from 1)."""

    key: str
    line: int
    node: "Node"


@dataclass(frozen=True)
class Node:
    """A value of a YAML document: a scalar, or a mapping's entries, or a sequence's items."""

    line: int
    value: Any
    text: str = ""
    entries: tuple[Entry, ...] | None = None
    items: tuple["Node", ...] | None = None


def read(text: str) -> Node:
    """Return the one document in `text`. Raises YamlFault."""
    try:
        _refuse_indirections(text)
        root = yaml.compose(text, Loader=_LOADER)
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise YamlFault(line, f"not YAML: {error.reason}") from None
    except yaml.MarkedYAMLError as error:
        line = _line(error.problem_mark or error.context_mark)
        if "nesting depth" in (error.problem or ""):  # libyaml 0.2.6 itself stops at level 1000
            raise YamlFault(line, _TOO_DEEP) from None
        raise YamlFault(line, f"not YAML: {error.problem or error.context}") from None
    if root is None:
        raise YamlFault(1, "the file is empty; expected a mapping of fields")
    return _node(root)


def comment_line(text: str) -> int | None:
    """Return the line of the first comment in a valid text; None without comments."""
    end = 0
    for token in yaml.scan(text, Loader=yaml.SafeLoader):
        at = text.find("#", end, token.start_mark.index)
        if at >= 0:
            return text.count("\n", 0, at) + 1
        end = token.end_mark.index
    return None


def _refuse_indirections(text: str) -> None:
    """Raise YamlFault for aliases, tags, deep nesting, or several documents."""
    # checked by events, which need no recursion
    depth = documents = 0
    for event in yaml.parse(text, Loader=_LOADER):
        line = _line(event.start_mark)
        documents += isinstance(event, yaml.DocumentStartEvent)
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if documents > 1:
            raise YamlFault(line, "a second document begins here; expected one")
        if depth > _MAX_DEPTH:
            raise YamlFault(line, _TOO_DEEP)
        if isinstance(event, yaml.AliasEvent):
            raise YamlFault(line, f"alias '*{event.anchor}' is not allowed; write the value out")
        tag = getattr(event, "tag", None)
        if tag is not None:
            raise YamlFault(line, f"tag {tag!r} is not allowed; expected a plain value")


def _line(mark: Any) -> int:
    return int(mark.line) + 1 if mark else 1


def _node(node: yaml.Node) -> Node:
    line = _line(node.start_mark)
    if isinstance(node, yaml.MappingNode):
        entries = _entries(node)
        return Node(line, {e.key: e.node.value for e in entries}, entries=entries)
    if isinstance(node, yaml.SequenceNode):
        items = tuple(_node(item) for item in node.value)
        return Node(line, [item.value for item in items], items=items)
    assert isinstance(node, yaml.ScalarNode)
    return Node(line, _scalar(node, line), text=node.value)


def _entries(node: yaml.MappingNode) -> tuple[Entry, ...]:
    lines: dict[str, int] = {}
    entries = []
    for key, value in node.value:
        line = _line(key.start_mark)
        if not isinstance(key, yaml.ScalarNode):
            raise YamlFault(line, "a key is a list or a mapping; expected a name")
        if key.tag.endswith(":merge"):
            raise YamlFault(line, "merge key '<<' is not allowed; write the fields out")
        if not key.tag.endswith(":str"):
            raise YamlFault(line, f"key {key.value!r} is not read as a name; quote it")
        if key.value in lines:
            raise YamlFault(
                line,
                f"duplicate key {key.value!r}, first on line {lines[key.value]}; expected it once",
            )
        lines[key.value] = line
        entries.append(Entry(key.value, line, _node(value)))
    return tuple(entries)


def _scalar(node: yaml.ScalarNode, line: int) -> str | float | bool | None:
    """Return the value of one scalar. Its tag is implicit, as explicit tags are errors."""
    kind = node.tag.rsplit(":", 1)[1]
    text: str = node.value
    if kind == "null":
        return None
    if kind == "bool":
        if text not in _BOOLEANS:
            raise YamlFault(
                line, f"{text!r} is read as a boolean; write true or false, or quote it"
            )
        return _BOOLEANS[text]
    # YAML 1.1 reads `1e3` as a string, as it has no dot; here it is a number
    unquoted_number = kind == "str" and not node.style and _NUMBER.fullmatch(text) is not None
    if kind in ("int", "float") or unquoted_number:
        return _number(text, kind == "int", line)
    return text  # dates and `=` are text as well


def _number(text: str, whole: bool, line: int) -> float:
    if text.lower().lstrip("+-") in (".nan", ".inf"):
        raise YamlFault(line, f"{text} is not allowed; expected a finite number")
    if len(text) > _MAX_NUMBER_CHARS or not _NUMBER.fullmatch(text):
        raise YamlFault(
            line, f"{text[:_MAX_NUMBER_CHARS]!r}: write it as a plain decimal or quote it"
        )
    if whole:
        return int(text)
    value = float(text)
    if not math.isfinite(value):
        raise YamlFault(line, f"{text} is too large; expected a finite number")
    return value
