"""Buses, single nodes and a whole robot in memory, on a clock that the test moves."""

import asyncio
import functools
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Self, TypeVar

import msgspec

from gigabrain_drivers.bodies.mock.driver import MockBody, MockOptions
from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_schemas.base import TICK_S, Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.topics import STATE, Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import InputLogger
from gigabrain_zenoh.bus.transport import Close, LocalNetwork, LocalTransport, OnSample
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.config.settings import DecisionConfig, DriverConfig, PerceptionConfig, Resume
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.host.threads import Job, done
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.runtime.connect import MakeBus
from gigabrain_zenoh.runtime.replay import Node
from gigabrain_zenoh.safety import node as safety
from gigabrain_zenoh.testing.samples import TICK_NS
from gigabrain_zenoh.testing.waiting import PATIENCE_S

M = TypeVar("M", bound=Message)


DECISION = DecisionConfig(settings={"max_linear_speed": 0.26})
BRAIN: dict[str, Node] = {
    "perception": functools.partial(perception.run, PerceptionConfig()),
    "decision": functools.partial(decision.run, DECISION),
    "control": control.run,
    "safety": safety.run,
}


class PatientJournal(InputLogger):
    """Waits for a node's background work on any machine, for tests that compare results."""

    def in_time(self, job: Job, patience_s: float) -> bool:
        """Return whether `job` is done. Wait for it, unless `patience_s` is 0."""
        return done(job, PATIENCE_S if patience_s else 0.0)

    def when_done(self, job: Job, then: Callable[[Job], None]) -> None:
        """Wait for `job`, and call `then(job)`."""
        done(job, PATIENCE_S)
        self._note_finished()
        then(job)


class Net:
    """The buses of two processes on one network and one clock."""

    def __init__(self) -> None:
        self.network, self.clock = LocalNetwork(), FakeClock()
        self.one, self.two = self.bus("one"), self.bus("two")

    def bus(self, process: str) -> Bus:
        """Return the bus of one more process."""
        return Bus(self.network.transport(), self.clock, process)


class NodeBench:
    """One node alone on a network: `async with NodeBench(node) as bench:`."""

    def __init__(self, node: Node) -> None:
        self.clock, self.network = FakeClock(), LocalNetwork()
        self._node, self._read_count = node, 0
        self._ready = asyncio.Event()

    async def __aenter__(self) -> Self:
        self.bus = Bus(self.network.transport(), self.clock, "node")
        self.bus.input_log = PatientJournal()
        self._running = asyncio.ensure_future(self._node(self.bus, self._ready.set))
        await self.clock.advance(0)
        return self

    async def ready(self) -> None:
        """Wait until the node is ready; some compile first."""
        waiting = asyncio.ensure_future(self._ready.wait())
        await asyncio.wait((waiting, self._running), return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        if self._running.done():
            self._running.result()

    async def restart(self) -> None:
        """End the node, and start it again."""
        await self._end()
        self._ready.clear()
        await self.__aenter__()

    async def __aexit__(self, *_: object) -> None:
        await self._end()

    async def _end(self) -> None:
        self._running.cancel()
        result = (await asyncio.gather(self._running, return_exceptions=True))[0]
        await self.bus.close()
        assert isinstance(result, asyncio.CancelledError), result

    def send(self, topic: Topic[M], message: M, *, name: str = "") -> None:
        """Deliver `message` to the node with the header it has."""
        self.network.deliver(topic.at(name), codec.encode(message))

    def sent(self, topic: Topic[M]) -> list[M]:
        """Return the node's messages on `topic` since the last call.

        Its messages on other topics since then are dropped.
        """
        new = self.network.sent[self._read_count :]
        self._read_count = len(self.network.sent)
        decode = msgspec.msgpack.Decoder(topic.type).decode
        return [decode(payload) for key, payload in new if key == topic.key]


class FreezableTransport(LocalTransport):
    """The transport of a process that can be frozen; `thaw` delivers the missed samples."""

    def __init__(self, network: LocalNetwork) -> None:
        super().__init__(network)
        self.frozen = False
        self._missed: list[Callable[[], object]] = []

    def subscribe(self, key: str, on_sample: OnSample, depth: int, *, lazy: bool = False) -> Close:
        """Subscribe to `key`; samples wait while the process is frozen."""

        def receive(key: str, payload: bytes) -> None:
            if self.frozen:
                self._missed.append(functools.partial(on_sample, key, payload))
            else:
                on_sample(key, payload)

        return super().subscribe(key, receive, depth, lazy=lazy)

    def thaw(self) -> None:
        """Resume the process: deliver the missed samples, and later ones at once."""
        self.frozen = False
        while self._missed:
            self._missed.pop(0)()


class RecordedBody(MockBody):
    """A mock body that records its speed in each tick."""

    def __init__(self, robot: RobotFile, options: MockOptions, run: Run) -> None:
        super().__init__(robot, options, run)
        self.speeds: list[float] = []  # [m/s], one per tick, at its start

    def _advance(self) -> None:
        self.speeds.append(self._velocity.linear_x)
        super()._advance()


class RobotInMemory:
    """A robot whose processes are tasks: `async with RobotInMemory(folder) as robot:`.

    Time passes only in `go`, in ticks of 20 ms.
    """

    def __init__(
        self,
        folder: Path,
        *,
        resume: Resume = "auto",
        button: bool = False,
        make_body: type[RecordedBody] = RecordedBody,
    ) -> None:
        self._make_body = make_body
        self.network, self.clock = LocalNetwork(), FakeClock()
        self._config = DriverConfig(
            body="mock", resume=resume, state_dir=str(folder), button=button
        )
        self._running: dict[str, tuple[asyncio.Future[None], Bus]] = {}
        self._transports: dict[str, FreezableTransport] = {}
        self.state: RobotState | None = None

    async def __aenter__(self) -> Self:
        self.operator = Bus(self.network.transport(), self.clock)
        self.operator.subscribe(STATE, self._on_state)
        for name in BRAIN:
            self.start(name)
        await self.clock.advance(0)
        self.start_driver()
        return self

    async def __aexit__(self, *_: object) -> None:
        for name in list(self._running):
            await self.kill(name)
        await self.operator.close()

    def start(self, name: str, make_bus: MakeBus = Bus) -> None:
        """Start one of the brain's processes."""
        self._transports[name] = FreezableTransport(self.network)
        bus = make_bus(self._transports[name], self.clock, name)
        self._running[name] = asyncio.ensure_future(BRAIN[name](bus, lambda: None)), bus

    def start_driver(self) -> None:
        """Start the driver's process, with a body at rest."""
        self.body = self._make_body(
            load_robot("mock"), MockOptions(driver="mock"), Run(folder=Path())
        )
        bus = Bus(self.network.transport(), self.clock, "driver")
        process = DriverProcess(self._config, self.body.robot, self.body, bus)
        self._running["driver"] = asyncio.ensure_future(process.run(lambda: None)), bus

    async def kill(self, name: str) -> None:
        """End one process at once."""
        task, bus = self._running.pop(name)
        assert not task.done(), task
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await bus.close()

    def freeze(self, name: str) -> None:
        """Freeze one of the brain's processes, as SIGSTOP does."""
        self._transports[name].frozen = True

    def thaw(self, name: str) -> None:
        """Resume a frozen process, as SIGCONT does; it receives the missed samples."""
        self._transports[name].thaw()

    async def go(self, ticks: int) -> list[float]:
        """Let `ticks` pass; return the body's speed in each tick [m/s]."""
        before = len(self.body.speeds)
        await self.clock.advance(ticks * TICK_NS)
        for task, _ in self._running.values():
            if task.done():
                task.result()
        return self.body.speeds[before:]

    def bus(self, name: str) -> Bus:
        """Return the bus of one of the processes."""
        return self._running[name][1]

    @property
    def mode(self) -> str:
        """The gate's mode."""
        assert self.state
        return self.state.gate.mode

    @property
    def causes(self) -> list[str]:
        """The codes of the gate's causes."""
        assert self.state
        return [cause.code for cause in self.state.gate.causes]

    @property
    def counters(self) -> Counter[str]:
        """The counters of the driver's bus."""
        return self._running["driver"][1].counters

    def _on_state(self, _key: str, state: RobotState) -> None:
        self.state = state


def ticks_until(speeds: list[float], reached: Callable[[float], bool]) -> int:
    """Return the number of the first tick whose speed fulfils `reached`, counted from 1."""
    return next(i for i, speed in enumerate(speeds, 1) if reached(speed))


def travelled(speeds: list[float]) -> float:
    """Return the distance driven [m] with these speeds per tick [m/s]."""
    return math.fsum(speeds) * TICK_S
