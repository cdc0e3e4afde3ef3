"""Opens the configured transport, and imports its libraries only then."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.util import find_spec

from gigabrain_zenoh.config.settings import Endpoint, Ros2Link
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import expanded
from gigabrain_zenoh.ros2.transport import RosTransport
from gigabrain_zenoh.ros2.types import Types

ROUTER_S = 5.0  # a command's timeout for an answer of the router


def load_types(link: Ros2Link) -> Types:
    """Load all types, including the user's files. Raises ConfigError."""
    return Types(expanded(each) for each in link.types)


@asynccontextmanager
async def open_transport(
    link: Ros2Link,
    types: Types,
    endpoint: Endpoint | None = None,
    timeout_s: float | None = None,
) -> AsyncIterator[RosTransport]:
    """Open a node, and close it at the end of the context.

    `rmw_zenoh` connects to `link.router`, or else to the deployment's `endpoint`. It waits for a
    router for `timeout_s`; None: without limit. Raises ConfigError if a library or the name of
    a router is missing, BusError if the router or domain cannot be joined.
    """
    transport: RosTransport
    if link.transport == "dds":
        if not find_spec("cyclonedds"):
            raise ConfigError("transport: dds needs more: pip install 'gigabrain-zenoh[dds]'")
        from gigabrain_zenoh.ros2.dds import DdsTransport

        async with DdsTransport(link, types) as transport:
            yield transport
    else:
        from gigabrain_zenoh.ros2.rmw_zenoh import RmwZenohTransport

        async with RmwZenohTransport(link, types, endpoint, timeout_s) as transport:
            yield transport
