"""Single runs of what is compared: our chain, and a bare relay of four processes beside it."""

import sys
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec
import yaml

from gigabrain_drivers.driver.catalog import robot_path
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.diagnostics.rates import Heard, listen
from gigabrain_zenoh.launch.processes import PROCESSES
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.qa.bench.figures import Figures
from gigabrain_zenoh.qa.bench.group import Group, client, driver_report, running
from gigabrain_zenoh.qa.bench.relay import Role
from gigabrain_zenoh.runtime.deployment import Deployment, client_endpoint, with_free_port
from gigabrain_zenoh.runtime.managed_process import ProcessSpec

LOOPBACK = "tcp/127.0.0.1:0"
SETTLE_S = 1.0  # of the relay; the chain counts from when the gate opens
LATE_S = 20.0  # how much longer than announced a relay may take
RELAY = (sys.executable, "-P", "-m", "gigabrain_zenoh.qa.bench.relay")
KEYS = ("bench/scan", "bench/world", "bench/intent", "bench/cmd")
NAMES = ("source", "first", "second", "third")
STANDS_FOR = ("driver", "perception", "decision", "control")


@asynccontextmanager
async def brain(
    rate_hz: float, folder: Path, change: Callable[[Deployment], Deployment] = lambda plain: plain
) -> AsyncIterator[tuple[Group, Bus]]:
    """Our processes as `gigabrain up` runs them, from the moment when the gate is open.

    Safety is no part of the chain, but without it the gate opens for nobody.
    """
    body = str(_mock_body(rate_hz, folder))
    deployment = with_free_port(change(Deployment(body=body, resume="auto", router=LOOPBACK)))
    specs = process_specs(deployment, "robot", folder, folder / "state")
    async with running(specs) as group, client(client_endpoint(deployment)) as bus:
        while not (await driver_report(bus)).get("scan_to_cmd_n"):
            await group.look()
        yield group, bus


async def time_chain(rate_hz: float, seconds: float, folder: Path) -> Figures:
    """Scan to command, as the driver measures it."""
    async with brain(rate_hz, folder) as (group, bus):
        await group.go_on(seconds)
        return await chain_figures(bus)


async def listen_to_chain(rate_hz: float, seconds: float, folder: Path) -> tuple[Heard, Figures]:
    """The same with somebody who listens to every hop, which slows it a little."""
    async with brain(rate_hz, folder) as (group, bus):
        heard = listen(bus)
        await group.go_on(seconds)
        await group.until(lambda: heard.complete)
        return heard, await chain_figures(bus)


async def chain_figures(bus: Bus) -> Figures:
    """The driver's figures of the run so far."""
    report = await driver_report(bus)
    names = Figures.__struct_fields__
    return msgspec.convert({name: report.get(f"scan_to_cmd_{name}") for name in names}, Figures)


async def time_relay(rate_hz: float, seconds: float, sizes: Sequence[int], folder: Path) -> Figures:
    """Four bare processes, joined by a router like ours."""
    deployment = with_free_port(Deployment(hosts={"robot": ("router",)}, router=LOOPBACK))
    router = process_specs(deployment, "robot", folder, folder / "state")
    endpoints = [client_endpoint(deployment)] * len(NAMES)
    return await _run_relay(router, relay_roles(rate_hz, seconds, sizes, endpoints))


async def time_peers(rate_hz: float, seconds: float, sizes: Sequence[int]) -> Figures:
    """Four bare processes, joined directly: shows what the router costs."""
    at = tuple(with_free_port(Deployment(router=LOOPBACK)).router for _ in NAMES)
    endpoints = [Endpoint(listen=(at[i],), connect=at[:i]) for i in range(len(NAMES))]
    return await _run_relay([], relay_roles(rate_hz, seconds, sizes, endpoints))


def relay_roles(
    rate_hz: float, seconds: float, sizes: Sequence[int], endpoints: Sequence[Endpoint]
) -> list[Role]:
    """What each process of a relay does; the first is the source."""
    return [
        Role(
            gets=KEYS[i - 1],
            puts=KEYS[i],
            size=sizes[i],
            endpoint=endpoints[i],
            first=PROCESSES[STANDS_FOR[i]].stops,
            rate_hz=0.0 if i else rate_hz,
            settle_s=SETTLE_S,
            seconds=seconds,
        )
        for i in range(len(KEYS))
    ]


async def _run_relay(router: Sequence[ProcessSpec], roles: Sequence[Role]) -> Figures:
    after = tuple(spec.name for spec in router)
    specs = [
        ProcessSpec(name, (*RELAY, msgspec.json.encode(role).decode()), after)
        for name, role in zip(NAMES, roles, strict=True)
    ]
    async with running([*router, *specs]) as group:
        await group.until(lambda: "figures" in group.said, SETTLE_S + roles[0].seconds + LATE_S)
        return msgspec.convert(group.said["figures"]["figures"], Figures)


def _mock_body(rate_hz: float, folder: Path) -> Path:
    """The file of a body without physics whose lidar turns at this rate."""
    known = robot_path("mock")
    robot = yaml.safe_load(known.read_text(encoding="utf-8"))
    robot["lidar"]["rate_hz"] = rate_hz
    path = folder / "mock.yaml"
    path.write_text(yaml.safe_dump(robot), encoding="utf-8")
    return path
