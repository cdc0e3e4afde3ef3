"""`gigabrain ros2 pass`: connects one key to one ROS topic, or back, without code.

Messages pass at once, and only while the other end has readers.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
from msgspec import structs

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import Body
from gigabrain_schemas.topics import BODY, SERVICES, TOPICS, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.headers import is_json
from gigabrain_zenoh.bus.key_expressions import check_key_expression
from gigabrain_zenoh.bus.transport import Close
from gigabrain_zenoh.codec import DECODE_ERRORS, MAX_ERROR_CHARS
from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.diagnostics.listener import CLIENT_NAME, open_topic
from gigabrain_zenoh.diagnostics.message_text import array_of
from gigabrain_zenoh.errors import BadPayload, ConfigError, Refused
from gigabrain_zenoh.host.signals import run_until, stop_signals
from gigabrain_zenoh.logs import Fault
from gigabrain_zenoh.ros2.graph import troubles
from gigabrain_zenoh.ros2.opening import open_transport
from gigabrain_zenoh.ros2.qos import LATCHED, Qos
from gigabrain_zenoh.ros2.transport import GraphEndpoint, Received, RosTransport, absolute
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.runtime.connect import Where, connect
from gigabrain_zenoh.security.acl import OWN_KEY_BYTES, check_write
from gigabrain_zenoh.security.identity_files import identity_in

log = logging.getLogger(__name__)
Form = Literal["fields", "json", "cdr"]
DEPTH = 10  # messages that wait for a busy reader
CHECK_NS = 1_000_000_000  # between two checks of the ROS graph
ROBOT_KEYS = frozenset({one.key for one in TOPICS} | {one.key for one in SERVICES})


class Route(NamedTuple):
    """A route between a Zenoh key and a ROS topic: its direction, type and form."""

    key: str
    topic: str  # with a leading slash
    type: str
    form: Form
    to_ros: bool
    text_field: str = ""  # field of the type that contains JSON, for the form json

    def __str__(self) -> str:
        ends = (self.key, self.topic) if self.to_ros else (self.topic, self.key)
        return f"{' -> '.join(ends)} ({self.type}, as {self.form})"


def route(source: str, target: str, type: str, form: Form, types: Types) -> Route:
    """Return a checked route. Raises ConfigError, and Refused for a key of the robot's own."""
    to_ros = target.startswith("/")
    if to_ros == source.startswith("/"):
        raise ConfigError(
            f"{source} and {target}: expected a ROS topic, which starts with /, and a Zenoh key, "
            "which does not"
        )
    key, topic = (source, target) if to_ros else (target, source)
    package, _, short = type.partition("/")
    name = types.known(type if "/" in short else f"{package}/msg/{short}")
    check_key_expression(key)
    if not to_ros:
        check_own_key(key)
    text = text_field(types, name) if form == "json" else ""
    return Route(key, absolute(topic, "/"), name, form, to_ros, text)


def check_own_key(key: str) -> None:
    """Raise Refused for a key of the topic table, and ConfigError for an invalid key."""
    if key in ROBOT_KEYS or key.rpartition("/")[0] in ROBOT_KEYS:
        raise robots_own(key)
    try:
        if "*" in key:
            raise ValueError(f"expected one key, got {key!r}")
        check_write(key)
    except ValueError as error:
        raise ConfigError(f"{key}: {error}") from None


def check_writer(keys: str, key: str) -> None:
    """Raise Refused if the identity's role may not publish on its own keys."""
    identity = identity_in(Path(keys)) if keys else None
    if identity and identity.role not in ("robot", "process"):
        raise Refused(
            f"{identity.name} may not write {key}; make an identity of a process that `writes` it: "
            "gigabrain keys issue process --process NAME"
        )


def robots_own(key: str) -> Refused:
    """Return the error for a key that the robot itself uses."""
    return Refused(
        f"{key} belongs to the robot, and is not writable here; command the robot through the "
        "gateway, `gigabrain ros2`"
    )


def text_field(types: Types, type: str) -> str:
    """Return the name of a type's only field, a string. Raises ConfigError for other types."""
    if text := types.only_text(type):
        return text
    names = ", ".join(name for name, _ in types.fields(type))
    raise ConfigError(
        f"{type} has {names}; JSON needs a type with one string field, such as "
        "std_msgs/msg/String; or omit --as json"
    )


def check_fields(types: Types, route: Route, topic: Topic[Any] | None) -> None:
    """Raise ConfigError if a message of the table shares no field with the ROS type."""
    if topic is None or route.form == "json":
        return
    if route.form == "cdr":
        raise ConfigError(f"{route.key} carries {topic.type.__name__}, not CDR; leave out --as cdr")
    header = {field.name for field in structs.fields(Message)}
    has = [one.name for one in structs.fields(topic.type) if one.name not in header]
    wants = [name for name, _ in types.fields(route.type)]
    if not set(has) & set(wants):
        raise ConfigError(
            f"{topic.type.__name__} and {route.type} have no field in common: "
            f"{', '.join(has)} and {', '.join(wants)}; use std_msgs/String --as json"
        )


@dataclass(frozen=True)
class Converter:
    """Converts payloads between the two ends. All methods raise only BadPayload."""

    types: Types
    route: Route

    def of_message(self, message: Message) -> bytes:
        """Return the CDR of a message of the table."""
        if self.route.form == "json":
            return self._text(message)
        values: dict[str, Any] = msgspec.to_builtins(message)
        found = array_of(message)
        if found and found[1].dtype.kind == "f":  # bytes stay as they are
            values[found[0]] = found[1].ravel().tolist()
        return self._fields(values)

    def of_payload(self, payload: bytes) -> bytes:
        """Return the CDR of a payload on a key outside the table: JSON, MessagePack or CDR."""
        if len(payload) > OWN_KEY_BYTES:
            raise BadPayload(f"{len(payload)} bytes, at most {OWN_KEY_BYTES} are passed")
        if self.route.form == "cdr":
            self.types.decode(self.route.type, payload)
            return payload
        decode = msgspec.json.decode if is_json(payload) else msgspec.msgpack.decode
        try:
            values = decode(payload)
        except DECODE_ERRORS as error:
            raise BadPayload(str(error)[:MAX_ERROR_CHARS]) from None
        return self._text(values) if self.route.form == "json" else self._fields(values)

    def to_payload(self, cdr: bytes) -> bytes:
        """Return the payload for a key from a ROS message: JSON, or its CDR."""
        payload = cdr
        if self.route.form != "cdr":
            message = self.types.decode(self.route.type, cdr)
            if self.route.form == "json":
                payload = _json_of(getattr(message, self.route.text_field))
            else:
                payload = msgspec.json.encode(self.types.to_dict(message))
        if len(payload) > OWN_KEY_BYTES:
            raise BadPayload(f"{len(payload)} bytes, at most {OWN_KEY_BYTES} are passed")
        return payload

    def _text(self, value: Any) -> bytes:
        try:
            text = msgspec.json.encode(value).decode()
        except (*DECODE_ERRORS, TypeError) as error:  # such as an extension type
            raise BadPayload(str(error)[:MAX_ERROR_CHARS]) from None
        made = self.types.make(self.route.type, **{self.route.text_field: text})
        return self.types.encode(self.route.type, made)

    def _fields(self, values: Any) -> bytes:
        type = self.route.type
        part = self.types.known_part(type, values) if isinstance(values, Mapping) else {}
        if not part:
            raise BadPayload(f"no field of {type} in it")
        return self.types.encode(type, self.types.from_dict(type, part))


def _json_of(text: str) -> bytes:
    """Return a text as JSON bytes. Raises BadPayload if it is not JSON."""
    try:
        msgspec.json.decode(text)
    except DECODE_ERRORS as error:
        raise BadPayload(f"not JSON: {error}"[:MAX_ERROR_CHARS]) from None
    return text.encode()


class Passage:
    """Passes messages of a route."""

    def __init__(
        self,
        route: Route,
        bus: Bus,
        ros: RosTransport,
        types: Types,
        link: Ros2Link,
        topic: Topic[Any] | None = None,
    ) -> None:
        """`topic` is that of the table, for a key of the table; else None."""
        self.counts: Counter[str] = Counter()
        self._route, self._bus, self._ros, self._link = route, bus, ros, link
        self._converter, self._fault = Converter(types, route), Fault(log)
        self._topic, self._reported = topic, frozenset[str]()
        self._ends: Close | None = None
        self._qos = self._listens = Qos(reliable=False, depth=DEPTH)
        self._read = self._looked = False
        if route.to_ros:
            self._qos = LATCHED if topic and topic.keep else Qos(depth=DEPTH)
            self._publisher = ros.publisher(route.topic, route.type, self._qos, self._count)
        else:
            own = Topic(route.key, Message, 10, max_bytes=OWN_KEY_BYTES)
            self._own = own
            bus.subscribe(BODY, self._check_body)
            bus.transport.watch_readers(route.key, self._watch)

    async def run(self) -> None:
        """Pass messages until cancelled. Raises Refused if the body turns out to obey the key."""
        looking = asyncio.ensure_future(self._keep_looking())
        try:
            ends = (looking, self._bus.failed)
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
            for end in ends:
                if end.done():
                    end.result()
        finally:
            looking.cancel()
            self._end()

    async def _keep_looking(self) -> None:
        if not self._route.to_ros:
            await self._bus.kept(BODY)  # wait for the body before passing anything
        async for _ in self._bus.clock.every(CHECK_NS):
            self.look()

    def look(self) -> None:
        """Listen with the QoS of the ROS publishers, and log incompatibilities."""
        self._looked, route = True, self._route
        theirs = [one for one in self._ros.endpoints() if one.topic == route.topic and not one.ours]
        if not route.to_ros:
            self._qos = fitting_qos(route, theirs)
            if self._read:
                self._listen()
        ours = GraphEndpoint(
            node=f"{self._link.namespace.rstrip('/')}/{self._link.node}",
            kind="publisher" if route.to_ros else "subscriber",
            topic=route.topic,
            type=route.type,
            hash="" if self._link.distro == "humble" else self._converter.types.hash(route.type),
            qos=self._qos,
            ours=True,
        )
        found = troubles(self._link, (*theirs, ours), ours_only=True)
        wrong = frozenset(f"{one.text}; {one.remedy}" for one in found)
        for text in sorted(wrong - self._reported):
            log.warning("%s: %s", route.topic, text)
        self._reported = wrong

    def _count(self, readers: int) -> None:
        """Listen to the key while ROS reads the topic."""
        if readers and self._ends is None:
            self._ends = self._subscribe()
        elif not readers:
            self._end()

    def _end(self) -> None:
        if self._ends:
            self._ends()
            self._ends = None

    def _subscribe(self) -> Close:
        route, topic = self._route, self._topic
        if topic is None:

            def receive(_key: str, payload: bytes) -> bool:
                return self._pass(self._converter.of_payload, payload, self._publisher.publish)

            return self._bus.transport.subscribe(route.key, receive, DEPTH)
        name = route.key.removeprefix(f"{topic.key}/")

        def take(_key: str, message: Message) -> None:
            self._pass(self._converter.of_message, message, self._publisher.publish)

        return self._bus.subscribe(topic, take, name=name)

    def _listen(self) -> None:
        if self._ends and self._qos == self._listens:
            return
        self._end()
        self._listens, route = self._qos, self._route
        self._ends = self._ros.subscribe(route.topic, route.type, self._qos, self._receive)

    def _receive(self, received: Received) -> None:
        self._pass(self._converter.to_payload, received.payload, self._put)

    def _watch(self, read: bool) -> None:
        """Listen to ROS while the key has readers."""
        self._read = read
        if not read:
            self._end()
        elif self._looked:
            self.look()

    @property
    def _encoding(self) -> str:
        return "application/cdr" if self._route.form == "cdr" else "application/json"

    def _put(self, payload: bytes) -> None:
        self._bus.sent[self._route.key] += 1
        self._bus.transport.publish(self._own, self._route.key, payload, self._encoding)

    def _pass(
        self, convert: Callable[[Any], bytes], message: Any, send: Callable[[bytes], None]
    ) -> bool:
        """Convert and send; return whether the message could be converted."""
        try:
            payload = convert(message)
        except BadPayload as error:
            self.counts["dropped"] += 1
            self._fault.begin(f"dropped a message: {error}")
            return False
        self._fault.end("messages pass again")
        self.counts["passed"] += 1
        send(payload)
        return True

    def _check_body(self, _key: str, body: Body) -> None:
        """Refuse a key that this body obeys."""
        if body.description.control_topic == self._route.key:
            raise robots_own(self._route.key)


def fitting_qos(route: Route, theirs: Iterable[GraphEndpoint]) -> Qos:
    """Return the best QoS that all found publishers offer; best effort fits all."""
    offered = [one.qos for one in theirs if (one.type, one.kind) == (route.type, "publisher")]
    return Qos(
        reliable=bool(offered) and all(qos.reliable for qos in offered),
        transient_local=bool(offered) and all(qos.transient_local for qos in offered),
        depth=DEPTH,
    )


async def pass_on(route: Route, where: Where, link: Ros2Link, types: Types) -> None:
    """Pass messages of a route until a signal ends it.

    Raises UnknownName for a key that nobody publishes, ConfigError, Refused, and BusError.
    """
    own = structs.replace(link, node=f"{link.node}_pass")
    async with AsyncExitStack() as stack:
        topic = None
        if route.to_ros:
            bus, found = await stack.enter_async_context(open_topic(where, route.key))
            topic = found.topic
            route = route._replace(key=found.pattern)
            check_fields(types, route, topic)
        else:
            check_writer(where.keys, route.key)
            bus = await stack.enter_async_context(connect(where, CLIENT_NAME))
        ros = await stack.enter_async_context(open_transport(own, types))
        passage = Passage(route, bus, ros, types, own, topic)
        log.info("passing %s", route)
        with stop_signals() as stop:
            await run_until(stop, passage.run())
