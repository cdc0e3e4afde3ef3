"""Newest messages of a robot, for tools that show or check it."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import Body
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import (
    BODY,
    CMD_VEL,
    HEALTH,
    INTENT,
    POSE,
    SAFETY,
    SCAN,
    STATE,
    TASK,
    WORLD,
    Topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import Latest
from gigabrain_zenoh.bus.listening import Sampled
from gigabrain_zenoh.host.bounded import put_newest

M = TypeVar("M", bound=Message)

MAX_PROCESSES = 64  # with kept health


class ProcessHealth:
    """Newest health of each process, by name, and the time of its arrival."""

    def __init__(self, bus: Bus, on_new: Callable[[Health], None] = lambda _: None) -> None:
        self.newest: dict[str, Health] = {}
        self.arrived_ns: dict[str, int] = {}  # times of the bus's clock
        self._clock, self._on_new = bus.clock, on_new
        self.close = bus.subscribe(HEALTH, self._add)

    def _add(self, _key: str, health: Health) -> None:
        put_newest(self.newest, health.process, health, MAX_PROCESSES)
        put_newest(self.arrived_ns, health.process, self._clock.now_ns(), MAX_PROCESSES)
        self._on_new(health)


class RobotView:
    """Newest messages of a robot."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.state, self.scan = self.newest_of(STATE), self.newest_of(SCAN)
        self.world, self.intent = self.newest_of(WORLD), self.newest_of(INTENT)
        self.pose, self.safety = self.newest_of(POSE), self.newest_of(SAFETY)
        self.command = self.newest_of(CMD_VEL)
        self.task = bus.latest(TASK, functools.partial(self.on_rare, TASK))
        self._body = bus.latest(BODY, functools.partial(self.on_rare, BODY))
        self._processes = ProcessHealth(bus, functools.partial(self.on_rare, HEALTH))

    def newest_of(self, topic: Topic[M]) -> Latest[M]:
        """Subscribe to a busy topic. A subclass may decode its messages later, or on demand."""
        return self.bus.latest(topic)

    @property
    def body(self) -> Body | None:
        """Return the newest description of the body; None before the first."""
        return self._body.newest

    @property
    def health(self) -> Mapping[str, Health]:
        """Return the newest health of each process, by name."""
        return self._processes.newest

    def on_rare(self, topic: Topic[Any], message: Message) -> None:
        """Act on a message of a rare topic, such as TASK or HEALTH, as it arrives."""


class SampledView(RobotView):
    """Newest messages of a robot; those of busy topics are decoded when they are read."""

    def __init__(self, bus: Bus) -> None:
        self.sampled: dict[Topic[Any], Sampled[Any]] = {}
        super().__init__(bus)

    def newest_of(self, topic: Topic[M]) -> Latest[M]:
        """Subscribe to a busy topic; decode only the messages that are read."""
        sampled = self.sampled[topic] = Sampled(self.bus, topic)
        return sampled
