"""What the bus asks of whatever moves its bytes, and one that stays inside the process."""

import asyncio
import contextlib
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple, Protocol, TypeVar

from gigabrain_schemas.topics import Priority, Topic
from gigabrain_zenoh.errors import GigabrainError

OnSample = Callable[[str, bytes], bool | None]  # key, payload; False: it cannot be read
OnRaw = Callable[[str, str, bytes], None]  # key, encoding, payload
Answer = Callable[[bytes], Awaitable[tuple[bytes, str]]]  # payload; payload and its encoding
Close = Callable[[], None]  # may be called twice
T = TypeVar("T")


class Link(NamedTuple):
    """Somebody at the other end of a link."""

    zid: str  # Zenoh's name of the session
    name: str  # the common name of its certificate; empty without one
    address: str
    there: bool  # False once it is gone


OnLink = Callable[[Link], None]


class Transport(Protocol):
    """Moves bytes between processes. All calls and callbacks happen on the event loop's thread."""

    def publish(self, topic: Topic[Any], key: str, payload: bytes, encoding: str) -> None:
        """Deliver to every listener on `key`, by the topic's QoS, without waiting for any."""
        ...

    def subscribe(self, key: str, on_sample: OnSample, depth: int) -> Close:
        """Call `on_sample` for what arrives on `key`; of what piles up the newest `depth` stay.

        At a depth of one it is the newest for which `on_sample` does not say False.
        """
        ...

    def tap(self, pattern: str, on_raw: OnRaw) -> Close:
        """Call `on_raw` at once, in whatever thread, for all that arrives on `pattern`."""
        ...

    def serve(self, key: str, answer: Answer, *, urgent: bool = False) -> Close:
        """Answer queries on `key`. A GigabrainError from `answer` travels back as its text.

        What is `urgent` is answered before all others that wait.
        """
        ...

    async def query(
        self, key: str, payload: bytes, encoding: str, timeout_s: float, priority: Priority
    ) -> list[bytes | str]:
        """Ask all who serve `key`: a payload per answer that came in time, a text per error."""
        ...

    def links(self, on_link: OnLink) -> Close:
        """Tell of everybody who is linked to this process, from now on and so far."""
        ...

    async def close(self) -> None:
        """Release the connection, within half a second. May be called twice."""
        ...


class LocalNetwork:
    """Joins transports inside this process, first in first out. For tests and replay."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, bytes]] = []
        self._listeners: list[tuple[str, OnSample]] = []
        self._servers: list[tuple[str, Answer]] = []
        self._queue: deque[tuple[str, bytes]] = deque()
        self._delivering = False

    def transport(self) -> "LocalTransport":
        """A new end."""
        return LocalTransport(self)

    def deliver(self, key: str, payload: bytes) -> None:
        """Hand `payload` to the listeners, after whatever is on its way already."""
        self._queue.append((key, payload))
        if self._delivering:
            return
        self._delivering = True
        try:
            while self._queue:
                key, payload = self._queue.popleft()
                for pattern, on_sample in tuple(self._listeners):
                    if _matches(pattern, key):
                        on_sample(key, payload)
        finally:
            self._delivering = False

    def listen(self, key: str, on_sample: OnSample) -> Close:
        """Register a listener."""
        return _added(self._listeners, (key, on_sample))

    def serve(self, key: str, answer: Answer) -> Close:
        """Register one who answers on `key`."""
        return _added(self._servers, (key, answer))

    def servers(self, pattern: str) -> list[Answer]:
        """Who answers on `pattern`."""
        return [answer for key, answer in self._servers if _matches(pattern, key)]


class LocalTransport:
    """One process's end of a LocalNetwork."""

    def __init__(self, network: LocalNetwork) -> None:
        self._network = network
        self._closers: list[Close] = []

    def publish(self, topic: Topic[Any], key: str, payload: bytes, encoding: str) -> None:
        """Record `payload` and hand it to the listeners."""
        self._network.sent.append((key, payload))
        self._network.deliver(key, payload)

    def subscribe(self, key: str, on_sample: OnSample, depth: int) -> Close:
        """Register a listener."""
        self._closers.append(self._network.listen(key, on_sample))
        return self._closers[-1]

    def tap(self, pattern: str, on_raw: OnRaw) -> Close:
        """Register a listener; encodings are not known here."""
        return self.subscribe(pattern, lambda key, payload: on_raw(key, "", payload), 1)

    def serve(self, key: str, answer: Answer, *, urgent: bool = False) -> Close:
        """Register one who answers on `key`; here nothing waits."""
        self._closers.append(self._network.serve(key, answer))
        return self._closers[-1]

    async def query(
        self, key: str, payload: bytes, encoding: str, timeout_s: float, priority: Priority
    ) -> list[bytes | str]:
        """Ask all who serve `key`."""
        replies = []
        for answer in self._network.servers(key):
            with contextlib.suppress(TimeoutError):
                replies.append(await asyncio.wait_for(_text_or(answer, payload), timeout_s))
        return replies

    def links(self, on_link: OnLink) -> Close:
        """Inside one process nobody comes by a link."""
        return lambda: None

    async def close(self) -> None:
        """Leave the network."""
        while self._closers:
            self._closers.pop()()


async def _text_or(answer: Answer, payload: bytes) -> bytes | str:
    try:
        return (await answer(payload))[0]
    except GigabrainError as error:
        return str(error)


def _added(entries: list[T], entry: T) -> Close:
    entries.append(entry)

    def close() -> None:
        with contextlib.suppress(ValueError):  # closed already
            entries.remove(entry)

    return close


def _matches(pattern: str, key: str) -> bool:
    """As Zenoh does, of a pattern whose last part may be a star or two."""
    start, _, last = pattern.rpartition("/")
    if last == "**":
        return not start or key == start or key.startswith(f"{start}/")
    return pattern == key or (last == "*" and key.rpartition("/")[0] == start)
