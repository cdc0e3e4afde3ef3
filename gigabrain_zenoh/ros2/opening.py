"""Opens the transport that a configuration names; its libraries are imported then, not before."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.util import find_spec

from gigabrain_zenoh.config.settings import Endpoint, Ros2Link
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import expanded
from gigabrain_zenoh.ros2.transport import RosTransport
from gigabrain_zenoh.ros2.types import Types

ROUTER_S = 5.0  # how long a router may take to answer a tool


def load_types(link: Ros2Link) -> Types:
    """Load all types, those of the user's files as well. Raises ConfigError."""
    return Types(expanded(each) for each in link.types)


@asynccontextmanager
async def open_transport(
    link: Ros2Link,
    types: Types,
    endpoint: Endpoint | None = None,
    timeout_s: float | None = None,
) -> AsyncIterator[RosTransport]:
    """Open a node, and close it at the end of the context.

    `endpoint` is the deployment's own, for `rmw_zenoh` without a router of its own. With
    `timeout_s` None it waits for a router as long as it takes. Raises ConfigError where a library
    or the name of a router is missing, BusError where router or domain cannot be joined.
    """
    made: RosTransport
    if link.transport == "dds":
        if not find_spec("cyclonedds"):
            raise ConfigError("transport: dds needs more: pip install 'gigabrain-zenoh[dds]'")
        from gigabrain_zenoh.ros2.dds import DdsTransport

        async with DdsTransport(link, types) as made:
            yield made
    else:
        from gigabrain_zenoh.ros2.rmw_zenoh import RmwZenohTransport

        async with RmwZenohTransport(link, types, endpoint, timeout_s) as made:
            yield made
