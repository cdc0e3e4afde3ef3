"""A whole robot in memory with the gateway, and a ROS node that communicates with it."""

import asyncio
from collections import defaultdict
from contextlib import AsyncExitStack, asynccontextmanager

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import Ros2Config, Ros2Link
from gigabrain_zenoh.gateway.gateway import Gateway, serve
from gigabrain_zenoh.ros2.memory import MemoryNetwork
from gigabrain_zenoh.ros2.qos import DEFAULT
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.testing.in_memory import RobotInMemory

TYPES = Types()
TICK_NS = 20_000_000


class RosNode:
    """A ROS node: keeps received messages by topic, publishes, and calls services."""

    def __init__(self, network, clock):
        self.transport = network.transport(Ros2Link(node="rclpy"))
        self.received = defaultdict(list)
        self.clock, self.publishers = clock, {}

    def read(self, topic, type, qos=DEFAULT):
        """Subscribe; return a function that ends the subscription."""
        messages = self.received[topic]
        return self.transport.subscribe(
            topic, type, qos, lambda received: messages.append(TYPES.decode(type, received.payload))
        )

    def publish(self, topic, type, qos=DEFAULT, **fields):
        """Publish a message made of `fields`."""
        if (topic, type) not in self.publishers:
            self.publishers[topic, type] = self.transport.publisher(topic, type, qos)
        self.publishers[topic, type].publish(TYPES.encode(type, TYPES.make(type, **fields)))

    def drive(self, x=0.2, turn=0.0, y=0.0):
        """Publish a Twist."""
        self.publish("/cmd_vel", "geometry_msgs/msg/Twist",
                     linear={"x": x, "y": y}, angular={"z": turn})  # fmt: skip

    async def call(self, service, type, **fields):
        """Return the response of a service. The fake clock does not advance."""
        request = TYPES.encode(f"{type}_Request", TYPES.make(f"{type}_Request", **fields))
        reply = await self.transport.call(service, type, request, 30.0)
        return TYPES.decode(f"{type}_Response", reply)

    def topics(self):
        """Return (type, QoS) of the topics of other nodes by name, without those of actions."""
        return {
            each.topic: (each.type, each.qos)
            for each in self.transport.endpoints()
            if not each.ours and each.kind == "publisher" and "/_action/" not in each.topic
        }


@asynccontextmanager
async def gateway_on(network, clock, config=None, transport_of=None):
    """Run a gateway on a robot's network; yield its bus and its ROS network."""
    config = config or Ros2Config()
    ros = MemoryNetwork(TYPES, clock.unix_ns)
    bus, ready = Bus(network.transport(), clock, "ros2"), asyncio.Event()
    async with AsyncExitStack() as stack:
        transport = await stack.enter_async_context(ros.transport(config))
        running = asyncio.ensure_future(serve(config, bus, transport, TYPES, ready.set))
        await clock.advance(0)
        assert ready.is_set(), running
        try:
            yield bus, ros
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            await bus.close()


class RosRobot(RobotInMemory):
    """A robot in memory with the gateway: `async with RosRobot(folder) as robot:`."""

    def __init__(self, folder, *, config=None, resume="manual"):
        super().__init__(folder, resume=resume)
        self._ros_config = config

    async def __aenter__(self):
        await super().__aenter__()
        self._stack = AsyncExitStack()
        opening = gateway_on(self.network, self.clock, self._ros_config)
        self.gateway_bus, self.ros = await self._stack.enter_async_context(opening)
        self.node = RosNode(self.ros, self.clock)
        return self

    async def __aexit__(self, *error):
        await self._stack.aclose()
        await super().__aexit__(*error)

    async def streams(self, ticks, every=2, x=0.2, turn=0.0):
        """Publish a Twist every `every` ticks; return the body's speed in each tick."""
        speeds = []
        for number in range(ticks):
            if number % every == 0:
                self.node.drive(x, turn)
            speeds += await self.go(1)
        return speeds


__all__ = ["Gateway", "RosNode", "RosRobot", "gateway_on"]
