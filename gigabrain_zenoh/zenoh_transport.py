"""The bus over Zenoh: the only module that imports it."""

import asyncio
import contextlib
import json
import logging
import threading
from collections import deque
from typing import Any

import msgspec
import zenoh
from zenoh.handlers import Callback

from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.bridge import Bridge
from gigabrain_zenoh.errors import BusError, GigabrainError
from gigabrain_zenoh.transport import Answer, Close, OnSample

log = logging.getLogger(__name__)

PRIORITIES = {
    "real_time": zenoh.Priority.REAL_TIME,
    "interactive_high": zenoh.Priority.INTERACTIVE_HIGH,
    "data_high": zenoh.Priority.DATA_HIGH,
    "data": zenoh.Priority.DATA,
    "background": zenoh.Priority.BACKGROUND,
}
CONGESTION = {"drop": zenoh.CongestionControl.DROP, "block": zenoh.CongestionControl.BLOCK}
CLOSE_S = 0.5  # a session may take ten seconds to close on a link that loses packets


class Endpoint(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a process finds the others."""

    connect: tuple[str, ...] = ()  # Zenoh endpoints, such as tcp/127.0.0.1:7447
    listen: tuple[str, ...] = ()  # of a router
    namespace: str = ""  # the robot's own part of the key space


def _config(endpoint: Endpoint) -> zenoh.Config:
    """Client of a router, or the router itself; explicit endpoints, no multicast, short leases."""
    settings: dict[str, Any] = {
        "mode": "router" if endpoint.listen else "client",
        "listen/endpoints": list(endpoint.listen),
        "connect/endpoints": list(endpoint.connect),
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {
            "period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "transport/unicast/open_timeout": 1000,
        "transport/unicast/accept_timeout": 1000,
        "transport/link/tx/lease": 400,
        "transport/link/tx/keep_alive": 4,
        "transport/link/tx/queue/size": {"real_time": 16, "data_high": 16, "data": 16},
        "transport/link/rx/max_message_size": 16 << 20,
        "transport/shared_memory/enabled": False,
    }  # fmt: skip
    if endpoint.namespace:
        settings["namespace"] = endpoint.namespace
    config = zenoh.Config()
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise BusError(f"{key} = {value!r} is not accepted by Zenoh: {error}") from None
    return config


async def open_session(endpoint: Endpoint) -> zenoh.Session:
    """Open a session, waiting for the router as long as it takes.

    In a daemon thread, not in the loop's executor: the process must be able to end meanwhile.
    Raises BusError when a router cannot listen.
    """
    config = _config(endpoint)
    loop = asyncio.get_running_loop()
    opened: asyncio.Future[zenoh.Session] = loop.create_future()

    def settle(session: zenoh.Session | None, error: zenoh.ZError | None) -> None:
        if opened.cancelled():
            if session:
                session.close()
        elif session:
            opened.set_result(session)
        else:
            opened.set_exception(error or BusError("no session"))

    def work() -> None:
        session, fault = None, None
        try:
            session = zenoh.open(config)
        except zenoh.ZError as error:
            fault = error
        try:
            loop.call_soon_threadsafe(settle, session, fault)
        except RuntimeError:  # the loop is gone: nobody waits any more
            if session:
                session.close()

    threading.Thread(target=work, name="zenoh-open", daemon=True).start()
    try:
        return await opened
    except zenoh.ZError as error:
        raise BusError(_explain(endpoint, error)) from None


def _explain(endpoint: Endpoint, error: zenoh.ZError) -> str:
    text = str(error)
    if endpoint.listen and "address already in use" in text.lower():
        where = ", ".join(endpoint.listen)
        return f"the router's port is taken ({where}); stop what uses it or choose another --listen"
    if endpoint.listen:
        return f"the router cannot listen on {', '.join(endpoint.listen)}: {text.splitlines()[0]}"
    return f"no session with {', '.join(endpoint.connect)}: {text.splitlines()[0]}"


async def close_session(session: zenoh.Session) -> None:
    """Close within half a second, or leave the rest to the end of the process."""
    loop = asyncio.get_running_loop()
    done = asyncio.Event()

    def work() -> None:
        try:
            session.close()
        except zenoh.ZError as error:
            log.debug("closing the session: %s", error)
        with contextlib.suppress(RuntimeError):  # the loop did not wait
            loop.call_soon_threadsafe(done.set)

    threading.Thread(target=work, name="zenoh-close", daemon=True).start()
    try:
        await asyncio.wait_for(done.wait(), CLOSE_S)
    except TimeoutError:
        log.debug("the session did not close in %s s", CLOSE_S)


class ZenohTransport:
    """One Zenoh session for the whole process."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._bridge = Bridge()
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._declared: list[Any] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._closed = False

    @classmethod
    async def open(cls, endpoint: Endpoint) -> "ZenohTransport":
        """Join the network, waiting for its router. Raises BusError."""
        return cls(await open_session(endpoint))

    def publish(self, topic: Topic[Any], key: str, payload: bytes, encoding: str) -> None:
        """Send by the topic's QoS; a declared publisher sends nothing that nobody listens to."""
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._session.declare_publisher(
                key,
                encoding=encoding,
                priority=PRIORITIES[topic.priority],
                congestion_control=CONGESTION[topic.congestion],
                express=topic.express,
            )
        publisher.put(payload)

    def subscribe(self, key: str, on_sample: OnSample, depth: int) -> Close:
        """Listen; samples that pile up while the loop is busy give way to newer ones."""
        mailbox = _Mailbox(self._bridge, on_sample, depth)
        return self._undeclare(self._session.declare_subscriber(key, mailbox.put))

    def serve(self, key: str, answer: Answer) -> Close:
        """Answer queries, each in a task of its own."""

        async def run(query: zenoh.Query) -> None:
            with query:  # dropped at the end, else the asker waits for its timeout
                payload = query.payload.to_bytes() if query.payload else b""
                encoding = str(query.encoding) if query.encoding else ""
                try:
                    reply, reply_encoding = await answer(payload, encoding)
                    query.reply(query.key_expr, reply, encoding=reply_encoding)
                except GigabrainError as error:
                    query.reply_err(str(error))

        def start(query: zenoh.Query) -> None:
            task = asyncio.get_running_loop().create_task(run(query))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

        declared = self._session.declare_queryable(
            key, lambda query: self._bridge.post(start, query), complete=True
        )
        return self._undeclare(declared)

    async def query(
        self, key: str, payload: bytes, encoding: str, timeout_s: float
    ) -> list[tuple[bytes, str] | str]:
        """Ask all who serve `key`. A direct callback: an indirect one costs a thread per query."""
        replies: list[zenoh.Reply] = []
        done = asyncio.get_running_loop().create_future()

        def finish(_: None) -> None:
            if not done.done():
                done.set_result(None)

        handler = Callback(
            replies.append, drop=lambda: self._bridge.post(finish, None), indirect=False
        )
        self._session.get(
            key, handler, payload=payload, encoding=encoding or None, timeout=timeout_s
        )
        await done
        return [_unpack(reply) for reply in replies]

    async def close(self) -> None:
        """Close the session and stop delivering."""
        if self._closed:
            return
        self._closed = True
        self._bridge.close()
        for task in self._tasks:
            task.cancel()
        await close_session(self._session)

    def _undeclare(self, declared: Any) -> Close:
        self._declared.append(declared)

        def close() -> None:
            self._declared.remove(declared)
            declared.undeclare()

        return close


def _unpack(reply: zenoh.Reply) -> tuple[bytes, str] | str:
    if reply.ok is not None:
        return reply.ok.payload.to_bytes(), str(reply.ok.encoding)
    assert reply.err is not None
    return reply.err.payload.to_bytes().decode(errors="replace")


class _Mailbox:
    """The newest samples of one subscription, on their way to the loop."""

    def __init__(self, bridge: Bridge, on_sample: OnSample, depth: int) -> None:
        self._bridge, self._on_sample = bridge, on_sample
        self._samples: deque[zenoh.Sample] = deque(maxlen=depth)
        self._posted = False

    def put(self, sample: zenoh.Sample) -> None:
        """Take a sample on Zenoh's thread."""
        self._samples.append(sample)
        if not self._posted:
            self._posted = True
            self._bridge.post(_Mailbox._deliver, self)

    def _deliver(self) -> None:
        self._posted = False
        while self._samples:
            try:
                sample = self._samples.popleft()
            except IndexError:  # a newer one has just pushed it out
                break
            self._on_sample(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding))
