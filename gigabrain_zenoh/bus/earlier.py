"""What was known before a tick began.

Within a tick it must not matter which of two messages is quicker. What came with the present tick
therefore counts from the next.
"""

from typing import Generic, TypeVar

from gigabrain_schemas.base import TICK_NS, Message

M = TypeVar("M", bound=Message)


class Earlier(Generic[M]):
    """The newest message of an earlier tick."""

    def __init__(self) -> None:
        self._newest: M | None = None
        self._before: M | None = None

    def receive(self, message: M) -> None:
        """Take one message."""
        newest = self._newest
        same_start = newest and newest.boot == message.boot
        if newest and not (same_start and newest.tick >= message.tick):
            self._before = newest  # what claims to be of the future never comes before anything
        self._newest = message

    def at(self, boot: int, tick: int, within_ns: int) -> M | None:
        """The newest of before `tick`, of this boot and no older than `within_ns`."""
        for message in (self._newest, self._before):
            if message is None or message.boot != boot:
                continue
            if 0 < (tick - message.tick) * TICK_NS <= within_ns:
                return message
        return None
