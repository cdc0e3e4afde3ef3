"""Bus transport over Zenoh. Only this module and `session` import zenoh."""

import asyncio
import contextlib
import logging
from typing import Any

import zenoh
from zenoh.handlers import Callback

from gigabrain_schemas.topics import Priority, Topic
from gigabrain_zenoh.bus.bridge import Bridge, Mailbox, QueryQueue
from gigabrain_zenoh.bus.transport import Answer, Close, Link, OnLink, OnRaw, OnReaders, OnSample
from gigabrain_zenoh.bus.zenoh.session import (
    Bundle,
    OpenSession,
    ReconnectingSession,
    has_subscriber,
    open_session,
)
from gigabrain_zenoh.bus.zenoh.workarounds import ReceiveThrottle
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import GigabrainError

log = logging.getLogger(__name__)

PRIORITIES: dict[Priority, zenoh.Priority] = {
    "real_time": zenoh.Priority.REAL_TIME,
    "interactive_high": zenoh.Priority.INTERACTIVE_HIGH,
    "data_high": zenoh.Priority.DATA_HIGH,
    "data": zenoh.Priority.DATA,
    "background": zenoh.Priority.BACKGROUND,
}
CONGESTION = {"drop": zenoh.CongestionControl.DROP, "block": zenoh.CongestionControl.BLOCK}


class ZenohTransport:
    """Transport of a process, over one Zenoh session at a time."""

    def __init__(self, session: zenoh.Session, endpoint: Endpoint) -> None:
        self._nap = ReceiveThrottle(endpoint.nap_s) if endpoint.nap_s else None
        self._bridge = Bridge()
        self._loop = asyncio.get_running_loop()
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._questions: QueryQueue[zenoh.Query] = QueryQueue(self._bridge, _refuse)
        self._asking: set[asyncio.Future[None]] = set()
        self._closed, self.losses = False, 0
        self._lines = ReconnectingSession(session, endpoint, self._bridge, self._lost)

    @classmethod
    async def open(cls, endpoint: Endpoint) -> "ZenohTransport":
        """Open a session, waiting for its router. Raises BusError."""
        return cls(await open_session(endpoint), endpoint)

    def publish(self, topic: Topic[Any], key: str, payload: bytes, encoding: str) -> None:
        """Publish with the topic's QoS; Zenoh sends nothing if the topic has no subscriber."""
        line = self._lines.now
        if line is None:
            return  # without a session there is no subscriber
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = line.session.declare_publisher(
                key,
                encoding=encoding,
                priority=PRIORITIES[topic.priority],
                congestion_control=CONGESTION[topic.congestion],
                express=topic.express,
            )
        publisher.put(payload)

    def subscribe(self, key: str, on_sample: OnSample, depth: int, *, lazy: bool = False) -> Close:
        """Subscribe; a busy loop keeps the newest `depth` samples of each key."""
        fixed = "" if "*" in key else key

        def deliver(sample: zenoh.Sample) -> bool | None:
            return on_sample(fixed or str(sample.key_expr), sample.payload.to_bytes())

        mailbox = Mailbox(self._bridge, deliver, depth, lazy=lazy)

        def put(sample: zenoh.Sample) -> None:
            mailbox.put(sample, str(sample.key_expr))

        take = mailbox.put if fixed else put
        return self._lines.declare(
            lambda line: line.session.declare_subscriber(key, line.direct(take))
        )

    def tap(self, pattern: str, on_raw: OnRaw) -> Close:
        """Subscribe with a callback in Zenoh's own thread; no sample is dropped here."""

        def deliver(sample: zenoh.Sample) -> None:
            on_raw(str(sample.key_expr), str(sample.encoding), sample.payload.to_bytes())

        take = self._nap.after_each(deliver) if self._nap else deliver
        return self._lines.declare(
            lambda line: line.session.declare_subscriber(pattern, line.direct(take))
        )

    def watch_readers(self, key: str, on_readers: OnReaders) -> Close:
        """Call `on_readers` with whether `key` has subscribers: in each session, at each change."""

        def matched(status: zenoh.MatchingStatus) -> None:
            self._bridge.post(on_readers, status.matching)

        def declare(line: OpenSession) -> Bundle:
            publisher = line.session.declare_publisher(key)
            listener = publisher.declare_matching_listener(line.guard(matched))
            on_readers(has_subscriber(publisher))
            return Bundle(publisher, listener)

        return self._lines.declare(declare)

    def serve(self, key: str, answer: Answer, *, urgent: bool = False) -> Close:
        """Answer queries on `key`, each in its own task."""

        async def run(query: zenoh.Query) -> None:
            with query:  # released at the end, else the client waits for its timeout
                asked = query.payload
                with contextlib.suppress(zenoh.ZError):  # the client's session is lost
                    try:
                        payload, encoding = await answer(asked.to_bytes() if asked else b"")
                        query.reply(key, payload, encoding=encoding)
                    except GigabrainError as error:
                        query.reply_err(str(error))

        put, ends = self._questions.serve(run, urgent=urgent)
        undeclare = self._lines.declare(
            lambda line: line.session.declare_queryable(key, line.guard(put), complete=True)
        )

        def close() -> None:
            undeclare()
            ends()

        return close

    async def query(
        self, key: str, payload: bytes, encoding: str, timeout_s: float, priority: Priority
    ) -> list[bytes | str]:
        """Query all servers of `key`.

        The callback is direct, because an indirect one costs a thread per query.
        """
        line = await self._lines.within(timeout_s)
        if line is None:
            return []
        replies: list[zenoh.Reply] = []
        done = self._loop.create_future()

        def finish(_: None) -> None:
            if not done.done():
                done.set_result(None)

        handler = Callback(
            replies.append, drop=lambda: self._bridge.post(finish, None), indirect=False
        )
        try:
            line.session.get(
                key,
                handler,
                payload=payload,
                encoding=encoding or None,
                timeout=timeout_s,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,  # else Zenoh keeps one answer per key
                priority=PRIORITIES[priority],
                congestion_control=zenoh.CongestionControl.DROP,  # never block the loop
                express=True,
            )
        except zenoh.ZError as error:  # the session has just been closed
            log.debug("no query was sent on %s: %s", key, error)
            return []
        self._asking.add(done)
        try:
            await done
        finally:
            self._asking.discard(done)
        return [_unpack(reply) for reply in replies if not _timed_out(reply)]

    def links(self, on_link: OnLink) -> Close:
        """Call `on_link` for every link to another session: existing ones, then each change."""

        def on_event(event: zenoh.LinkEvent) -> None:
            link = event.link
            name = link.auth_identifier or ""
            is_open = event.kind == zenoh.SampleKind.PUT
            on_link(Link(str(link.zid), name, str(link.dst), is_open))

        return self._lines.declare(
            lambda line: line.session.info.declare_link_events_listener(
                lambda event: self._bridge.post(on_event, event), history=True
            )
        )

    async def close(self) -> None:
        """Close the session and stop delivering."""
        if self._closed:
            return
        self._closed = True
        self._bridge.close()
        self._questions.close()
        self._give_up_asking()
        await self._lines.close()

    def _lost(self) -> None:
        """Drop the old session's publishers, and end queries that will get no answer."""
        self.losses += 1
        self._publishers.clear()
        self._give_up_asking()

    def _give_up_asking(self) -> None:
        for done in self._asking:
            if not done.done():
                done.set_result(None)


def _refuse(query: zenoh.Query) -> None:
    """Reject a query immediately, because too many are waiting."""
    with query:
        query.reply_err(f"too many others ask for {query.key_expr}; try again")


def _unpack(reply: zenoh.Reply) -> bytes | str:
    if reply.ok is not None:
        return reply.ok.payload.to_bytes()
    assert reply.err is not None
    return reply.err.payload.to_bytes().decode(errors="replace")


def _timed_out(reply: zenoh.Reply) -> bool:
    """Return whether a reply is Zenoh's own timeout, which arrives as an error reply."""
    return reply.err is not None and reply.err.payload.to_bytes() == b"Timeout"
