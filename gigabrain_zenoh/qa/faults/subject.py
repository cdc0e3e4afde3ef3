"""The robot that is broken on purpose: all its processes, and whoever looks on."""

import asyncio
import contextlib
import os
import signal
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import msgspec

from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.config.settings import ProcessConfig
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.qa.faults.fault import Failed
from gigabrain_zenoh.qa.faults.onlooker import Onlooker, looking_on
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.runtime.deployment import EMULATOR, Deployment, client_endpoint, with_free_port
from gigabrain_zenoh.runtime.managed_process import Backoff, ProcessSpec
from gigabrain_zenoh.runtime.supervisor import Supervisor

Change = Callable[[list[ProcessSpec]], list[ProcessSpec]]
# what is killed all the time is started again each time: giving up has a test of its own
TIRELESS = Backoff(factor=1.0, deaths=10_000)
FAULTS_FILE = "faults.json"  # as the emulator's process reads it
STOP_S = 1.5
START_S = 300.0  # far more than it takes to compile what a navigating robot calls
NEARLY_STRAIGHT = {"avoid": 0.1, "navigate": 0.3}  # [rad/s]; legs sway, and ways have bends
FULL_SHARE = {"avoid": 0.96, "navigate": 0.6}  # of a speed; a busy host drives more slowly


class Subject:
    """One robot under test. Used as `async with`, or closed by hand."""

    def __init__(
        self,
        deployment: Deployment,
        folder: Path,
        change: Change | None = None,
        backoff: Backoff = TIRELESS,
        *,
        keep_stuck: bool = True,
    ) -> None:
        self.deployment, self.folder = with_free_port(deployment), folder
        specs = process_specs(self.deployment, "robot", folder / "run", folder / "state")
        if change:
            specs = change(specs)
        # a test that freezes a process thaws it itself, unless it asks for the restart
        self.supervisor = Supervisor(specs, self._record, backoff, keep_stuck=keep_stuck)
        self.records: list[Mapping[str, Any]] = []  # of all logs
        self.harmed = False  # a test may say that nobody should use this robot again
        self.onlooker: Onlooker
        self.person: Robot
        self._stack = AsyncExitStack()
        self._frozen: set[int] = set()
        self._faulty = False
        self._contacts = 0
        self._judged = 0  # records that have been looked at

    async def __aenter__(self) -> Self:
        try:
            await self._stack.enter_async_context(self.supervisor)
            self._running = asyncio.create_task(self.supervisor.run())
            self._stack.push_async_callback(self._end)
            await self.ready()
            where = client_endpoint(self.deployment, "operator")
            self.onlooker = await self._stack.enter_async_context(looking_on(where, "suite"))
            self.person = Robot(self.onlooker.bus)
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """End all of it. Any number of times."""
        self.thaw()
        await self._stack.aclose()

    async def _end(self) -> None:
        await self.supervisor.stop(STOP_S)
        await self._running

    @property
    def unharmed(self) -> bool:
        """Whether it can be used for another test."""
        return not (self.harmed or self.supervisor.given_up or self._running.done())

    @property
    def ports(self) -> Path:
        """The folder of an emulated body's ports."""
        return self.folder / "run" / "ports"

    @property
    def truth_of(self) -> str:
        """The process whose report is the physics' truth."""
        return EMULATOR if self.deployment.link == "emulated" else "driver"

    def ready_pids(self) -> list[int]:
        """Return the pids of all processes that are ready."""
        statuses = self.supervisor.statuses.values()
        return [status.pid for status in statuses if status.pid and status.state == "ready"]

    def pid(self, name: str) -> int:
        """The pid of a process that runs. Raises Failed."""
        pid = self.supervisor.statuses[name].pid
        if pid is None:
            raise Failed(f"{name} does not run")
        return pid

    def send(self, name: str, number: signal.Signals) -> int:
        """Send a signal to a process; its pid. Raises Failed where it has died by itself."""
        pid = self.pid(name)
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            raise Failed(f"{name} has died by itself") from None
        return pid

    def kill(self, name: str) -> int:
        """SIGKILL; the pid that it had."""
        return self.send(name, signal.SIGKILL)

    def freeze(self, name: str) -> None:
        """SIGSTOP, until `thaw` or the end of the test."""
        self._frozen.add(self.send(name, signal.SIGSTOP))

    def thaw(self) -> None:
        """SIGCONT to all that were frozen and still run."""
        alive = {status.pid for status in self.supervisor.statuses.values()}
        for pid in self._frozen & alive:
            if pid is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)
        self._frozen.clear()

    async def ready(self) -> None:
        """Wait until every process is ready. Raises ConfigError for a robot that cannot be."""
        statuses = self.supervisor.statuses.values()

        def all_ready() -> bool:
            if self.supervisor.misconfigured:
                raise ConfigError(self._refusal())
            if self.supervisor.given_up:
                raise Failed(f"{', '.join(self.supervisor.given_up)} cannot be started")
            return all(status.state == "ready" for status in statuses)

        await until(all_ready, "all processes are ready", START_S)

    def _refusal(self) -> str:
        said = [r for r in self.records if r.get("event") == "failed"]
        return str(said[-1]["text"]) if said else "a process refuses what it is told"

    async def restarted(self, name: str, pid: int) -> None:
        """Wait until a process that had this pid is ready under another one."""
        status = self.supervisor.statuses[name]
        await until(
            lambda: status.state == "ready" and status.pid != pid, f"{name}'s restart", START_S
        )

    async def break_body(self, **faults: Mapping[str, Any]) -> None:
        """Have these faults of an emulated body, by station, and no others.

        Returns once the emulator has taken them.
        """
        path = self.ports / FAULTS_FILE
        begin = len(self.records)
        fresh = path.with_suffix(".new")
        fresh.write_bytes(msgspec.json.encode(faults))
        fresh.replace(path)
        self._faulty = bool(faults)

        def taken() -> bool:
            texts = (str(record.get("text", "")) for record in self.records[begin:])
            told = [text for text in texts if text.startswith("faults: ")]
            return bool(told) and (told[-1] == "faults: none") != bool(faults)

        await until(taken, "the emulator takes its faults")

    async def truth(self) -> dict[str, Any]:
        """What the physics knows: contacts, distance_m, true_speed and more."""
        return dict((await self.onlooker.describe(self.truth_of)).report)

    async def distance(self) -> float:
        """How long the path of the body has been so far, by the physics [m]."""
        return float((await self.truth())["distance_m"])

    async def simulated(self, seconds: float) -> dict[str, Any]:
        """Let an emulated body's own time go on, whoever else lives; the truth after that."""
        truth = await self.truth()
        end_s = float(truth["sim_seconds"]) + seconds
        while float(truth["sim_seconds"]) < end_s:
            await asyncio.sleep(0.02)
            truth = await self.truth()
        return truth

    async def drive(self, room: float = 1.3, share: float = 1.0) -> None:
        """Have the brain drive straight on as fast as it may, as a person would: by hand.

        `share` of that is enough, where the gate must be expected to slow it down.
        """
        onlooker = self.onlooker
        await self.release()
        await until(lambda: onlooker.bodies.current, "the driver says what its body is")
        body = onlooker.bodies.current
        most = body.description.max_linear_speed if body else 0.0
        decision = self.deployment.decision
        speed = share * FULL_SHARE[decision.behaviour] * min(decision.linear_speed, most)
        await onlooker.straight(speed, room, NEARLY_STRAIGHT[decision.behaviour], by_hand=True)

    async def release(self) -> None:
        """As a person: let go of a latched gate, as soon as that is possible."""
        onlooker = self.onlooker
        while onlooker.state.gate.mode == "latched":
            try:
                await self.person.release()
            except Refused:
                await onlooker.ticks(5)
            else:
                await until(lambda: onlooker.state.gate.mode != "latched", "released")

    async def settle(self) -> None:
        """All processes run, the body is whole and at rest or driven by its brain."""
        self.thaw()
        if self._faulty:
            await self.break_body()
        await self.ready()
        boot = self.onlooker.state.boot
        await until(lambda: self.onlooker.state.link.connected, "the body answers")
        if self.onlooker.state.boot == boot:
            await self.release()
        self._contacts = int((await self.truth())["contacts"])
        self._judged = len(self.records)

    async def check(self) -> None:
        """Raise Failed where something was touched, or a program has died of itself."""
        contacts = int((await self.truth())["contacts"])
        if contacts > self._contacts:
            raise Failed(f"{contacts - self._contacts} contacts")
        for record in self.records[self._judged :]:
            if record.get("level") == "critical":
                raise Failed(f"{record.get('process')}: {record.get('text')}")

    def _record(self, _name: str, record: Mapping[str, Any]) -> None:
        self.records.append(record)


def configured(spec: ProcessSpec, settings: Mapping[str, Any]) -> ProcessSpec:
    """The same process with some of its settings replaced."""
    config = msgspec.json.decode(spec.argv[-1], type=ProcessConfig)
    config = msgspec.structs.replace(config, settings={**config.settings, **settings})
    return replace(spec, argv=(*spec.argv[:-1], msgspec.json.encode(config).decode()))
