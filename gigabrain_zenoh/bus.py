"""Typed publish, subscribe and ask. The bus speaks messages; a transport speaks bytes."""

import asyncio
import logging
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Generic, TypeVar

import msgspec

from gigabrain_schemas.base import TICK_NS, Message
from gigabrain_schemas.topics import SCAN, STATE, Service, Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.errors import GigabrainError, Refused
from gigabrain_zenoh.transport import Transport

log = logging.getLogger(__name__)
M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)

CLOCK_TOPICS = (STATE.key, SCAN.key)  # what the driver sends on these moves the robot's clock


class RobotTime:
    """The newest tick that this process has seen, and of which start of the driver."""

    def __init__(self) -> None:
        self.boot = 0
        self.tick = 0

    def see(self, message: Message) -> None:
        """Take note of the tick on a message from the driver."""
        if message.boot != self.boot:
            self.boot, self.tick = message.boot, message.tick
        elif message.tick > self.tick:
            self.tick = message.tick


class Latest(Generic[M]):
    """The newest message on a topic, while it is still worth believing."""

    def __init__(self, topic: Topic[M], clock: Clock, time: RobotTime) -> None:
        self._topic, self._clock, self._time = topic, clock, time
        self._by_wall = topic.key in CLOCK_TOPICS
        self.newest: M | None = None
        self._arrived_ns = 0
        self._arrived_tick = 0

    def take(self, message: M) -> bool:
        """Keep `message` unless it is older than what is held; says whether it was kept."""
        held = self.newest
        if held and message.boot and message.boot == held.boot and message.tick < held.tick:
            return False
        self.newest = message
        self._arrived_ns, self._arrived_tick = self._clock.now_ns(), self._time.tick
        return True

    @property
    def current(self) -> M | None:
        """The newest message, however old, unless it is from an earlier start of the driver."""
        message = self.newest
        return message if message and message.boot in (0, self._time.boot) else None

    def age_ns(self) -> int | None:
        """Age of the newest message [ns]: by the robot's clock, or by arrival where that is more.

        None when there is none, or when it belongs to an earlier start of the driver.
        """
        message = self.current
        if message is None:
            return None
        age = (self._time.tick - self._arrived_tick) * TICK_NS
        if message.boot:
            age = max(age, (self._time.tick - message.tick) * TICK_NS)
        if self._by_wall or not message.boot:
            age = max(age, self._clock.now_ns() - self._arrived_ns)
        return max(age, 0)

    def fresh(self, within_ns: int | None = None) -> M | None:
        """The newest message, or None once it is older than its promised rate allows."""
        age = self.age_ns()
        limit = self._topic.stale_after_ns if within_ns is None else within_ns
        return self.newest if age is not None and age <= limit else None


class Bus:
    """What a node sees of the outside world. Used on the event loop's thread only."""

    def __init__(self, transport: Transport, clock: Clock, process: str = "") -> None:
        self._transport, self.clock, self.process = transport, clock, process
        self.time = RobotTime()
        self.failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.sent: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self.rejected: Counter[str] = Counter()
        self.listens: list[str] = []
        self.counters: Counter[str] = Counter()  # what a node counts of its own, for its health
        self.latency_ms: dict[str, float] = {}  # what a node measures, for its health
        self.report: Callable[[], Mapping[str, float | int | str | None]] = dict
        self._faulty: set[str] = set()
        self._kept: dict[str, bytes] = {}
        self._fetching: set[asyncio.Task[None]] = set()

    def publish(self, topic: Topic[M], message: M, *, basis: int = 0, name: str = "") -> M:
        """Send `message` with its header filled in; returns what was sent."""
        key = topic.at(name)
        self.sent[key] += 1
        stamped = msgspec.structs.replace(
            message,
            stamp_ns=self.clock.unix_ns(),
            seq=self.sent[key],
            boot=self.time.boot,
            tick=self.time.tick,
            basis=basis,
        )
        payload, encoding = codec.encode(stamped), codec.encoding_of(topic.type)
        if topic.keep:
            self._keep(key, payload, encoding)
        self._transport.publish(topic, key, payload, encoding)
        return stamped

    def latest(
        self, topic: Topic[M], on_new: Callable[[M], None] | None = None, *, name: str = "*"
    ) -> Latest[M]:
        """Keep the newest message on `topic`; `on_new` is called with each as it arrives."""
        latest = Latest(topic, self.clock, self.time)

        def take(_key: str, message: M) -> None:
            if topic.key in CLOCK_TOPICS:
                self.time.see(message)
            if latest.take(message) and on_new:
                on_new(message)

        self.subscribe(topic, take, name=name)
        return latest

    def subscribe(
        self,
        topic: Topic[M],
        on_message: Callable[[str, M], None],
        on_bad: Callable[[bytes], None] | None = None,
        *,
        name: str = "*",
    ) -> None:
        """Call `on_message(key, message)` for each valid arrival, `on_bad(payload)` for others."""
        decode = Codec(topic.type, topic.max_bytes).decode

        def receive(key: str, payload: bytes, encoding: str) -> None:
            self.received[key] += 1
            try:
                message = decode(payload, encoding)
            except ValueError as error:
                self._reject(key, error)
                if on_bad:
                    on_bad(payload)
                return
            if self._faulty and key in self._faulty:
                self._faulty.discard(key)
                log.info("%s is valid again", key, extra={"data": {"event": "accepted"}})
            on_message(key, message)

        self.listens.append(topic.at(name))
        self._transport.subscribe(topic.at(name), self._guard(receive), topic.depth)
        if topic.keep and not topic.many:
            self._fetch(topic, receive)

    def serve(
        self, service: Service[Q, R], answer: Callable[[Q], Awaitable[R]], *, name: str = ""
    ) -> None:
        """Answer `service`. An empty request counts as one with nothing but defaults."""
        decode = Codec(service.request, 64 * 1024).decode
        key = service.at(name)

        async def reply(payload: bytes, encoding: str) -> tuple[bytes, str]:
            self.received[key] += 1
            try:
                request = decode(payload or b"{}", encoding)
            except ValueError as error:
                self._reject(key, error)
                raise Refused(f"not a valid {service.request.__name__}: {error}") from None
            try:
                answered = await answer(request)
            except GigabrainError:
                raise
            except Exception as error:
                self._fail(error)
                raise
            return codec.encode(answered), codec.encoding_of(service.reply)

        self._transport.serve(key, reply)

    async def ask(
        self, service: Service[Q, R], request: Q, *, timeout_s: float = 1.0, name: str = ""
    ) -> list[R]:
        """Every answer to `request`; empty when nobody serves it. Raises Refused, with a reason."""
        decode = Codec(service.reply, 1024 * 1024).decode
        replies = await self._transport.query(
            service.at(name), codec.encode(request), codec.encoding_of(service.request), timeout_s
        )
        answers = []
        for reply in replies:
            if isinstance(reply, str):
                raise Refused(reply)
            try:
                answers.append(decode(*reply))
            except ValueError as error:
                self._reject(service.at(name), error)
        return answers

    async def close(self) -> None:
        """Leave the network."""
        for task in self._fetching:
            task.cancel()
        await self._transport.close()

    def _reject(self, key: str, error: ValueError) -> None:
        self.rejected[key] += 1
        if key not in self._faulty:
            self._faulty.add(key)
            data = {"event": "rejected", "key": key}
            log.warning("dropped a message on %s: %s", key, error, extra={"data": data})

    def _guard(self, receive: Callable[[str, bytes, str], None]) -> Callable[..., None]:
        """A fault in a node ends its process: `failed` carries it to whoever runs the node."""

        def guarded(key: str, payload: bytes, encoding: str) -> None:
            try:
                receive(key, payload, encoding)
            except Exception as error:  # noqa: BLE001 - handed on whole, to be raised by the runner
                self._fail(error)

        return guarded

    def _fail(self, error: Exception) -> None:
        if not self.failed.done():
            self.failed.set_exception(error)

    def _keep(self, key: str, payload: bytes, encoding: str) -> None:
        first = key not in self._kept
        self._kept[key] = payload

        async def answer(_payload: bytes, _encoding: str) -> tuple[bytes, str]:
            return self._kept[key], encoding

        if first:
            self._transport.serve(key, answer)

    def _fetch(self, topic: Topic[Any], receive: Callable[[str, bytes, str], None]) -> None:
        """Ask for the kept value, for a subscriber that comes after it was sent."""

        async def fetch() -> None:
            for reply in await self._transport.query(topic.key, b"", "", 1.0):
                if not isinstance(reply, str):
                    receive(topic.key, *reply)

        task = asyncio.get_running_loop().create_task(fetch())
        self._fetching.add(task)
        task.add_done_callback(self._fetching.discard)
