"""A fleet of the robots red, blue and green, its router, and sessions with given keys."""

import contextlib
import json
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import zenoh

from gigabrain_schemas.topics import Role
from gigabrain_zenoh.bus.zenoh.config import session_config
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.launch.processes import names_by_role
from gigabrain_zenoh.security.acl import FLEET_KEYS
from gigabrain_zenoh.security.authority import issue, new_fleet
from gigabrain_zenoh.testing.processes import free_endpoint

WRITES = {  # keys that users' own processes may write
    "mine": ("robot/intent", "robot/goal", "robot/lamp/**"),
    "ros2": FLEET_KEYS,
}
ROLES_OF_RED: tuple[Role, ...] = ("robot", "brain", "operator", "viewer", "dispatcher")


def make_fleet(folder: Path, name: str) -> Path:
    """Issue the keys of all roles and robots; return the folder."""
    new_fleet(name, folder)
    for role in ROLES_OF_RED:
        issue(folder, role, robot="red")
    for process in WRITES:
        issue(folder, "process", robot="red", process=process)
    for robot in ("blue", "green"):  # the router does not know green
        issue(folder, "robot", robot=robot)
    for role in ("operator", "dispatcher", "router"):
        issue(folder, role)
    return folder


class Site:
    """A router for red and blue in this process, and its clients."""

    def __init__(self, fleet: Path) -> None:
        self.fleet, self.address = fleet, free_endpoint()
        self._stack = contextlib.AsyncExitStack()

    async def open(self) -> None:
        """Start the router."""
        at = Endpoint(
            listen=(self.address,),
            keys=str(self.fleet / "router"),
            fleet=("red", "blue"),
            names=names_by_role(),
            grants=WRITES,
        )
        await self._join(at)

    def endpoint_of(self, name: str, namespace: str = "") -> Endpoint:
        """Return the endpoint for a client of the router with the keys `name`."""
        keys = str(self.fleet / name)
        return Endpoint(connect=(self.address,), namespace=namespace, keys=keys)

    async def client(self, name: str, namespace: str = "") -> ZenohTransport:
        """Connect one of our transports with the keys `name`."""
        return await self._join(self.endpoint_of(name, namespace))

    def raw(self, name: str) -> zenoh.Session:
        """Connect a plain Zenoh session with the keys `name`."""
        return self._stack.enter_context(raw(self.endpoint_of(name)))

    async def _join(self, endpoint: Endpoint) -> ZenohTransport:
        transport = await ZenohTransport.open(endpoint)
        self._stack.push_async_callback(transport.close)
        return transport

    async def close(self) -> None:
        """Close the router and all clients."""
        await self._stack.aclose()


@contextlib.asynccontextmanager
async def site(fleet: Path) -> AsyncIterator[Site]:
    """Run a router until the end of the test."""
    made = Site(fleet)
    try:
        await made.open()
        yield made
    finally:
        await made.close()


@contextlib.contextmanager
def raw(endpoint: Endpoint) -> Iterator[zenoh.Session]:
    """Open a plain Zenoh session. Raises ZError at once if the router refuses it."""
    config = zenoh.Config()
    for key, value in session_config(endpoint).items():
        config.insert_json5(key, json.dumps(value))
    config.insert_json5("connect/timeout_ms", "0")
    with zenoh.open(config) as session:
        yield session
