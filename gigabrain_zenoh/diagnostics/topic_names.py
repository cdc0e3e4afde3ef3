"""Names of topics as people type them, and the keys and messages that they stand for."""

from collections.abc import Iterable

from msgspec import Struct

from gigabrain_schemas.topics import TOPICS, Topic, current_key
from gigabrain_zenoh.errors import UnknownName, unknown

PREFIX = "robot/"
COMMAND_OF_SERVICE = {  # services that people take for topics, and the commands that call them
    "estop": "estop", "release": "release", "enable": "enable", "goal": "goto X Y",
    "mission": "mission FILE", "task_change": "task", "map_save": "map save",
    "param": "param", "audit_log": "audit", "describe": "node info",
}  # fmt: skip


class Target(Struct, frozen=True):
    """A key expression to subscribe to, and the topic of the table that it belongs to."""

    pattern: str
    topic: Topic | None  # type: ignore[type-arg]  # None for keys of other projects


def matches(pattern: str, key: str) -> bool:
    """Return whether a Zenoh key expression covers `key`: `*` is one part, `**` any number."""
    return _matches(pattern.split("/"), key.split("/"))


def _matches(pattern: list[str], key: list[str]) -> bool:
    if not pattern:
        return not key
    first, rest = pattern[0], pattern[1:]
    if first == "**":
        return any(_matches(rest, key[i:]) for i in range(len(key) + 1))
    return bool(key) and first in ("*", key[0]) and _matches(rest, key[1:])


def topic_of(key: str) -> Topic | None:  # type: ignore[type-arg]
    """Return the topic that a key belongs to; None for a key of another project."""
    return next((topic for topic in TOPICS if matches(topic.at("**"), key)), None)


def short(key: str) -> str:
    """Return a key as people type it, without `robot/`."""
    return key.removeprefix(PREFIX)


def target(name: str, live_keys: Iterable[str] = ()) -> Target | None:
    """Return what `scan`, `robot/scan`, `health/driver`, a live key or an expression stands for.

    None where it is none of these.
    """
    key = current_key(PREFIX + short(name))
    for topic in TOPICS:
        if key == topic.key:
            return Target(topic.at("*"), topic)
        if topic.many and matches(topic.at("*"), key):
            return Target(key, topic)
    if name in live_keys or "*" in name:
        return Target(name, topic_of(name))
    return Target(key, topic_of(key)) if key in live_keys else None


def no_topic(name: str, live_keys: Iterable[str]) -> UnknownName:
    """Return the error for an unknown topic; it suggests the nearest topic, or a command."""
    if command := COMMAND_OF_SERVICE.get(short(name)):
        return UnknownName(f"{name} is a service, not a topic; use: gigabrain {command}")
    return unknown("topic", name, {*(short(t.key) for t in TOPICS), *map(short, live_keys)})
