"""Transport to ROS nodes that use `rmw_zenoh`, over a router.

The session is a client: ROS nodes are peers, and a router forwards nothing between peers. All
declarations are repeated on each new session, so nodes find each other after a restart of the
router.
"""

import asyncio
import contextlib
import logging
import time
from collections import Counter
from collections.abc import Callable
from itertools import count
from types import TracebackType
from typing import Any

import zenoh
from msgspec import structs
from zenoh.handlers import Callback

from gigabrain_zenoh.bus.bridge import Bridge, Mailbox, QueryQueue
from gigabrain_zenoh.bus.zenoh.session import (
    Bundle,
    OpenSession,
    ReconnectingSession,
    has_subscriber,
    open_session,
)
from gigabrain_zenoh.config.settings import Endpoint, Ros2Link
from gigabrain_zenoh.errors import BusError, ConfigError, GigabrainError, NoAnswer
from gigabrain_zenoh.logs import QuietFault
from gigabrain_zenoh.ros2.qos import DEFAULT, SERVICES, Qos
from gigabrain_zenoh.ros2.rmw_declared import REMOTE, advanced_publisher, subscriber
from gigabrain_zenoh.ros2.rmw_names import (
    NO_HASH,
    SPACE,
    Attachment,
    NodeName,
    gid_of,
    parse_attachment,
    parse_token,
    topic_key,
)
from gigabrain_zenoh.ros2.transport import (
    Answer,
    Close,
    EndpointKind,
    GraphEndpoint,
    OnReaders,
    OnReceived,
    Received,
    absolute,
)
from gigabrain_zenoh.ros2.types import Types

log = logging.getLogger(__name__)
WARN_AFTER_S = 2.0  # without a router, then a warning is logged
RETRY_S = 0.1  # between two queries of a service that no node serves yet


class _Entity:
    """The key of one of our endpoints, and its token in each session."""

    def __init__(
        self, home: "RmwZenohTransport", kind: EndpointKind, topic: str, type: str, qos: Qos
    ) -> None:
        self.kind, self.type, self.qos = kind, type, qos
        self.topic = absolute(topic, home.link.namespace)
        self.hash = NO_HASH if home.link.distro == "humble" else home.types.hash(type)
        self.key = topic_key(home.link.domain, self.topic, type, self.hash)
        self.gid = b""
        self._home, self._id = home, next(home.ids)
        self._sequence = count(1)

    def declare_token(self, line: OpenSession) -> Any:
        """Announce the endpoint on a session, and set `gid`."""
        node = self._home.name_in(line.session)
        token = node.endpoint_token(self._id, self.kind, self.topic, self.type, self.hash, self.qos)
        self.gid = gid_of(token)
        return line.session.liveliness().declare_token(token)

    def attachment(self) -> bytes:
        """Return the attachment for the next message or request."""
        return Attachment(next(self._sequence), time.time_ns(), self.gid).to_bytes()


class RmwZenohPublisher:
    """A publisher, which is declared again on each new session."""

    def __init__(
        self, home: "RmwZenohTransport", entity: _Entity, on_readers: OnReaders | None
    ) -> None:
        self.readers = 0
        self.entity = entity
        self._home, self._on_readers = home, on_readers
        self._put: Callable[..., None] | None = None
        self._matched = False
        self._close = home.lines.declare(self._declare)

    def publish(self, payload: bytes) -> None:
        """Send to all readers. Without a session, or on a congested link, nothing is sent."""
        if self._put:
            self._put(payload, attachment=self.entity.attachment())

    def close(self) -> None:
        """Withdraw the publisher."""
        self._home.publishers.discard(self)
        self._put = None
        self._close()

    def lost(self) -> None:
        """Forget the readers, because the session is lost."""
        self.release()
        self._matched = False
        self.count()

    def release(self) -> None:
        """Stop sending, because the declarations of the session are about to be dropped."""
        self._put = None

    def count(self) -> None:
        """Update the number of readers, and report a change.

        Readers are counted by their tokens. If Zenoh matches a subscriber without a token, there is
        one, unless it may be a subscriber of our own, which receives nothing.
        """
        minimum = 0 if self._home.subscribes(self.entity.key) else 1
        readers = max(minimum, self._home.readers_of(self.entity)) if self._matched else 0
        if readers != self.readers:
            self.readers = readers
            if self._on_readers:
                self._on_readers(readers)

    def _declare(self, line: OpenSession) -> Bundle:
        """Declare; an advanced publisher also needs a plain one, which reports matching readers."""
        entity, session = self.entity, line.session
        plain = session.declare_publisher(
            entity.key,
            congestion_control=zenoh.CongestionControl.DROP,
            allowed_destination=REMOTE,
        )
        declared: list[Any] = [plain]
        if entity.qos.transient_local:
            declared.append(advanced_publisher(session, entity.key, entity.qos))
        declared.append(plain.declare_matching_listener(line.guard(self._on_matching)))
        declared.append(entity.declare_token(line))
        self._put = declared[1 if entity.qos.transient_local else 0].put
        self._match(has_subscriber(plain))
        return Bundle(*declared)

    def _on_matching(self, status: zenoh.MatchingStatus) -> None:
        self._home.bridge.post(self._match, status.matching)

    def _match(self, matched: bool) -> None:
        self._matched = matched
        self.count()


class RmwZenohTransport:
    """One ROS node on a Zenoh session."""

    lines: ReconnectingSession
    bridge: Bridge

    def __init__(
        self,
        link: Ros2Link,
        types: Types,
        endpoint: Endpoint | None = None,
        timeout_s: float | None = None,
    ) -> None:
        """Prepare. `endpoint` is the deployment's router, used if `link` names no router.

        Opening waits for the router for `timeout_s`; None: without limit.
        """
        self.link, self.types, self._timeout_s = link, types, timeout_s
        self.counts: Counter[str] = Counter()
        self.ids = count(1)  # for endpoints; the node has the id 0
        self.publishers: set[RmwZenohPublisher] = set()
        self.subscribers: set[_Entity] = set()
        self.endpoint = _endpoint(link, endpoint)
        self._graph: dict[str, GraphEndpoint | str] = {}  # by token
        self._clients: dict[tuple[str, str], _Entity] = {}

    async def __aenter__(self) -> "RmwZenohTransport":
        session = await self._session()
        self.bridge = Bridge()
        self._questions: QueryQueue[zenoh.Query] = QueryQueue(self.bridge, _drop)
        self.lines = ReconnectingSession(session, self.endpoint, self.bridge, self._lost)
        self.lines.declare(self._declare_node)
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.bridge.close()
        self._questions.close()
        for publisher in self.publishers:
            publisher.release()
        await self.lines.close()

    def publisher(
        self, topic: str, type: str, qos: Qos = DEFAULT, on_readers: OnReaders | None = None
    ) -> RmwZenohPublisher:
        """Declare a publisher."""
        entity = _Entity(self, "publisher", topic, type, qos)
        publisher = RmwZenohPublisher(self, entity, on_readers)
        self.publishers.add(publisher)
        return publisher

    def subscribe(self, topic: str, type: str, qos: Qos, handle: OnReceived) -> Close:
        """Call `handle` for each message; up to `qos.depth` newest ones wait for a busy loop."""
        entity = _Entity(self, "subscriber", topic, type, qos)

        def deliver(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                found = self._attachment(sample.attachment, entity.topic)
                source_ns, gid = (found.source_ns, found.gid) if found else (None, b"")
                number = found.sequence if found else None
                handle(Received(sample.payload.to_bytes(), source_ns, gid, number))

        mailbox = Mailbox(self.bridge, deliver, qos.depth)

        def declare(line: OpenSession) -> Bundle:
            declared = subscriber(line.session, entity.key, qos, line.guard(mailbox.put))
            return Bundle(declared, entity.declare_token(line))

        self.subscribers.add(entity)
        undeclare = self.lines.declare(declare)

        def close() -> None:
            self.subscribers.discard(entity)
            undeclare()

        return close

    def serve(self, service: str, type: str, handle: Answer) -> Close:
        """Answer requests of a service, each in a task of its own."""
        entity = _Entity(self, "server", service, type, SERVICES)
        fault = QuietFault(log)

        async def run(query: zenoh.Query) -> None:
            with query:  # releases the query at the end; otherwise the client waits for its timeout
                found = self._attachment(query.attachment, entity.topic)
                request = query.payload.to_bytes() if query.payload else b""
                try:
                    response = await handle(request)
                except GigabrainError as error:
                    fault.begin(f"{entity.topic}: no answer: {error}", time.monotonic_ns())
                    return
                fault.end(f"{entity.topic} answers again", time.monotonic_ns())
                attachment = found.answered().to_bytes() if found else None
                with contextlib.suppress(zenoh.ZError):  # if the client's session is lost
                    query.reply(entity.key, response, attachment=attachment)

        put, ends = self._questions.serve(run, urgent=False)

        def declare(line: OpenSession) -> Bundle:
            queryable = line.session.declare_queryable(
                entity.key, line.guard(put), complete=True, allowed_origin=REMOTE
            )
            return Bundle(queryable, entity.declare_token(line))

        undeclare = self.lines.declare(declare)

        def close() -> None:
            undeclare()
            ends()

        return close

    async def call(self, service: str, type: str, request: bytes, timeout_s: float) -> bytes:
        """Return the response of the service's server, waiting for it to appear.

        A server that is already in the graph is queried only once. Raises NoAnswer.
        """
        client = self._client(service, type)
        end_s = time.monotonic() + timeout_s
        while (left_s := end_s - time.monotonic()) > 0:
            line = await self.lines.within(left_s)
            left_s = end_s - time.monotonic()
            if line is None or left_s <= 0:
                break
            served = self._has_server(client)
            if (response := await self._ask(line, client, request, left_s)) is not None:
                return response
            if served:
                break
            await asyncio.sleep(min(RETRY_S, max(0.0, end_s - time.monotonic())))
        raise NoAnswer(f"no answer of {client.topic} within {timeout_s:g} s")

    def endpoints(self) -> tuple[GraphEndpoint, ...]:
        """Return the endpoints of all nodes in the domain."""
        return tuple(each for each in self._graph.values() if isinstance(each, GraphEndpoint))

    def nodes(self) -> tuple[str, ...]:
        """Return the names of all nodes in the domain."""
        return tuple(each for each in self._graph.values() if isinstance(each, str))

    def name_in(self, session: zenoh.Session) -> NodeName:
        """Return the name of our node in a session."""
        link = self.link
        return NodeName(link.domain, str(session.zid()), link.namespace, link.node)

    def subscribes(self, key: str) -> bool:
        """Return whether a subscriber of our own has this key."""
        return any(each.key == key for each in self.subscribers)

    def readers_of(self, entity: _Entity) -> int:
        """Return the number of other nodes' subscribers that match a publisher."""
        hash = "" if entity.hash == NO_HASH else entity.hash
        return sum(
            each.kind == "subscriber"
            and not each.ours
            and (each.topic, each.type, each.hash) == (entity.topic, entity.type, hash)
            for each in self.endpoints()
        )

    async def _session(self) -> zenoh.Session:
        """Open the first session. Raises BusError if no router answers within the timeout."""
        opening = asyncio.ensure_future(open_session(self.endpoint))
        try:
            done, _ = await asyncio.wait((opening,), timeout=self._timeout_s or WARN_AFTER_S)
            if not done:
                where = ", ".join(self.endpoint.connect)
                text = f"no router answers at {where}; start it, or correct `router`"
                if self._timeout_s:
                    raise BusError(text)
                log.warning("%s; waiting for it", text)
            return await opening
        finally:
            opening.cancel()

    def _declare_node(self, line: OpenSession) -> Bundle:
        name = self.name_in(line.session)
        liveliness = line.session.liveliness()

        def on_token(sample: zenoh.Sample) -> None:
            alive = sample.kind == zenoh.SampleKind.PUT
            self.bridge.post(self._on_token, (str(sample.key_expr), alive, name.zid))

        watch = liveliness.declare_subscriber(
            f"{SPACE}/{name.domain}/**", line.guard(on_token), history=True
        )
        return Bundle(watch, liveliness.declare_token(name.token))

    def _on_token(self, change: tuple[str, bool, str]) -> None:
        """Update the graph by a change of a token: (key, whether it is alive, our session's id)."""
        key, alive, zid = change
        if not alive:
            self._graph.pop(key, None)
        else:
            try:
                self._graph[key] = parse_token(key, zid)
            except ValueError as error:
                self.counts["malformed token"] += 1
                log.debug("%s", error)
                return
        if "/MS/" in key:
            for publisher in tuple(self.publishers):
                publisher.count()

    def _lost(self) -> None:
        self._graph.clear()
        for publisher in tuple(self.publishers):
            publisher.lost()

    def _attachment(self, data: zenoh.ZBytes | None, topic: str) -> Attachment | None:
        """Parse a message's attachment; None if it is missing or malformed, which is counted."""
        reason, text = "missing attachment", "ROS nodes would drop this message"
        if data is not None:
            try:
                return parse_attachment(data.to_bytes())
            except ValueError as error:
                reason, text = "malformed attachment", str(error)
        if not self.counts[reason]:
            log.warning("%s: %s: %s", topic, reason, text)
        self.counts[reason] += 1
        return None

    def _client(self, service: str, type: str) -> _Entity:
        """Return the client of a service, and declare it at the first use."""
        key = (absolute(service, self.link.namespace), type)
        if key not in self._clients:
            entity = _Entity(self, "client", service, type, SERVICES)
            self.lines.declare(lambda line: Bundle(entity.declare_token(line)))
            self._clients[key] = entity
        return self._clients[key]

    def _has_server(self, client: _Entity) -> bool:
        return any(
            each.kind == "server" and each.topic == client.topic and not each.ours
            for each in self.endpoints()
        )

    async def _ask(
        self, line: OpenSession, client: _Entity, request: bytes, timeout_s: float
    ) -> bytes | None:
        """Query the servers; return the first response, or None without one."""
        first_response: asyncio.Future[bytes | None] = asyncio.get_running_loop().create_future()

        def settle(response: bytes | None) -> None:
            if not first_response.done():
                first_response.set_result(response)

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self.bridge.post(settle, reply.ok.payload.to_bytes())

        handler = Callback(on_reply, drop=lambda: self.bridge.post(settle, None), indirect=False)
        try:
            line.session.get(
                client.key,
                handler,
                payload=request,
                attachment=client.attachment(),
                timeout=timeout_s,
                target=zenoh.QueryTarget.ALL_COMPLETE,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.DROP,  # never block the loop
                allowed_destination=REMOTE,
            )
        except zenoh.ZError as error:  # the session has just been closed
            log.debug("no query was sent on %s: %s", client.key, error)
            return None
        with contextlib.suppress(TimeoutError):  # the handler is lost with its session
            return await asyncio.wait_for(first_response, timeout_s + RETRY_S)
        return None


def _endpoint(link: Ros2Link, own: Endpoint | None) -> Endpoint:
    """Return the router's endpoint, without a namespace: keys of ROS have no robot's prefix."""
    if link.router:
        keys = own.keys if own else ""
        return Endpoint(connect=(link.router,), keys=keys, stamps=True)
    if own is None or not own.connect:
        raise ConfigError("ros2: no router; name one as router: tcp/127.0.0.1:7447")
    return structs.replace(own, namespace="", listen=(), nap_s=0.0, stamps=True)


def _drop(query: zenoh.Query) -> None:
    """Release a query without an answer, because too many queries are waiting."""
    query.drop()
