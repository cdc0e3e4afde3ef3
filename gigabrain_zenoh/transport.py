"""What the bus asks of whatever moves its bytes, and one that stays inside the process."""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any, Protocol

from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.errors import GigabrainError

OnSample = Callable[[str, bytes, str], None]  # key, payload, encoding
Answer = Callable[[bytes, str], Awaitable[tuple[bytes, str]]]  # payload, encoding, both ways
Close = Callable[[], None]


class Transport(Protocol):
    """Moves bytes between processes. All calls and callbacks happen on the event loop's thread."""

    def publish(self, topic: Topic[Any], key: str, payload: bytes, encoding: str) -> None:
        """Deliver to every listener on `key`, by the topic's QoS, without waiting for any."""
        ...

    def subscribe(self, key: str, on_sample: OnSample, depth: int) -> Close:
        """Call `on_sample` for what arrives on `key`; of what piles up the newest `depth` stay."""
        ...

    def serve(self, key: str, answer: Answer) -> Close:
        """Answer queries on `key`. A GigabrainError from `answer` travels back as its text."""
        ...

    async def query(
        self, key: str, payload: bytes, encoding: str, timeout_s: float
    ) -> list[tuple[bytes, str] | str]:
        """Ask all who serve `key`: a (payload, encoding) per answer, a text per error."""
        ...

    async def close(self) -> None:
        """Release the connection, within half a second. May be called twice."""
        ...


class LocalNetwork:
    """Joins transports inside this process, first in first out. For tests and replay."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, bytes]] = []
        self._listeners: dict[str, list[OnSample]] = {}
        self._servers: dict[str, Answer] = {}
        self._queue: deque[tuple[str, bytes, str]] = deque()
        self._delivering = False

    def transport(self) -> "LocalTransport":
        """A new end."""
        return LocalTransport(self)

    def deliver(self, key: str, payload: bytes, encoding: str = "application/msgpack") -> None:
        """Hand `payload` to the listeners, after whatever is on its way already."""
        self._queue.append((key, payload, encoding))
        if self._delivering:
            return
        self._delivering = True
        try:
            while self._queue:
                key, payload, encoding = self._queue.popleft()
                for pattern, listeners in list(self._listeners.items()):
                    if pattern == key or _matches(pattern, key):
                        for on_sample in list(listeners):
                            on_sample(key, payload, encoding)
        finally:
            self._delivering = False

    def listen(self, key: str, on_sample: OnSample) -> Close:
        """Register a listener."""
        self._listeners.setdefault(key, []).append(on_sample)
        return lambda: self._listeners[key].remove(on_sample)

    def serve(self, key: str, answer: Answer) -> Close:
        """Register the one who answers on `key`."""
        self._servers[key] = answer

        def close() -> None:
            self._servers.pop(key, None)

        return close

    def server(self, key: str) -> Answer | None:
        """Who answers on `key`."""
        return self._servers.get(key)


class LocalTransport:
    """One process's end of a LocalNetwork."""

    def __init__(self, network: LocalNetwork) -> None:
        self._network = network
        self._closers: list[Close] = []

    def publish(self, topic: Topic[Any], key: str, payload: bytes, encoding: str) -> None:
        """Record `payload` and hand it to the listeners."""
        self._network.sent.append((key, payload))
        self._network.deliver(key, payload, encoding)

    def subscribe(self, key: str, on_sample: OnSample, depth: int) -> Close:
        """Register a listener."""
        self._closers.append(self._network.listen(key, on_sample))
        return self._closers[-1]

    def serve(self, key: str, answer: Answer) -> Close:
        """Register the one who answers on `key`."""
        self._closers.append(self._network.serve(key, answer))
        return self._closers[-1]

    async def query(
        self, key: str, payload: bytes, encoding: str, timeout_s: float
    ) -> list[tuple[bytes, str] | str]:
        """Ask the one who serves `key`."""
        answer = self._network.server(key)
        if answer is None:
            return []
        try:
            return [await asyncio.wait_for(answer(payload, encoding), timeout_s)]
        except TimeoutError:
            return []
        except GigabrainError as error:
            return [str(error)]

    async def close(self) -> None:
        """Leave the network."""
        while self._closers:
            self._closers.pop()()


def _matches(pattern: str, key: str) -> bool:
    prefix, star, rest = pattern.partition("*")
    return star == "*" and not rest and key.startswith(prefix) and "/" not in key[len(prefix) :]
