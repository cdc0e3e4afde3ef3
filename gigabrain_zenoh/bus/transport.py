"""Interface through which the bus moves bytes, and an implementation inside one process."""

import asyncio
import contextlib
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar

from gigabrain_schemas.topics import Priority, Topic
from gigabrain_zenoh.errors import GigabrainError

OnSample = Callable[[str, bytes], bool | None]  # key, payload; returns False for an invalid payload
OnRaw = Callable[[str, str, bytes], None]  # key, encoding, payload
OnReaders = Callable[[bool], None]  # True while there are readers
Answer = Callable[[bytes], Awaitable[tuple[bytes, str]]]  # request; reply and its encoding
Close = Callable[[], None]  # may be called twice
T = TypeVar("T")


class Link(NamedTuple):
    """A link between this process's session and another session."""

    zid: str  # Zenoh's id of the other session
    name: str  # common name of its certificate; empty without one
    address: str
    open: bool  # False once it is closed


OnLink = Callable[[Link], None]


class Transport(Protocol):
    """Moves bytes between processes.

    Calls and callbacks run on the event loop's thread, except the callback of `tap`.
    """

    losses: int  # times that the link was lost so far; pending queries then get no answer

    def publish(self, topic: Topic[Any], key: str, payload: bytes, encoding: str) -> None:
        """Deliver to all listeners on `key` with the topic's QoS, without waiting for any."""
        ...

    def subscribe(self, key: str, on_sample: OnSample, depth: int, *, lazy: bool = False) -> Close:
        """Call `on_sample` for each sample on `key`; a busy loop keeps the newest `depth` samples.

        For a pattern, `depth` is per key. With a depth of one, it keeps the newest sample
        for which `on_sample` does not return False. Lazy samples do not wake the loop: they are
        delivered before the next sample that does.
        """
        ...

    def tap(self, pattern: str, on_raw: OnRaw) -> Close:
        """Call `on_raw` immediately, from any thread, for every sample on `pattern`."""
        ...

    def watch_readers(self, key: str, on_readers: OnReaders) -> Close:
        """Call `on_readers` now and at each change: True while others subscribe to `key`."""
        ...

    def serve(self, key: str, answer: Answer, *, urgent: bool = False) -> Close:
        """Answer queries on `key`. A GigabrainError from `answer` is sent back as its text.

        Queries on an `urgent` key are answered before all others that wait.
        """
        ...

    async def query(
        self, key: str, payload: bytes, encoding: str, timeout_s: float, priority: Priority
    ) -> list[bytes | str]:
        """Query all servers of `key`; return a payload per answer in time, and a text per error."""
        ...

    def links(self, on_link: OnLink) -> Close:
        """Call `on_link` for every link of this process: existing ones first, then each change."""
        ...

    async def close(self) -> None:
        """Close the connection within half a second. May be called twice."""
        ...


@dataclass
class _Watcher:
    key: str
    on_readers: OnReaders
    has_readers: bool  # argument of the newest call of `on_readers`


class LocalNetwork:
    """Connects transports inside this process, first in first out. For tests and replay."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, bytes]] = []
        self._listeners: list[tuple[str, OnSample]] = []
        self._watchers: list[_Watcher] = []
        self._servers: list[tuple[str, Answer]] = []
        self._queue: deque[tuple[str, bytes]] = deque()
        self._delivering = False

    def transport(self) -> "LocalTransport":
        """Return a new transport on this network."""
        return LocalTransport(self)

    def deliver(self, key: str, payload: bytes) -> None:
        """Hand `payload` to the listeners, after messages that are already queued."""
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
        """Register a listener; return a function that removes it."""
        remove = _add(self._listeners, (key, on_sample))
        self._notify_watchers()

        def close() -> None:
            remove()
            self._notify_watchers()

        return close

    def watch(self, key: str, on_readers: OnReaders) -> Close:
        """Register a watcher of the listeners on `key`; return a function that removes it."""
        watcher = _Watcher(key, on_readers, self._has_listener(key))
        on_readers(watcher.has_readers)
        return _add(self._watchers, watcher)

    def _notify_watchers(self) -> None:
        for watcher in tuple(self._watchers):
            before, watcher.has_readers = watcher.has_readers, self._has_listener(watcher.key)
            if watcher.has_readers != before:
                watcher.on_readers(watcher.has_readers)

    def _has_listener(self, key: str) -> bool:
        return any(_matches(pattern, key) for pattern, _ in self._listeners)

    def serve(self, key: str, answer: Answer) -> Close:
        """Register a server on `key`; return a function that removes it."""
        return _add(self._servers, (key, answer))

    def servers(self, pattern: str) -> list[Answer]:
        """Return the servers on keys that match `pattern`."""
        return [answer for key, answer in self._servers if _matches(pattern, key)]


class LocalTransport:
    """One process's transport on a LocalNetwork."""

    def __init__(self, network: LocalNetwork) -> None:
        self._network, self.losses = network, 0
        self._closers: list[Close] = []

    def publish(self, topic: Topic[Any], key: str, payload: bytes, encoding: str) -> None:
        """Record `payload` and hand it to the listeners."""
        self._network.sent.append((key, payload))
        self._network.deliver(key, payload)

    def subscribe(self, key: str, on_sample: OnSample, depth: int, *, lazy: bool = False) -> Close:
        """Register a listener; `lazy` has no effect, as samples never wait here."""
        self._closers.append(self._network.listen(key, on_sample))
        return self._closers[-1]

    def tap(self, pattern: str, on_raw: OnRaw) -> Close:
        """Register a listener; `on_raw` receives an empty encoding."""
        return self.subscribe(pattern, lambda key, payload: on_raw(key, "", payload), 1)

    def watch_readers(self, key: str, on_readers: OnReaders) -> Close:
        """Register a watcher; listeners of this transport count as well."""
        self._closers.append(self._network.watch(key, on_readers))
        return self._closers[-1]

    def serve(self, key: str, answer: Answer, *, urgent: bool = False) -> Close:
        """Register a server on `key`; `urgent` has no effect, as queries never wait here."""
        self._closers.append(self._network.serve(key, answer))
        return self._closers[-1]

    async def query(
        self, key: str, payload: bytes, encoding: str, timeout_s: float, priority: Priority
    ) -> list[bytes | str]:
        """Query all servers of `key`."""
        replies = []
        for answer in self._network.servers(key):
            with contextlib.suppress(TimeoutError):
                replies.append(await asyncio.wait_for(_reply_or_error(answer, payload), timeout_s))
        return replies

    def links(self, on_link: OnLink) -> Close:
        """Do nothing: inside one process there are no links."""
        return lambda: None

    async def close(self) -> None:
        """Leave the network."""
        while self._closers:
            self._closers.pop()()


async def _reply_or_error(answer: Answer, payload: bytes) -> bytes | str:
    try:
        return (await answer(payload))[0]
    except GigabrainError as error:
        return str(error)


def _add(entries: list[T], entry: T) -> Close:
    entries.append(entry)

    def close() -> None:
        with contextlib.suppress(ValueError):  # closed already
            entries.remove(entry)

    return close


def _matches(pattern: str, key: str) -> bool:
    """Match a key as Zenoh does, for patterns whose last part may be `*` or `**`."""
    start, _, last = pattern.rpartition("/")
    if last == "**":
        return not start or key == start or key.startswith(f"{start}/")
    return pattern == key or (last == "*" and key.rpartition("/")[0] == start)
