"""What people call a topic, and what it is on the bus."""

from collections.abc import Iterable

from msgspec import Struct

from gigabrain_schemas.topics import TOPICS, Topic
from gigabrain_zenoh.diagnostics.keyexpr import matches
from gigabrain_zenoh.errors import UnknownName, unknown

OURS = "robot/"
COMMANDS = {  # what asks the questions that people take for topics
    "estop": "estop", "release": "release", "enable": "enable", "goal": "goto X Y",
    "mission": "mission FILE", "task_change": "task", "map_save": "map save",
    "param": "param", "audit_log": "audit", "describe": "node info",
}  # fmt: skip


class Target(Struct, frozen=True):
    """What to listen to, and the line of the table that it belongs to."""

    pattern: str
    topic: Topic | None  # type: ignore[type-arg]  # None for keys that are not ours


def topic_of(key: str) -> Topic | None:  # type: ignore[type-arg]
    """The topic that a key belongs to; None for one that is not ours."""
    return next((topic for topic in TOPICS if matches(topic.at("**"), key)), None)


def table_name(key: str) -> str | None:
    """The name of a key's message type; None for one that is not ours."""
    topic = topic_of(key)
    return topic.type.__name__ if topic else None


def short(key: str) -> str:
    """A key as people type it."""
    return key.removeprefix(OURS)


def target(name: str, alive: Iterable[str] = ()) -> Target | None:
    """The topic `scan`, `robot/scan` or `health/driver`, a key that is `alive`, or an expression.

    None where it is none of these.
    """
    key = OURS + short(name)
    for topic in TOPICS:
        if key == topic.key:
            return Target(topic.at("*"), topic)
        if topic.many and matches(topic.at("*"), key):
            return Target(key, topic)
    if name in alive or "*" in name:
        return Target(name, topic_of(name))
    return Target(key, topic_of(key)) if key in alive else None


def not_found(name: str, alive: Iterable[str]) -> Exception:
    """The error for a name that is no topic, with the nearest, or with what asks that question."""
    if command := COMMANDS.get(short(name)):
        return UnknownName(f"{name} is a question, and no topic; ask it: gigabrain {command}")
    return unknown("topic", name, {*(short(t.key) for t in TOPICS), *map(short, alive)})
