"""The e-stop pressed in every state, and what it takes to move again."""

import asyncio
import itertools
import re
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel, Twist
from gigabrain_schemas.requests import EstopRequest, ReleaseRequest
from gigabrain_schemas.topics import CMD_VEL, ESTOP, RELEASE, TELEOP
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.errors import GigabrainError, Refused
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.rig import Rig
from gigabrain_zenoh.qa.faults.stopping import TICK_MS
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.runtime.deployment import client_endpoint

PRESSES, LONG_PRESSES = 100, 300  # from each endpoint
DRIVES, LONG_DRIVES = 2, 20  # presses while it drives
CALM_TICKS = 5  # the first 100 ms after an enable
HELD_S = 0.05  # between two messages of a joystick
CLI = ("-P", "-c", "from gigabrain_zenoh.cli.app import main; main()", "estop", "--connect")

Press = Callable[[], Awaitable[object]]  # a command answers with its own time [ms]


class Presses:
    """What came of all presses: times by the presser's clock, and by the robot's ticks."""

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self.answers_ms: list[float] = []  # until the presser has its answer
        self.zeros_ms: list[float] = []  # until a state shows the gate latched
        self.latched_ms: list[float] = []  # the same, by the robot's ticks
        self.unlatched = 0

    async def press(self, press: Press) -> None:
        """Press once. Raises Failed where it is not counted."""
        onlooker, loop = self._subject.onlooker, asyncio.get_running_loop()
        before, begin_s = onlooker.state, loop.time()
        generation = before.gate.estop_generation
        counted: asyncio.Future[tuple[RobotState, float]] = loop.create_future()

        def see(state: RobotState) -> None:
            if state.gate.estop_generation > generation and not counted.done():
                counted.set_result((state, loop.time()))

        onlooker.on_state = see
        said = await press()
        answered_s = loop.time()
        await until(counted.done, "it is counted")
        onlooker.on_state = lambda _state: None
        after, seen_s = counted.result()
        self.unlatched += after.gate.mode != "latched"
        if isinstance(said, float):  # of a command: it takes a while to start before it presses
            self.answers_ms.append(said)
            return
        self.answers_ms.append((answered_s - begin_s) * 1e3)
        self.zeros_ms.append((seen_s - begin_s) * 1e3)
        self.latched_ms.append((after.tick - before.tick) * TICK_MS)

    def figures(self) -> dict[str, float]:
        """Return what a row of the table is judged by."""
        return {
            "unlatched": self.unlatched,
            "latched after": max(self.latched_ms),
            "answer p99": _p99(self.answers_ms),
            "answer": max(self.answers_ms),
            "zero p99": _p99(self.zeros_ms),
            "zero": max(self.zeros_ms),
        }


def _p99(times_ms: list[float]) -> float:
    return sorted(times_ms)[-1 - len(times_ms) // 100]


async def e_stop_pressed(rig: Rig) -> Measured:
    """While it drives, stops, stands and is latched; from scripts, foreign clients and the CLI."""
    subject = await rig.robot("sim")
    presses, travel_m = Presses(subject), 0.0
    where = client_endpoint(subject.deployment)
    transport = await ZenohTransport.open(where)

    async def foreign() -> None:
        await transport.query(ESTOP.key, b"", "", 1.0, "real_time")

    async def command() -> float:
        return await _command_ms(where.connect[0])

    try:
        for press in itertools.islice(
            itertools.cycle((_ours(subject), foreign)), LONG_DRIVES if rig.long else DRIVES
        ):
            travel_m = max(travel_m, await _while_driving(subject, presses, press))
        await _while_stopping(subject, presses)
        await presses.press(command)
        for _ in range(LONG_PRESSES if rig.long else PRESSES):
            await presses.press(_ours(subject))
            await presses.press(foreign)
        await _two_at_once(subject, presses, foreign)
        async with _flood(subject):
            for _ in range(PRESSES):
                await presses.press(_ours(subject))
    finally:
        await transport.close()
    return {
        **presses.figures(),
        "travel": travel_m,
        "confirmed by nobody": await _confirmed_by_nobody(subject),
    }


def _ours(subject: Subject) -> Press:
    return lambda: subject.person.estop("fault suite")


async def _command_ms(where: str) -> float:
    """`gigabrain estop` in a process of its own; the time until it was confirmed, as it says."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, *CLI, where, stdout=asyncio.subprocess.PIPE
    )
    out, _ = await process.communicate()
    told = re.fullmatch(r"CONFIRMED by .* \((\d+) ms\)\s*", out.decode())
    if process.returncode or not told:
        raise Failed(f"gigabrain estop ended with {process.returncode}: {out.decode()}")
    return float(told[1])


async def _while_driving(subject: Subject, presses: Presses, press: Press) -> float:
    """How far it goes [m]."""
    await subject.drive(room=0.8)
    before_m = await subject.distance()
    await presses.press(press)
    await subject.onlooker.still()
    return await subject.distance() - before_m


async def _while_stopping(subject: Subject, presses: Presses) -> None:
    """Pressed while the body ramps down because decision has died."""
    onlooker = subject.onlooker
    await subject.drive(room=0.8)
    pid = subject.kill("control")
    await until(lambda: onlooker.state.gate.mode != "enabled", "it stops", within_s=5.0)
    await presses.press(_ours(subject))
    await subject.restarted("control", pid)


async def _two_at_once(subject: Subject, presses: Presses, foreign: Press) -> None:
    """Both count."""
    generation = subject.onlooker.state.gate.estop_generation
    ours = _ours(subject)

    async def both() -> None:
        await asyncio.gather(ours(), foreign())

    await presses.press(both)
    await subject.onlooker.ticks(5)
    presses.unlatched += subject.onlooker.state.gate.estop_generation < generation + 2


async def _confirmed_by_nobody(subject: Subject) -> int:
    """Whether somebody confirms it while the driver is frozen."""
    subject.freeze("driver")
    bus = subject.onlooker.bus
    try:
        replies: list[Any] = await bus.ask(ESTOP, EstopRequest(source="suite"), timeout_s=0.5)
    except GigabrainError:
        replies = []
    subject.thaw()
    return len(replies)


@asynccontextmanager
async def _flood(subject: Subject) -> AsyncIterator[None]:
    """A client that writes commands 500 times a second."""

    async def pour() -> None:
        while True:
            subject.onlooker.bus.publish(CMD_VEL, CmdVel(linear_x=0.2, source="flooder"))
            await asyncio.sleep(0.002)

    task = asyncio.create_task(pour())
    try:
        yield
    finally:
        task.cancel()


async def release_and_re_enable(rig: Rig) -> Measured:
    """Released too early, in ignorance, twice at once; enabled with a joystick held."""
    subject = await rig.robot("sim")
    onlooker, wrong = subject.onlooker, 0
    await subject.drive(room=0.8)
    await subject.person.estop("fault suite")
    generation = onlooker.state.gate.estop_generation
    wrong += await _released(subject, generation)  # while it still moves
    await subject.person.estop("fault suite")
    await until(lambda: onlooker.state.gate.estop_generation > generation, "it is counted")
    async with _joystick(subject):
        await onlooker.still(30)
        rest_m = await subject.distance()
        wrong += await _released(subject, generation)  # of a stop that is not the newest
        await onlooker.ticks(25)
        newest = onlooker.state.gate.estop_generation
        await asyncio.gather(_released(subject, newest), _released(subject, newest))
        await onlooker.ticks(50)
        if onlooker.state.gate.mode != "idle":
            raise Failed(f"the gate is {onlooker.state.gate.mode} after a release")
        moved_m = await subject.distance() - rest_m
        await onlooker.hand_to_brain()
        speed = await _first_speed(subject)
    await onlooker.ticks(20)  # what a joystick says is trusted for a moment after it ends
    await onlooker.hand_to_brain()
    return {
        "wrongly released": wrong,
        "moved while latched": moved_m,
        "speed after enabling": speed,
    }


async def _released(subject: Subject, generation: int) -> bool:
    """Ask for a release; whether it was granted."""
    request = ReleaseRequest(estop_generation=generation, source="suite")
    try:
        replies = await subject.onlooker.bus.ask(RELEASE, request)
    except Refused:
        return False
    return any(reply.ok for reply in replies)


@asynccontextmanager
async def _joystick(subject: Subject) -> AsyncIterator[None]:
    """An operator who holds the stick forward all the time."""

    async def hold() -> None:
        while True:
            subject.onlooker.bus.publish(TELEOP, Twist(linear_x=0.2))
            await asyncio.sleep(HELD_S)

    task = asyncio.create_task(hold())
    try:
        yield
    finally:
        task.cancel()


async def _first_speed(subject: Subject) -> float:
    """The greatest speed in the first 100 ms after an enable [m/s]."""
    onlooker = subject.onlooker
    await until(lambda: onlooker.state.gate.mode == "enabled", "it is enabled")
    await onlooker.ticks(2 * CALM_TICKS)
    states = list(itertools.takewhile(_enabled, reversed(onlooker.states)))[::-1]
    first = [s for s in states if s.tick - states[0].tick <= CALM_TICKS]
    return max(abs(state.velocity.linear_x) for state in first)


def _enabled(state: Any) -> bool:
    return bool(state.gate.mode == "enabled")
