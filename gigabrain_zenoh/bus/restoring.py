"""Messages that are published only when they change, and again if another sender replaces them."""

from typing import Any, TypeVar

from msgspec.structs import replace

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.bus.bus import Bus

M = TypeVar("M", bound=Message)
NO_HEADER = dict.fromkeys(Message.__struct_fields__, 0)


class RestoringPublisher:
    """Publishes messages; `restore` publishes again those that another sender replaced."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._own: dict[str, tuple[Topic[Any], Message]] = {}  # by key
        self._replaced: set[str] = set()

    def publish(self, topic: Topic[M], message: M, *, basis: int = 0) -> M:
        """Publish a message, and return it as published. Receivers keep the newest of its topic."""
        first = topic.key not in self._own
        self._own[topic.key] = topic, replace(message, **NO_HEADER)
        if first:
            self._bus.subscribe(topic, self._on_message)
        return self._bus.publish(topic, message, basis=basis)

    def restore(self, *, basis: int = 0) -> None:
        """Publish again the messages that were replaced since the last call."""
        replaced, self._replaced = self._replaced, set()
        for key in replaced:
            self.publish(*self._own[key], basis=basis)

    def _on_message(self, key: str, message: Message) -> None:
        valid = message.boot in (0, self._bus.time.boot)  # receivers ignore other boots
        if not valid or replace(message, **NO_HEADER) != self._own[key][1]:
            self._replaced.add(key)
