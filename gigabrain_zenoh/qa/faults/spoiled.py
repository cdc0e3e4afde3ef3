"""A robot of whose processes some reach the others through a network that can be spoiled."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace

import msgspec

from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig, Resume
from gigabrain_zenoh.qa.faults.rig import Rig, deployment_of
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.proxy.chaos import Chaos
from gigabrain_zenoh.qa.proxy.proxy import TcpProxy
from gigabrain_zenoh.runtime.deployment import client_endpoint, with_free_port
from gigabrain_zenoh.runtime.managed_process import ProcessSpec

HOLE = Chaos(hole=True)


@asynccontextmanager
async def behind_proxy(
    rig: Rig, *names: str, resume: Resume = "manual"
) -> AsyncIterator[tuple[Subject, TcpProxy]]:
    """A robot of a test's own; the processes named are on the far side of the proxy."""
    await rig.give_up()
    deployment = with_free_port(deployment_of(rig.options, "sim", resume))
    async with TcpProxy(address_of(client_endpoint(deployment))) as proxy:

        def change(specs: list[ProcessSpec]) -> list[ProcessSpec]:
            return [_through(s, proxy.endpoint) if s.name in names else s for s in specs]

        async with rig.new(deployment, change) as subject:
            await subject.settle()
            yield subject, proxy
            proxy.set()
            await subject.check()


@asynccontextmanager
async def proxy_to(subject: Subject) -> AsyncIterator[tuple[TcpProxy, Endpoint]]:
    """A proxy in front of a robot's router, and what a client behind it connects to."""
    where = client_endpoint(subject.deployment)
    async with TcpProxy(address_of(where)) as proxy:
        yield proxy, msgspec.structs.replace(where, connect=(proxy.endpoint,))


def address_of(endpoint: Endpoint) -> tuple[str, int]:
    """(host, port) of the router."""
    host, _, port = endpoint.connect[0].partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)


def _through(spec: ProcessSpec, endpoint: str) -> ProcessSpec:
    """The same process, which meets the others at `endpoint`."""
    config = msgspec.json.decode(spec.argv[-1], type=ProcessConfig)
    there = msgspec.structs.replace(config.endpoint, connect=(endpoint,))
    moved = msgspec.structs.replace(config, endpoint=there)
    return replace(spec, argv=(*spec.argv[:-1], msgspec.json.encode(moved).decode()))
