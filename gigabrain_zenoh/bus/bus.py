"""Typed publish, subscribe and ask. A bus carries messages, over a transport of bytes."""

import asyncio
import logging
import secrets
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from types import TracebackType
from typing import Any, TypeVar

import msgspec

from gigabrain_schemas.base import Cause, Message
from gigabrain_schemas.topics import STATE, Service, Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.freshness import CLOCK_KEYS, Latest, RobotTime
from gigabrain_zenoh.bus.input_log import InputLogger
from gigabrain_zenoh.bus.params import Params
from gigabrain_zenoh.bus.transport import Close, OnLink, OnRaw, OnSample, Transport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.errors import ClockLost, GigabrainError, Refused
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)
QUIET_NS = 1_000_000_000  # a fault ends after this long without an invalid message


class Rejections:
    """Counts and faults of dropped messages, by key."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.faults: dict[str, tuple[Fault, int]] = {}  # fault, and time [ns] of its newest message
        self.counts: Counter[str] = Counter()

    def reject(self, key: str, error: ValueError) -> None:
        """Count an invalid message on `key`, and log the fault if it is new."""
        self.counts[key] += 1
        fault, _ = self.faults.get(key, (Fault(log), 0))
        self.faults[key] = fault, self._clock.now_ns()
        data = {"event": "rejected", "key": key}
        fault.begin(f"dropped a message on {key}: {error}", data)

    def accept(self, key: str) -> None:
        """End the fault on `key` after a valid message, if no invalid one came within QUIET_NS.

        While a valid and an invalid sender share the key, the fault stays.
        """
        if key not in self.faults:
            return
        fault, last_ns = self.faults[key]
        if self._clock.now_ns() - last_ns >= QUIET_NS:
            del self.faults[key]
            fault.end(f"{key} is valid again")


__all__ = ["Bus", "Latest", "RobotTime"]
M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)
CLOCK_LOST_NS = 3_000_000_000  # a process fails when all states for this long are refused
STATE_GAP_NS = 1_000_000_000  # after a longer gap between states, that time starts again
FETCH_TIMEOUT_S = 1.0  # processes that keep a value answer within this time
FETCH_RETRY_NS, MAX_FETCH_RETRY_NS = 1_000_000_000, 8_000_000_000  # doubled each time


class Bus:
    """A node's connection to all others. Used on the event loop's thread only."""

    def __init__(self, transport: Transport, clock: Clock, process: str = "") -> None:
        self.transport, self.clock, self.process = transport, clock, process
        # unique, unlike the name of the process: there may be two pages
        self.session = f"{process[:40]}-{secrets.token_hex(8)}"
        self.time = RobotTime()
        self.failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._failure: tuple[BaseException | None, TracebackType | None] = None, None
        self.sent: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self._rejections = Rejections(clock)
        self.rejected = self._rejections.counts
        self.listens: list[str] = []
        self.counters: Counter[str] = Counter()  # the node's own counts, for its health
        self.problems: tuple[Cause, ...] = ()  # the node's present problems, for its health
        self.latency_ms: dict[str, float] = {}  # measured by the node, for its health
        self.report: Callable[[], Mapping[str, float | int | str | None]] = dict
        self.input_log = InputLogger()  # inputs that the node used
        self.params = Params()  # may change while the process runs
        self.arrived: dict[str, tuple[int, int]] = {}  # boot and tick of the newest message, by key
        # returns whether work was done since the last call; by default True, as the loop runs
        self.progress: Callable[[], bool] = lambda: True
        self._refusing_since_ns = self._last_state_ns = 0
        self.closed = False
        self._kept_payloads: dict[str, bytes] = {}
        self._fetch_tasks: set[asyncio.Task[None]] = set()

    def publish(
        self,
        topic: Topic[M],
        message: M,
        *,
        basis: int = 0,
        name: str = "",
        tick: int | None = None,
        stamp_ns: int | None = None,
    ) -> M:
        """Fill in the header of `message`, and publish it; return the published message.

        `tick` and `stamp_ns` are the present ones, unless given for an earlier measurement.
        """
        key = topic.at(name)
        self.sent[key] += 1
        stamped = msgspec.structs.replace(
            message,
            stamp_ns=self.clock.unix_ns() if stamp_ns is None else stamp_ns,
            seq=self.sent[key],
            boot=self.time.boot,
            tick=self.time.tick if tick is None else tick,
            basis=basis,
        )
        payload, encoding = codec.encode(stamped), codec.encoding_of(topic.type)
        if topic.keep:
            self._keep_payload(key, payload, encoding)
        self.transport.publish(topic, key, payload, encoding)
        return stamped

    def latest(
        self,
        topic: Topic[M],
        on_new: Callable[[M], None] | None = None,
        *,
        name: str = "*",
        lazy: bool = False,
    ) -> Latest[M]:
        """Keep the newest message on `topic`; `on_new` is called with each new one.

        See `subscribe` for `lazy`.
        """
        latest = Latest(topic, self.clock, self.time)

        def receive(_key: str, message: M) -> None:
            if latest.store(message) and on_new:
                on_new(message)

        self.subscribe(topic, receive, name=name, lazy=lazy)
        return latest

    def subscribe(
        self,
        topic: Topic[M],
        on_message: Callable[[str, M], None],
        on_bad: Callable[[bytes], None] | None = None,
        *,
        name: str = "*",
        lazy: bool = False,
    ) -> Close:
        """Call `on_message(key, message)` for each message, `on_bad(payload)` for invalid ones.

        Lazy messages do not wake the process. It receives them, in the order of their arrival,
        before the next message that does: for what is only read when the node steps.
        Returns a function that ends the subscription.
        """
        decode, pattern = Codec(topic.type, topic.max_bytes).decode, topic.at(name)
        moves_time, rejections, has_value = topic.key in CLOCK_KEYS, self._rejections, False

        def receive(key: str, payload: bytes) -> bool | None:
            nonlocal has_value
            self.received[pattern] += 1
            try:
                try:
                    message = decode(payload)
                except ValueError as error:
                    rejections.reject(pattern, error)
                    if on_bad:
                        on_bad(payload)
                    return False
                if rejections.faults:
                    rejections.accept(pattern)
                self.arrived[pattern] = message.boot, message.tick
                self.input_log.note(key, message.seq)
                if moves_time and not self._observe_time(topic, message):
                    return False
                on_message(key, message)
            except Exception as error:  # noqa: BLE001 - ends the process: the runner raises it
                self._fail(error)
                return None
            has_value = True
            return True

        unsubscribe = self.transport.subscribe(pattern, receive, topic.depth, lazy=lazy)
        if topic.keep and not topic.many:
            unsubscribe = self._fetch_kept(topic, receive, lambda: has_value, unsubscribe)
        return self._add_subscription(pattern, unsubscribe)

    def tap(self, pattern: str, on_raw: OnRaw) -> Close:
        """Call `on_raw(key, encoding, payload)` for each message on `pattern`, in any thread.

        Invalid messages are included. Returns a function that ends the subscription.
        """
        return self._add_subscription(pattern, self.transport.tap(pattern, on_raw))

    async def kept(self, topic: Topic[Any]) -> list[bytes]:
        """Return the newest value of `topic` from each process that keeps it."""
        replies = await self.transport.query(topic.key, b"", "", FETCH_TIMEOUT_S, topic.priority)
        return [reply for reply in replies if not isinstance(reply, str)]

    def serve(
        self, service: Service[Q, R], answer: Callable[[Q], Awaitable[R]], *, name: str = ""
    ) -> None:
        """Answer `service`. An empty payload is a request with all defaults."""
        decode, key = Codec(service.request, service.max_bytes).decode, service.at(name)
        encoding = codec.encoding_of(service.reply)

        async def reply(payload: bytes) -> tuple[bytes, str]:
            self.received[key] += 1
            try:
                request = decode(payload or b"{}")
            except ValueError as error:
                self._rejections.reject(key, error)
                raise Refused(f"not a valid {service.request.__name__}: {error}") from None
            self._rejections.accept(key)
            try:
                return codec.encode(await answer(request)), encoding
            except GigabrainError:
                raise
            except Exception as error:
                self._fail(error)
                raise Refused(f"{self.process or key} failed: {error!r}") from error

        self.transport.serve(key, reply, urgent=service.priority == "real_time")

    async def ask(
        self,
        service: Service[Q, R],
        request: Q,
        *,
        timeout_s: float = 1.0,
        name: str = "",
        skip_refusals: bool = False,
    ) -> list[R]:
        """Return all answers that arrive in time; an empty list without a server.

        Raises Refused if any server refuses, unless `skip_refusals`.
        """
        decode, key = Codec(service.reply, service.max_bytes).decode, service.at(name)
        payload, encoding = codec.encode(request), codec.encoding_of(service.request)
        answers = []
        for reply in await self.transport.query(
            key, payload, encoding, timeout_s, service.priority
        ):
            if isinstance(reply, str):
                if skip_refusals:
                    continue
                raise Refused(reply)
            try:
                answers.append(decode(reply))
            except ValueError as error:
                self._rejections.reject(key, error)
        return answers

    def links(self, on_link: OnLink) -> Close:
        """Call `on_link` whenever a link to this process opens or closes."""
        return self.transport.links(on_link)

    async def close(self) -> None:
        """Leave the network."""
        self.closed = True
        for task in self._fetch_tasks:
            task.cancel()
        await self.transport.close()

    def _add_subscription(self, pattern: str, unsubscribe: Close) -> Close:
        """List a subscription; return a function that ends it and may be called twice."""
        self.listens.append(pattern)
        closed = False

        def close() -> None:
            nonlocal closed
            if not closed:
                closed = True
                unsubscribe()
                self.listens.remove(pattern)

        return close

    def _observe_time(self, topic: Topic[Any], message: Message) -> bool:
        """Update the robot's time from a message. Return whether the message is credible.

        If all states are refused for CLOCK_LOST_NS, this process's time is wrong, and it fails.
        """
        credible, now_ns = self.time.observe(message), self.clock.now_ns()
        if not credible:
            self.counters["refused_ticks"] += 1
        if topic.key != STATE.key:
            return credible
        if credible or now_ns - self._last_state_ns > STATE_GAP_NS:
            self._refusing_since_ns = now_ns
        self._last_state_ns = now_ns
        if not credible and now_ns - self._refusing_since_ns > CLOCK_LOST_NS:
            self._fail(ClockLost(
                f"refused every {topic.key} for {CLOCK_LOST_NS / 1e9:g} s: this process "
                f"is at tick {self.time.tick}, the newest message at tick {message.tick}"
            ))  # fmt: skip
        return credible

    def _fail(self, error: Exception) -> None:
        if not self.failed.done():
            self.failed.set_exception(error)
            self._failure = error, error.__traceback__

    def restore_traceback(self, error: BaseException) -> None:
        """Restore the traceback of the exception of `failed`, which a second `await` replaces."""
        failed, traceback = self._failure
        if error is failed:
            error.__traceback__ = traceback

    def _keep_payload(self, key: str, payload: bytes, encoding: str) -> None:
        """Store the newest payload of `key`, and serve it to late subscribers."""
        first = key not in self._kept_payloads
        self._kept_payloads[key] = payload

        async def answer(_payload: bytes) -> tuple[bytes, str]:
            return self._kept_payloads[key], encoding

        if first:
            self.transport.serve(key, answer)

    def _fetch_kept(
        self,
        topic: Topic[Any],
        receive: OnSample,
        has_value: Callable[[], bool],
        unsubscribe: Close,
    ) -> Close:
        """Query the kept value until it or a live message arrives.

        The live message may have been lost, or sent before the subscription. The returned function
        stops the queries and calls `unsubscribe`.
        """

        async def fetch() -> None:
            retry_ns = FETCH_RETRY_NS
            while True:
                kept = await self.kept(topic)
                for payload in () if has_value() else kept:
                    receive(topic.key, payload)
                if has_value():
                    return
                await self.clock.sleep_ns(retry_ns)
                retry_ns = min(2 * retry_ns, MAX_FETCH_RETRY_NS)

        def finished(task: "asyncio.Task[None]") -> None:
            self._fetch_tasks.discard(task)
            if not task.cancelled() and isinstance(error := task.exception(), Exception):
                self._fail(error)  # no code awaits this task

        task = asyncio.get_running_loop().create_task(fetch())
        self._fetch_tasks.add(task)
        task.add_done_callback(finished)

        def end() -> None:
            task.cancel()
            unsubscribe()

        return end
