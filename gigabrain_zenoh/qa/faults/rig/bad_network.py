"""Bad networks between a robot's processes, and clients that send whatever they are given."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from msgspec.structs import replace

from gigabrain_schemas.base import Message
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig, Resume
from gigabrain_zenoh.qa.faults.rig.rig import Rig, deployment_of
from gigabrain_zenoh.qa.probe import Probe
from gigabrain_zenoh.qa.proxy.chaos import Chaos
from gigabrain_zenoh.qa.proxy.tcp import TcpProxy
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest, reconfigured
from gigabrain_zenoh.runtime.deployment import client_endpoint, with_free_port
from gigabrain_zenoh.runtime.managed_process import ProcessSpec

HOLE = Chaos(hole=True)


@asynccontextmanager
async def behind_proxy(
    rig: Rig, *names: str, resume: Resume = "manual"
) -> AsyncIterator[tuple[RobotUnderTest, TcpProxy]]:
    """Boot a robot whose named processes reach the others through a proxy."""
    await rig.give_up()
    deployment = with_free_port(deployment_of(rig.options, "sim", resume))
    async with TcpProxy(address_of(client_endpoint(deployment))) as proxy:

        def through(config: ProcessConfig) -> ProcessConfig:
            return replace(config, endpoint=replace(config.endpoint, connect=(proxy.endpoint,)))

        def change(specs: list[ProcessSpec]) -> list[ProcessSpec]:
            return [reconfigured(s, through) if s.name in names else s for s in specs]

        async with rig.new(deployment, change) as robot:
            await robot.settle()
            yield robot, proxy
            proxy.set()
            await robot.check()


@asynccontextmanager
async def proxy_to(robot: RobotUnderTest) -> AsyncIterator[tuple[TcpProxy, Endpoint]]:
    """Put a proxy before a robot's router; yields it and the endpoint of clients behind it."""
    endpoint = client_endpoint(robot.deployment)
    async with TcpProxy(address_of(endpoint)) as proxy:
        yield proxy, replace(endpoint, connect=(proxy.endpoint,))


def address_of(endpoint: Endpoint) -> tuple[str, int]:
    """Return (host, port) of the router."""
    host, _, port = endpoint.connect[0].partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)


class Forger:
    """Sends messages with whatever header they have, and bytes that are no message."""

    def __init__(self, transport: ZenohTransport) -> None:
        self._transport = transport

    def send(self, topic: Topic[Any], message: Message) -> None:
        """Send a message with the header that it has."""
        self.send_bytes(topic, codec.encode(message), codec.encoding_of(topic.type))

    def send_bytes(self, topic: Topic[Any], payload: bytes, encoding: str = "") -> None:
        """Send any bytes."""
        self._transport.publish(topic, topic.at("forger"), payload, encoding)


@asynccontextmanager
async def forging(endpoint: Endpoint) -> AsyncIterator[Forger]:
    """Open a forger with its own session."""
    transport = await ZenohTransport.open(endpoint)
    try:
        yield Forger(transport)
    finally:
        await transport.close()


def forged_command(probe: Probe, linear_x: float, seq: int, **fields: Any) -> CmdVel:
    """Return a command with the newest boot, tick and basis; `source` is the probe's own name."""
    time = probe.bus.time
    header = {"source": probe.bus.process, "boot": time.boot, "tick": time.tick, "basis": time.tick}
    return CmdVel(linear_x=linear_x, seq=seq, **{**header, **fields})
