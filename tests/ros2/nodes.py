"""Our own ROS nodes on either transport, for tests."""

import contextlib
import functools
import os
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from typing import Any

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.ros2.opening import open_transport
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.testing.processes import ZenohNetwork, robot

STRING = "std_msgs/msg/String"
TRIGGER = "std_srvs/srv/Trigger"


@functools.cache
def types() -> Types:
    """Return all types. Loading them takes half a second."""
    return Types()


class Nodes:
    """Opens nodes with the shared link settings `shared`; its stack closes them."""

    def __init__(self, **shared: Any) -> None:
        self.types = types()
        self.stack = AsyncExitStack()
        self._shared = shared

    def opened(self, name: str = "gigabrain", **fields: Any) -> AbstractAsyncContextManager[Any]:
        """Return a context in which a node is open."""
        link = Ros2Link(node=name, **(self._shared | fields))
        return open_transport(link, self.types)

    async def node(self, name: str = "gigabrain", **fields: Any) -> Any:
        """Open a node until the end of the test."""
        return await self.stack.enter_async_context(self.opened(name, **fields))

    def string(self, data: str) -> bytes:
        """Encode a String."""
        return self.types.encode(STRING, self.types.make(STRING, data=data))

    def text(self, payload: bytes) -> str:
        """Decode a String."""
        return str(self.types.decode(STRING, payload).data)


class ZenohNodes(Nodes):
    """Nodes on one router."""

    def __init__(self, net: ZenohNetwork) -> None:
        super().__init__(transport="rmw_zenoh", router=net.endpoint)
        self.net = net


@contextlib.asynccontextmanager
async def zenoh_nodes() -> AsyncIterator[ZenohNodes]:
    """Nodes over `rmw_zenoh`, with a router for them."""
    async with robot() as net:
        await net.router()
        nodes = ZenohNodes(net)
        async with nodes.stack:
            yield nodes


@contextlib.asynccontextmanager
async def dds_nodes() -> AsyncIterator[Nodes]:
    """Nodes over DDS on the loopback, in a domain for this process."""
    nodes = Nodes(transport="dds", domain=100 + os.getpid() % 100, localhost=True)
    async with nodes.stack:
        yield nodes
