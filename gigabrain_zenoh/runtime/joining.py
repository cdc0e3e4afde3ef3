"""How the tools that record and play meet a robot."""

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from msgspec import Struct, structs

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh.config import ZENOH_RUNTIME
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.bus.zenoh.unobtrusive import NAP_S
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.host.scheduling import step_aside
from gigabrain_zenoh.runtime.running import find_endpoint
from gigabrain_zenoh.security.checks import no_router

ROUTER_S = 3.0  # how long a router may take to answer


class Where(Struct, frozen=True, kw_only=True):
    """Which robot, as people say it."""

    connect: str | None = None  # its router; without it, the only robot that runs here
    namespace: str = ""
    keys: str = ""  # the folder of an identity


@asynccontextmanager
async def joined(
    where: Where, name: str, *, looks_on: bool = False
) -> AsyncIterator[tuple[Bus, ZenohTransport]]:
    """A bus of a robot, and the transport below it. Raises BusError where there is none.

    Who `looks_on` lets what he listens to gather, and the robot's own processes go first.
    """
    endpoint = find_endpoint(where.connect, where.namespace, where.keys)
    if looks_on:
        step_aside()
        endpoint = structs.replace(endpoint, nap_s=NAP_S)
    os.environ.setdefault("ZENOH_RUNTIME", ZENOH_RUNTIME)
    try:
        transport = await asyncio.wait_for(ZenohTransport.open(endpoint), ROUTER_S)
    except TimeoutError:
        raise no_router(endpoint) from None
    bus = Bus(transport, Clock(), name)
    try:
        yield bus, transport
    finally:
        await bus.close()
