"""Faults that are judged with keys: damaged bytes, and people without rights."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from gigabrain_schemas.brain import Twist
from gigabrain_schemas.topics import TELEOP
from gigabrain_zenoh.bus.zenoh.config import secured
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.rig import Rig
from gigabrain_zenoh.qa.faults.spoiled import address_of
from gigabrain_zenoh.qa.faults.waiting import PATIENCE_S
from gigabrain_zenoh.qa.proxy.chaos import Chaos
from gigabrain_zenoh.qa.proxy.proxy import TcpProxy
from gigabrain_zenoh.runtime.deployment import Deployment, with_free_port
from gigabrain_zenoh.security.acl import Role
from gigabrain_zenoh.security.authority import issue, new_fleet

ROLES: tuple[Role, ...] = ("robot", "brain", "operator", "viewer")
FLIPS = (1e-4, 1e-3)  # of each byte
FLIP_S, LONG_FLIP_S = 6.0, 60.0
PUT_S = 0.005


async def bit_flips(rig: Rig) -> Measured:
    """Bits flip between an operator and the router; what a viewer is told must be what was said.

    With keys the link is closed and made anew. Without them nobody notices: of 2135 messages that
    came through the same damage, 102 were damaged, and 15 of those still valid.
    """
    fleet = make_fleet(rig.fresh_folder() / "fleet")
    async with _site(fleet) as (proxy, mouth, ear):
        heard: list[bytes] = []
        ear.subscribe(TELEOP.key, lambda _key, payload: heard.append(payload), 256)
        said: set[bytes] = set()
        await _say_until_heard(mouth, said, heard)
        for chance in FLIPS:
            proxy.set(Chaos(corrupt=chance))
            for _ in range(round((LONG_FLIP_S if rig.long else FLIP_S) / PUT_S)):
                _say(mouth, said)
                await asyncio.sleep(PUT_S)
        flipped = sum(figures.flipped for figures in proxy.figures.values())
        proxy.set()
        await _say_until_heard(mouth, said, heard)
    if not flipped:
        raise Failed("no bit was flipped")
    return {"corrupt payloads accepted": sum(payload not in said for payload in heard)}


def _say(mouth: ZenohTransport, said: set[bytes]) -> None:
    """Something that has not been said before."""
    payload = encode(Twist(linear_x=0.0, seq=len(said), stamp_ns=len(said) * 7919))
    said.add(payload)
    mouth.publish(TELEOP, TELEOP.key, payload, "")


async def _say_until_heard(mouth: ZenohTransport, said: set[bytes], heard: list[bytes]) -> None:
    """Go on until the next one arrives. Raises TimeoutError."""
    before = len(heard)
    async with asyncio.timeout(PATIENCE_S):
        while len(heard) == before:
            _say(mouth, said)
            await asyncio.sleep(PUT_S)


@asynccontextmanager
async def _site(fleet: Path) -> AsyncIterator[tuple[TcpProxy, ZenohTransport, ZenohTransport]]:
    """A router with keys, an operator behind a proxy, and a viewer beside it."""
    there = with_free_port(Deployment(body="mock", router="tcp/127.0.0.1:0")).router
    async with contextlib.AsyncExitStack() as stack:

        async def join(endpoint: Endpoint) -> ZenohTransport:
            transport = await ZenohTransport.open(secured(endpoint))
            stack.push_async_callback(transport.close)
            return transport

        at = Endpoint(listen=(there,), keys=str(fleet / "robot"))
        await join(at)
        proxy = await stack.enter_async_context(TcpProxy(address_of(Endpoint(connect=(there,)))))
        far = Endpoint(connect=(proxy.endpoint,), keys=str(fleet / "operator"))
        near = Endpoint(connect=(there,), keys=str(fleet / "viewer"))
        yield proxy, await join(far), await join(near)
        proxy.set()


def make_fleet(folder: Path) -> Path:
    """The keys of one robot without a name, and of everybody round it."""
    new_fleet("faults", folder)
    for role in ROLES:
        issue(folder, role)
    return folder
