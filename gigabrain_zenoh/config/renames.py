"""Old words of YAML files and of the command line, which still work and print a notice.

The rows are removed in the release `REMOVED_IN`.
"""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from gigabrain_zenoh.errors import ConfigError

if TYPE_CHECKING:  # PyYAML takes long to import, and a command line does not need it
    from gigabrain_zenoh.config.yaml_text import Node

REMOVED_IN = "0.3"


@dataclass(frozen=True)
class Rename:
    """One old word and its replacement, with the values that were renamed with it.

    In YAML, `old` ends with the field and the mappings around it (`decision.begin`), and `new` is
    relative to the same mapping (`start`, or `avoid.turn` for a field that moved one level down).
    With `when`, the row applies only if it returns True for the mapping that has the field. An
    empty `new` drops a field without effect.

    On the command line, `old` is a command (`warm`, `task list`), an option of a command
    (`goto --how`) or an option of every command (`--remember`); `new` is the replacement. If a
    renamed option has `values`, it accepts no others.
    """

    old: str
    new: str
    values: Mapping[str, Any] = field(default_factory=dict)
    when: Callable[[Mapping[str, Any]], bool] | None = None

    def holds_for(self, mapping: Mapping[str, Any]) -> bool:
        """Return whether the row applies to a field of `mapping`."""
        return self.when is None or self.when(mapping)


def _navigates(decision: Mapping[str, Any]) -> bool:
    return bool(decision.get("behaviour") == "navigate")


def _avoids(decision: Mapping[str, Any]) -> bool:
    return bool(decision.get("behaviour", "avoid") == "avoid")


YAML_WORDS: tuple[Rename, ...] = (
    Rename("decision.turn", "settings.turn", when=_avoids),
    Rename("decision.turn", "", when=_navigates),
    Rename("decision.linear_speed", "settings.max_linear_speed", when=_avoids),
    Rename("decision.linear_speed", "", when=_navigates),
    Rename("decision.angular_speed", "settings.max_angular_speed", when=_avoids),
    Rename("decision.angular_speed", "", when=_navigates),
    Rename("decision.speed_limit", "settings.max_linear_speed", when=_navigates),
    Rename("decision.speed_limit", "", when=_avoids),
    Rename("decision.unknown", "settings.unknown_space", when=_navigates),
    Rename("decision.unknown", "", when=_avoids),
    Rename("decision.samples", "settings.samples", when=_navigates),
    Rename("decision.samples", "", when=_avoids),
    Rename("decision.begin", "settings.start", {"roam": "explore"}, when=_navigates),
    Rename("decision.begin", "", when=_avoids),
    Rename("decision.scripts", "settings.scripts", when=_navigates),
    Rename("decision.scripts", "", when=_avoids),
)
_TURNS = {side: f"turn={side}" for side in ("left", "right", "clearer")}
CLI_WORDS: tuple[Rename, ...] = (
    Rename("demo --turn", "--set", _TURNS),
    Rename("decision --turn", "--set", _TURNS),
    Rename("decision --begin", "--set", {"wait": "start=wait", "roam": "start=explore"}),
    Rename("warm", "precompile"),
    Rename("render --png", "--file"),
    Rename("goto --how", "--mode"),
    Rename("explore --how", "--mode"),
    Rename("patrol --how", "--mode"),
    Rename("mission --how", "--mode"),
    Rename("decision --remember", "--state-dir"),
    Rename("driver run --remember", "--state-dir"),
)

FAULT_NAMES: tuple[Rename, ...] = (
    Rename("one-part-of-decision-hangs", "decision-loop-hangs"),
    Rename("cpu-hogs", "busy-machine"),
    Rename("goal-goes-on", "goal-recovery"),
    Rename("map-goes-on", "map-recovery"),
    Rename("frozen-for-ever", "frozen-until-restarted"),
    Rename("one-message", "extreme-messages"),
)

_printed: set[str] = set()


def renamed_fields(root: "Node", source: str, table: Sequence[Rename] = YAML_WORDS) -> "Node":
    """Return a YAML document with the current words, and print a notice for each old one.

    If a file has both words the old one stays, so that reading it reports the unknown field.
    """
    return _renamed_node(root, "", source, table) if table else root


def renamed_settings(
    settings: dict[str, Any], part: str, table: Sequence[Rename] = YAML_WORDS
) -> dict[str, Any]:
    """Return the settings of one part of a deployment, such as `decision`, with current words.

    Used for settings in a recording; prints nothing.
    """
    result = dict(settings)
    for rename in table:
        prefix, _, old = rename.old.rpartition(".")
        *outer, new = rename.new.split(".")
        if prefix != part or old not in result or not rename.holds_for(settings):
            continue
        value, inner = result.pop(old), result
        if not rename.new:
            continue
        for key in outer:
            inner = inner.setdefault(key, {})
        inner[new] = rename.values.get(value, value) if isinstance(value, str) else value
    return result


def renamed_word(word: str, table: Sequence[Rename]) -> str:
    """Return the current form of a word; print a notice if it is an old one."""
    for rename in table:
        if rename.old == word:
            _notice("", word, rename.new)
            return rename.new
    return word


def renamed_arguments(
    arguments: Iterable[str], table: Sequence[Rename] = CLI_WORDS
) -> tuple[list[str], list[str]]:
    """Return the arguments of `gigabrain` in current words, and a notice for each old one.

    Raises ConfigError for a value that an old option does not take.
    """
    result = list(arguments)
    notices: list[str] = []
    for rename in table:
        command, dashes, option = rename.old.partition("--")
        words = command.split()
        if result[: len(words)] != words:
            continue
        if dashes:
            notices += _rename_option(result, f"--{option}", rename)
        else:
            result[: len(words)] = rename.new.split()
            notices.append(_notice_text(rename.old, rename.new))
    return result, notices


def _rename_option(arguments: list[str], option: str, rename: Rename) -> Iterator[str]:
    """Replace an old option in `arguments`; yield the notices. Raises ConfigError."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    for i, argument in enumerate(arguments[:end]):
        name, equals, value = argument.partition("=")
        apart = not equals and bool(rename.values) and i + 1 < end
        value = arguments[i + 1] if apart else value
        if name != option or (option == rename.new and value not in rename.values):
            continue
        if (equals or apart) and rename.values and value not in rename.values:
            known = ", ".join(map(repr, rename.values))
            raise ConfigError(f"{option}: expected one of {known}, got {value!r}")
        new = rename.values.get(value, value)
        arguments[i] = rename.new + equals + (new if equals else "")
        if apart:
            arguments[i + 1] = new
        if rename.values and new != value:
            yield _notice_text(f"{option} {value}", f"{rename.new} {new}")
        else:
            yield _notice_text(option, rename.new)


def _renamed_node(node: "Node", path: str, source: str, table: Sequence[Rename]) -> "Node":
    if node.items is not None:
        items = tuple(_renamed_node(item, path, source, table) for item in node.items)
        return replace(node, items=items, value=[item.value for item in items])
    if node.entries is None:
        return node
    result = replace(node, entries=(), value={})
    taken = {entry.key for entry in node.entries}
    for entry in node.entries:
        below = f"{path}.{entry.key}"
        inner = _renamed_node(entry.node, below, source, table)
        rename = _found(below, inner, node.value, table)
        if rename and not rename.new:
            _notice(f"{source}:{entry.line}: ", entry.key, "")
        elif rename and (rename.new == entry.key or rename.new not in taken):
            value = rename.values.get(inner.value) if isinstance(inner.value, str) else None
            new = rename.new if value is None else f"{rename.new}: {value}"
            old = entry.key if value is None else f"{entry.key}: {inner.value}"
            _notice(f"{source}:{entry.line}: ", old, new)
            if value is not None:
                inner = replace(inner, value=value, text=str(value))
            result = _with(result, rename.new, entry.line, inner)
        else:
            result = _with(result, entry.key, entry.line, inner, whole=True)
    return result


def _found(
    path: str, node: "Node", mapping: Mapping[str, Any], table: Sequence[Rename]
) -> Rename | None:
    value = node.value if isinstance(node.value, str) else ""
    for rename in table:
        same_word = rename.old.rpartition(".")[2] == rename.new
        if not path.endswith(f".{rename.old}") or not rename.holds_for(mapping):
            continue
        if not same_word or value in rename.values:
            return rename
    return None


def _with(node: "Node", key: str, line: int, value: "Node", *, whole: bool = False) -> "Node":
    """Return mapping `node` with `value` at `key`; a dotted key addresses inner mappings."""
    from gigabrain_zenoh.config.yaml_text import Entry, Node

    entries = node.entries or ()
    first, _, rest = (key, "", "") if whole else key.partition(".")
    same = next((entry for entry in entries if entry.key == first), None)
    if rest:
        outer = same.node if same else Node(line, {}, entries=())
        value = _with(outer, rest, line, value)
    elif same:  # an earlier, dotted rename created this mapping
        for entry in same.node.entries or ():
            value = _with(value, entry.key, entry.line, entry.node, whole=True)
    kept = tuple(entry for entry in entries if entry is not same)
    entries = (*kept, Entry(first, line, value))
    return replace(node, entries=entries, value={e.key: e.node.value for e in entries})


def _notice(where: str, old: str, new: str) -> None:
    text = where + _notice_text(old, new)
    if text not in _printed:
        _printed.add(text)
        print(text, file=sys.stderr)


def _notice_text(old: str, new: str) -> str:
    if not new:
        return f"'{old}' has no effect here; remove it before {REMOVED_IN}"
    return f"'{old}' is now '{new}'; the old form works until {REMOVED_IN}"
