"""Provides robots under test, and measures how a driving robot stops after a fault."""

import itertools
import signal
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

from msgspec import structs

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.emulators.emulator import wire_kind
from gigabrain_schemas.base import TICK_MS, Message
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import (
    DecisionConfig,
    Endpoint,
    LinkName,
    PerceptionConfig,
    ProcessConfig,
    Resume,
)
from gigabrain_zenoh.decision.behaviours import load, needs_map
from gigabrain_zenoh.launch.deployment import Deployment, client_endpoint, with_free_port
from gigabrain_zenoh.qa.judging import Failed, Figure, Skipped, Stage
from gigabrain_zenoh.qa.probe import Probe, at_rest, until
from gigabrain_zenoh.qa.proxy.chaos import Chaos
from gigabrain_zenoh.qa.proxy.tcp import TcpProxy
from gigabrain_zenoh.qa.robot_under_test import (
    LOOPBACK,
    NEVER_GIVE_UP,
    Change,
    RobotUnderTest,
    reconfigured,
)
from gigabrain_zenoh.runtime.managed_process import Backoff, ProcessSpec

BROKEN_PROCESS = (sys.executable, "-P", "-m", "gigabrain_zenoh.qa.faults.broken_process")
SPEED = 0.26  # [m/s], default of the tests
BODIES: dict[Stage, str] = {
    "sim": "turtlebot3_waffle",
    "auto": "turtlebot3_waffle",
    "line": "mycustombot",
    "serial": "mycustombot",
    "tcp": "alpha",
    "arm": "so101",
}
SLOWER = 0.01  # [m/s], half of a body's braking per tick
RESTED_TICKS = 50  # a robot must stand this long after the end of a fault

BRAKES, ZERO = Figure("brakes after", "ms"), Figure("zero after", "ms")
TRAVEL = Figure("travel", "m")
MOVED_AGAIN = Figure("moved again", "m")  # before a person enables it again
STALE = Figure("stale commands executed")  # based on data older than 250 ms
MOTORS_ZERO = Figure("motors zero after", "ms")
DEATHS = Figure("deaths")
STOPS = Figure("unexplained stops")
MEMORY_GROWN = Figure("memory grown", "MB")
PERIOD_ADDED = Figure("control period p99 above calm", "ms")
DRIVES_AGAIN = Figure("drives again after", "s")
DRIVES_AGAIN_WALL = Figure("drives again after", "s", wall=True)
STOPS_IN_TIME = (BRAKES.at_most(120), ZERO.at_most(480), TRAVEL.at_most(0.1))
STAYS_STILL = MOVED_AGAIN.at_most(0.005)
NONE_STALE = STALE.at_most(0)


HOLE = Chaos(hole=True)


@dataclass(frozen=True)
class Options:
    """Options of a run of the suite."""

    body: str = ""  # replaces the body of each stage
    world: str = "arena"
    behaviour: str = "avoid"
    cameras: bool = False
    long: bool = False  # long forms, for a release
    wall: bool = True  # also judge wall-clock limits, which need an otherwise idle machine


class Rig:
    """Provides running robots inside its `async with` block; no process is left afterwards."""

    def __init__(self, options: Options, folder: Path) -> None:
        self.options, self.folder = options, folder
        self._numbers = itertools.count(1)
        self._kept: tuple[Deployment, RobotUnderTest] | None = None
        self._robots: list[RobotUnderTest] = []

    def pids(self) -> list[int]:
        """Return the pids of all ready processes of all running robots."""
        return [pid for robot in self._robots for pid in robot.ready_pids()]

    @property
    def long(self) -> bool:
        """True for the long forms."""
        return self.options.long

    @property
    def body(self) -> str:
        """The body of tests without a robot."""
        return self.options.body or BODIES["sim"]

    @property
    def description(self) -> BodyDescription:
        """The description of `body`."""
        return load_robot(self.body).description()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.end_robot()

    async def robot(self, stage: Stage) -> RobotUnderTest:
        """Return a robot of a stage: the running one if it is reusable, else a new one.

        Raises Skipped if the chosen body does not fit the stage.
        """
        kept, wanted = self._kept, deployment_of(self.options, stage)
        if kept and (kept[0] != wanted or not kept[1].reusable):
            await self.end_robot()
        if self._kept is None:
            self._kept = wanted, await self.new(wanted).__aenter__()
        _, robot = self._kept
        await robot.settle()
        return robot

    def new(
        self, deployment: Deployment, change: Change | None = None,
        backoff: Backoff = NEVER_GIVE_UP, *, keep_stuck: bool = True,
    ) -> RobotUnderTest:  # fmt: skip
        """Return a robot that is not started. Use it as `async with`, after `end_robot`."""
        folder = self.fresh_folder()
        robot = RobotUnderTest(deployment, folder, change, backoff, keep_stuck=keep_stuck)
        self._robots.append(robot)
        return robot

    @asynccontextmanager
    async def own_robot(
        self, deployment: Deployment, change: Change | None = None,
        backoff: Backoff = NEVER_GIVE_UP, *, keep_stuck: bool = True, checked: bool = True,
    ) -> AsyncIterator[RobotUnderTest]:  # fmt: skip
        """Run a robot for one test only; with `checked`, contacts and deaths fail the test."""
        await self.end_robot()
        async with self.new(deployment, change, backoff, keep_stuck=keep_stuck) as robot:
            await robot.settle()
            yield robot
            if checked:
                await robot.check()

    def fresh_folder(self) -> Path:
        """Return a new, empty folder."""
        folder = self.folder / str(next(self._numbers))
        folder.mkdir(parents=True)
        return folder

    async def end_robot(self) -> None:
        """End the running robot. The next test gets a new one."""
        kept, self._kept = self._kept, None
        if kept:
            await kept[1].close()

    async def check(self) -> None:
        """Raise Failed if a test has caused contacts or a dead process."""
        if self._kept:
            await self._kept[1].check()


def deployment_of(options: Options, stage: Stage, resume: Resume = "manual") -> Deployment:
    """Return the deployment of a stage. Raises Skipped if the chosen body has no such link."""
    body = options.body or BODIES[stage]
    link: LinkName = "sim" if stage in ("sim", "auto") else "emulated"
    wire: Literal["serial", "tcp", ""] = wire_kind(body) if link == "emulated" else ""
    if stage == "arm" and not load_robot(body).joints:
        raise Skipped(f"{body} has no arm")
    if link == "emulated" and not (wire == stage or (wire and stage in ("line", "arm"))):
        raise Skipped(f"{body} has no {stage} line" if stage != "line" else f"{body} has no line")
    if stage == "arm":
        return Deployment(
            body=body,
            link=link,
            world=load_robot(body).demo.world,
            resume=resume,
            router=LOOPBACK,
            decision=DecisionConfig(behaviour="navigate"),
        )
    return Deployment(
        body=body,
        link=link,
        world=options.world,
        resume="auto" if stage == "auto" else resume,
        router=LOOPBACK,
        cameras=options.cameras and stage in ("sim", "auto"),
        perception=PerceptionConfig(mapping="slam" if needs_map(options.behaviour) else "off"),
        decision=DecisionConfig(
            behaviour=options.behaviour,
            settings={"max_linear_speed": SPEED, **load(options.behaviour).DEMO},
        ),
    )


def broken(names: tuple[str, ...], kind: str) -> Change:
    """Return a change of deployment that breaks the named processes."""

    def change(specs: list[ProcessSpec]) -> list[ProcessSpec]:
        return [
            replace(spec, argv=(*BROKEN_PROCESS, kind, spec.argv[-1]))
            if spec.name in names
            else spec
            for spec in specs
        ]

    return change


@asynccontextmanager
async def tampered(rig: Rig, *kinds: str) -> AsyncIterator[RobotUnderTest]:
    """Start a robot whose driver tampers by `kinds` of `broken_process.TAMPERINGS`."""
    change = broken(("driver",), ",".join(kinds))
    async with rig.own_robot(deployment_of(rig.options, "sim"), change) as robot:
        yield robot


def next_step(robot: RobotUnderTest) -> None:
    """Start the next kind of tampering, or end the present one."""
    robot.signal("driver", signal.SIGUSR1)


class Stop(NamedTuple):
    """A stop from straight driving."""

    brakes_ms: float  # from the victim's last tick to the first slower one
    zero_ms: float  # from there to the first tick at rest, as measured
    travel_m: float  # true distance until rest
    distance_m: float  # true length of the whole path so far

    def figures(self) -> dict[Figure, float]:
        """Return the figures of `STOPS_IN_TIME`."""
        return {BRAKES: self.brakes_ms, ZERO: self.zero_ms, TRAVEL: self.travel_m}


async def stop_by(robot: RobotUnderTest, fault: Callable[[], object], victim: str = "") -> Stop:
    """Cause a fault while the brain drives; wait until the gate is shut and the body rests.

    Times count from the last tick that the `victim` answered.
    """
    probe = robot.probe
    await robot.until_driving()
    before_m = await robot.travelled()
    start = probe.state
    fault()
    await until(lambda: probe.state.gate.mode != "enabled", "the gate begins to shut")
    begin = max(start.tick, _last_answer(probe, victim, start))
    await until(lambda: probe.state.gate.mode in ("idle", "latched"), "the gate shuts")
    if not any(s.gate.causes for s in probe.states if s.tick > start.tick):
        raise Failed("the gate gives no cause for being shut")
    await probe.at_rest()
    distance_m = await robot.travelled()
    brakes, zero = first_slower(probe, start, begin), first_zero(probe, start, begin)
    brakes_ms, zero_ms = (brakes - begin) * TICK_MS, (zero - begin) * TICK_MS
    return Stop(brakes_ms, zero_ms, distance_m - before_m, distance_m)


def _last_answer(probe: Probe, victim: str, start: RobotState) -> int:
    """Return the newest tick that the victim answered.

    Call it when the gate shuts: then all answers have arrived, even on a busy machine, and the
    victim is not restarted yet.
    """
    newest = {
        "decision": probe.intent.current,
        "safety": probe.safety.current,
        "control": probe.commands[-1] if probe.commands else None,
    }.get(victim)
    return newest.tick if newest and newest.boot == start.boot else 0


def first_slower(probe: Probe, start: RobotState, begin: int) -> int:
    """Return the first tick since `begin` with a slower command, or a shut gate."""
    shut = next(s.tick for s in probe.since(start)[1:] if s.gate.mode != "enabled")
    ours = [c for c in probe.commands if c.boot == start.boot]
    speed = next((c.linear_x for c in reversed(ours) if c.tick <= begin), 0.0)
    slower = (c.tick for c in ours if c.tick > begin and c.linear_x < speed - SLOWER)
    return min(shut, next(slower, shut))


def first_zero(probe: Probe, start: RobotState, begin: int) -> int:
    """Return the first tick since `begin` from which the body rests, as measured."""
    moving = [s.tick for s in probe.since(start) if s.tick > begin and not at_rest(s)]
    return (moving[-1] if moving else begin) + 1


@asynccontextmanager
async def behind_proxy(
    rig: Rig, *names: str, resume: Resume = "manual"
) -> AsyncIterator[tuple[RobotUnderTest, TcpProxy]]:
    """Start a robot whose named processes connect to the others through a proxy."""
    deployment = with_free_port(deployment_of(rig.options, "sim", resume))
    async with TcpProxy(address_of(client_endpoint(deployment))) as proxy:

        def through(config: ProcessConfig) -> ProcessConfig:
            endpoint = structs.replace(config.endpoint, connect=(proxy.endpoint,))
            return structs.replace(config, endpoint=endpoint)

        def change(specs: list[ProcessSpec]) -> list[ProcessSpec]:
            return [reconfigured(s, through) if s.name in names else s for s in specs]

        async with rig.own_robot(deployment, change) as robot:
            yield robot, proxy
            proxy.set()


@asynccontextmanager
async def proxy_to(robot: RobotUnderTest) -> AsyncIterator[tuple[TcpProxy, Endpoint]]:
    """Put a proxy before a robot's router; yield it, and the endpoint for clients."""
    async with TcpProxy(address_of(robot.endpoint)) as proxy:
        yield proxy, structs.replace(robot.endpoint, connect=(proxy.endpoint,))


def address_of(endpoint: Endpoint) -> tuple[str, int]:
    """Return (host, port) of the router."""
    host, _, port = endpoint.connect[0].partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)


class Forger:
    """Sends messages with their own header, and arbitrary bytes."""

    def __init__(self, transport: ZenohTransport) -> None:
        self._transport = transport

    def send(self, topic: Topic[Any], message: Message) -> None:
        """Send a message with its own header."""
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
