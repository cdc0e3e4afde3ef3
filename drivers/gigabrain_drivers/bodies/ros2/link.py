"""A driver's node: joins ROS 2, subscribes to the robot's topics, and commands it.

It tries to join again until it is closed. Everything runs on the event loop.
"""

import asyncio
import contextlib
import functools
import logging
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from typing import Any

from gigabrain_drivers.bodies.ros2.conversion import Unusable, command_message
from gigabrain_drivers.bodies.ros2.options import Ros2Options
from gigabrain_drivers.links import link as links
from gigabrain_drivers.links.link import Trace
from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.errors import BadPayload, ConfigError
from gigabrain_zenoh.logs import Fault
from gigabrain_zenoh.ros2.opening import load_types, open_transport
from gigabrain_zenoh.ros2.qos import Qos
from gigabrain_zenoh.ros2.rtps_sockets import outer_addresses
from gigabrain_zenoh.ros2.transport import Received, RosPublisher, RosTransport
from gigabrain_zenoh.ros2.types import Types

log = logging.getLogger(__name__)

RETRY_NS = 200_000_000  # between two attempts to join
ADDRESS_CHECK_NS = 1_000_000_000  # between two checks of this host's addresses
CLOSE_S = 1.0  # timeout for leaving
DEPTH = 5  # messages that wait for a busy loop
STATIC_DEPTH = 100  # for /tf_static, where each publisher keeps one message

Opener = Callable[[], AbstractAsyncContextManager[RosTransport]]
Handler = Callable[[Any], None]  # handles a message; may raise Unusable


@functools.cache
def all_types() -> Types:
    """Return all ROS types. The first call takes a moment."""
    return load_types(Ros2Link())


class RosLink:
    """A node on a transport, which is opened again after a failure or a change of network."""

    def __init__(self, options: Ros2Options, clock: Clock, opener: Opener | None = None) -> None:
        """`opener` replaces the transport in the options."""
        self._options, self._clock = options, clock
        self._opener = opener or self._open_transport
        self.trace: Trace | None = None  # called with ("tx" or "rx", payload)
        self.on_open: Callable[[], None] = _do_nothing
        self.problem = "not opened"
        self.errors = 0  # number of unusable messages
        self.transport: RosTransport | None = None
        self._topics: list[tuple[str, str, Qos, Handler]] = []
        self._faults: dict[str, Fault] = {}
        self._command: RosPublisher | None = None
        self._task: asyncio.Task[None] | None = None
        self._types: Types | None = None
        self._joined: Ros2Link | None = None  # settings with which it joined

    def __str__(self) -> str:
        options = self._options
        if options.transport == "dds":
            return f"ROS 2 by DDS, domain {options.domain}"
        return f"ROS 2 by rmw_zenoh, {options.router or options.port}, domain {options.domain}"

    @property
    def readers(self) -> int:
        """Number of nodes that subscribe to our commands."""
        return self._command.readers if self._command else 0

    def listen(
        self, topic: str, type: str, handle: Handler, *, reliable: bool, kept: bool = False
    ) -> None:
        """Call `handle` for each message; `kept`: also for stored ones. Use it before `open`."""
        qos = Qos(reliable, kept, STATIC_DEPTH if kept else DEPTH)
        self._topics.append((topic, type, qos, handle))

    def open(self) -> None:
        """Start to join in the background."""
        if self._task is None:
            self.problem = "joining ROS 2"
            self._task = asyncio.create_task(self._keep_open(), name=f"link {self}")

    async def close(self) -> None:
        """Leave ROS 2. May be called any number of times."""
        task, self._task = self._task, None
        if task:
            task.cancel()
            _, late = await asyncio.wait((task,), timeout=CLOSE_S)
            if late:
                log.warning("%s: it has not been left within %g s", self, CLOSE_S)
        self.problem = "closed"

    def send(self, to: Velocity) -> bool:
        """Publish a command; return whether a node subscribes. Never blocks or raises."""
        if self._command is None or self._types is None:
            return False
        topic = self._options.topics.command
        message = command_message(self._types, to, topic, self._clock.unix_ns())
        payload = self._types.encode(topic.type, message)
        self._command.publish(payload)
        self._log_message("tx", topic.name, topic.type, payload)
        return self._command.readers > 0

    @contextlib.asynccontextmanager
    async def _open_transport(self) -> Any:
        assert self._joined
        async with open_transport(self._joined, await asyncio.to_thread(all_types)) as transport:
            yield transport

    async def _keep_open(self) -> None:
        fault = Fault(log)
        while True:
            try:
                self._types = await asyncio.to_thread(all_types)
                self._joined = self._options.link()
                async with self._opener() as transport:
                    fault.end(f"{self}: joined")
                    self._attach(transport)
                    try:
                        await self._until_network_changes()
                    finally:
                        self.transport = self._command = None
            except Exception as error:  # noqa: BLE001 - any failure may pass, such as a lack of threads
                self.problem = str(error) or type(error).__name__
                fault.begin(f"{self}: {self.problem}")
                await self._clock.sleep_ns(RETRY_NS)

    async def _until_network_changes(self) -> None:
        """Return once this host has only other addresses than before, and no robot is connected.

        Cyclone DDS stays on the interface on which it joined. Return also once an emulator has
        another address than before.
        """
        if self._options.port:
            await self._until_emulator_moves()
            return
        if not self._options.bound:
            await asyncio.Event().wait()
        joined = outer_addresses()
        async for _ in self._clock.every(ADDRESS_CHECK_NS):
            present = outer_addresses()
            if present and not present & joined and not self.readers:
                log.info("%s: the network has changed; joining again", self)
                return

    async def _until_emulator_moves(self) -> None:
        async for _ in self._clock.every(ADDRESS_CHECK_NS):
            with contextlib.suppress(ConfigError):  # it is not running
                if self._options.link() != self._joined:
                    log.info("%s: the emulator has another address; joining again", self)
                    return

    def _attach(self, transport: RosTransport) -> None:
        self.transport, self.problem = transport, ""
        command = self._options.topics.command
        self._command = transport.publisher(
            command.name, command.type, Qos(command.qos == "reliable", depth=1)
        )
        for topic, type, qos, handle in self._topics:
            on_received = functools.partial(self._on_message, topic, type, handle)
            transport.subscribe(topic, type, qos, on_received)
        self.on_open()

    def _on_message(self, topic: str, type: str, handle: Handler, received: Received) -> None:
        self._log_message("rx", topic, type, received.payload)
        fault = self._faults.setdefault(topic, Fault(log))
        assert self._types
        try:
            handle(self._types.decode(type, received.payload))
        except (BadPayload, Unusable) as error:
            self.errors += 1
            fault.begin(f"{topic}: a message was dropped: {error}")
        else:
            fault.end(f"{topic}: its messages are valid again")

    def _log_message(self, way: str, topic: str, type: str, payload: bytes) -> None:
        if self.trace:
            self.trace(way, payload)
        if links.log.isEnabledFor(logging.DEBUG):
            links.log.debug("%s %s", self, f"{way} {topic} {self._text(type, payload)}")

    def _text(self, type: str, payload: bytes) -> str:
        """Return a message as one line of text."""
        assert self._types
        try:
            return _short(self._types.to_dict(self._types.decode(type, payload)))
        except BadPayload as error:
            return f"{payload[:16].hex()}… {error}"


MAX_SHOWN = 6  # elements of a list, in a log line


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name}: {_short(each)}" for name, each in value.items()) + "}"
    if isinstance(value, list):
        more = ", …" if len(value) > MAX_SHOWN else ""
        return "[" + ", ".join(_short(each) for each in value[:MAX_SHOWN]) + more + "]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _do_nothing() -> None:
    pass
