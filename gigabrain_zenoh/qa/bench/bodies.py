"""One brain, all bodies in turn: the brain's processes are not restarted and not told which."""

import asyncio
import dataclasses
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
from msgspec import Struct

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import BodyLost
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.qa.bench.bodies_onlooker import Onlooker
from gigabrain_zenoh.runtime.deployment import Deployment, client_endpoint, with_free_port
from gigabrain_zenoh.runtime.managed_process import ProcessSpec
from gigabrain_zenoh.runtime.supervisor import Supervisor
from gigabrain_zenoh.ui.run_report import RunMonitor

BODY = ("emulator", "driver")  # what is exchanged; all else stays
LOOK_S = 0.05
START_S = 60.0  # until a body is enabled, on a busy machine
STALL_S = 20.0
STOP_S = 1.5
TICK_S = 0.02


class BodyFigures(Struct, frozen=True, kw_only=True):
    """How one body fared with the brain."""

    body: str
    seconds: float  # of the robot's time, while enabled
    contacts: int | None  # the simulation's truth, as are the next two
    distance_m: float | None
    min_clearance_m: float | None
    commanded: float  # [m/s], mean of the speed forward
    measured: float  # [m/s]
    latency_ticks: float | None  # median from a command of motion to the motion measured
    motions: int  # that this median is of
    reconnects: int
    stops: int  # how often the gate was shut meanwhile
    driver_cpu: float | None  # [%] of a core; a body that the driver simulates is part of it


class BodiesResult(Struct, frozen=True, kw_only=True):
    """All bodies, and whether it really was the same brain."""

    link: LinkName
    world: str
    seed: int
    brain_pids: dict[str, int]
    brain_restarts: int
    bodies: tuple[BodyFigures, ...]

    @property
    def ok(self) -> bool:
        """Whether nobody touched anything, and nothing of the brain was started anew."""
        return self.brain_restarts == 0 and all(body.contacts == 0 for body in self.bodies)


async def measure_bodies(
    names: Sequence[str],
    deployment: Deployment,
    seconds: float,
    folder: Path,
    say: Callable[[str], None],
) -> BodiesResult:
    """Drive each body for so many seconds of its time. Raises GigabrainError.

    `deployment` says all but the body.
    """
    deployment = with_free_port(deployment)
    brain = [
        spec
        for spec in process_specs(deployment, "robot", folder / "brain", folder / "state")
        if spec.name not in BODY
    ]
    async with Supervisor(brain, lambda name, record: None) as supervisor:
        running = asyncio.create_task(supervisor.run())
        await _all_ready(supervisor, running)
        pids = {name: status.pid or 0 for name, status in supervisor.statuses.items()}
        figures = []
        for name in names:
            say(name)
            where = folder / Path(name).stem
            one = msgspec.structs.replace(deployment, body=name)
            figures.append(await _drive(one, seconds, where, supervisor))
        restarts = supervisor.deaths + sum(s.restarts for s in supervisor.statuses.values())
        same = all(s.pid == pids[name] for name, s in supervisor.statuses.items())
        await supervisor.stop(STOP_S)
        await running
    return BodiesResult(
        link=deployment.link,
        world=deployment.world,
        seed=deployment.seed,
        brain_pids=pids,
        brain_restarts=restarts if same else max(restarts, 1),
        bodies=tuple(figures),
    )


async def _drive(
    deployment: Deployment, seconds: float, folder: Path, brain: Supervisor
) -> BodyFigures:
    """One body, from its driver's start to its end."""
    specs = [
        _alone(spec)
        for spec in process_specs(deployment, "robot", folder, folder / "state")
        if spec.name in BODY
    ]
    bus = Bus(await ZenohTransport.open(client_endpoint(deployment)), Clock(), "bench")
    try:
        onlooker, watch = Onlooker(bus), RunMonitor(bus)
        async with Supervisor(specs, lambda name, record: None) as supervisor:
            running = asyncio.create_task(supervisor.run())
            await _until_driven(onlooker, seconds, supervisor, brain)
            truth = await _truth(watch, supervisor)
            await supervisor.stop(STOP_S)
            await running
    finally:
        await bus.close()
    return _figures(deployment.body, onlooker, truth)


def _alone(spec: ProcessSpec) -> ProcessSpec:
    """The same, waiting for nobody of another supervisor."""
    return dataclasses.replace(spec, after=tuple(name for name in spec.after if name in BODY))


async def _all_ready(supervisor: Supervisor, running: "asyncio.Task[None]") -> None:
    async with asyncio.timeout(START_S):
        while any(status.state != "ready" for status in supervisor.statuses.values()):
            if supervisor.given_up or running.done():
                raise BodyLost(f"{', '.join(supervisor.given_up)} cannot be started")
            await asyncio.sleep(LOOK_S)


async def _until_driven(
    onlooker: Onlooker, seconds: float, body: Supervisor, brain: Supervisor
) -> None:
    """Look on until the gate has been open for so long. Raises BodyLost when nothing goes on."""
    loop = asyncio.get_running_loop()
    seen, seen_s = onlooker.enabled_ticks, loop.time()
    while onlooker.enabled_ticks * TICK_S < seconds:
        await asyncio.sleep(LOOK_S)
        if body.given_up or brain.given_up:
            raise BodyLost(f"{', '.join(body.given_up or brain.given_up)} does not run")
        if onlooker.enabled_ticks != seen:
            seen, seen_s = onlooker.enabled_ticks, loop.time()
        elif loop.time() - seen_s > (STALL_S if seen else START_S):
            gate = onlooker.state.gate if onlooker.state else None
            raise BodyLost(f"nothing goes on; gate: {gate}")


async def _truth(watch: RunMonitor, supervisor: Supervisor) -> dict[str, float | int | str | None]:
    told = await asyncio.gather(*(watch.describe(name, 1.0) for name in supervisor.statuses))
    return {key: value for answer in told if answer for key, value in answer.report.items()}


def _figures(
    body: str, onlooker: Onlooker, truth: dict[str, float | int | str | None]
) -> BodyFigures:
    def number(name: str) -> float | None:
        value = truth.get(name)
        return float(value) if isinstance(value, int | float) else None

    contacts, late, cpu = number("contacts"), onlooker.latencies, onlooker.driver_cpu
    return BodyFigures(
        body=Path(body).stem if body.endswith((".yaml", ".yml")) else body,
        seconds=round(onlooker.enabled_ticks * TICK_S, 2),
        contacts=None if contacts is None else int(contacts),
        distance_m=number("distance_m"),
        min_clearance_m=number("min_clearance_m"),
        commanded=round(onlooker.commanded, 4),
        measured=round(onlooker.measured, 4),
        latency_ticks=statistics.median(late) if late else None,
        motions=len(late),
        reconnects=onlooker.state.link.reconnects if onlooker.state else 0,
        stops=onlooker.stops,
        driver_cpu=round(100 * statistics.fmean(cpu), 1) if cpu else None,
    )
