"""The e-stop pressed in every state, and what it takes to move again."""

import asyncio
import itertools
import re
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

from gigabrain_schemas.base import TICK_MS, Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel, Twist
from gigabrain_schemas.requests import EstopRequest, ReleaseRequest
from gigabrain_schemas.topics import CMD_VEL, ESTOP, RELEASE, TELEOP, Topic
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.errors import GigabrainError, Refused
from gigabrain_zenoh.qa.faults.rig import TRAVEL, Rig
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, fault_row
from gigabrain_zenoh.qa.probe import until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest

PRESSES, LONG_PRESSES = 100, 300  # from each endpoint
DRIVES, LONG_DRIVES = 2, 20  # presses while it drives
CALM_TICKS = 5  # the first 100 ms after an enable
JOYSTICK_S, FLOOD_S = 0.05, 0.002  # between two messages
CLI = ("-P", "-c", "from gigabrain_zenoh.cli.app import main; main()", "estop", "--connect")

UNLATCHED = Figure("unlatched")
LATCHED = Figure("latched after", "ms")
ANSWER_P99, ANSWER = Figure("answer p99", "ms", wall=True), Figure("answer", "ms", wall=True)
ZERO_P99, ZERO_MAX = Figure("zero p99", "ms", wall=True), Figure("zero", "ms", wall=True)
FROZEN_CONFIRMED = Figure("confirmed by a frozen driver")
WRONGLY_RELEASED = Figure("wrongly released")
MOVED_LATCHED = Figure("moved while latched", "m")
FIRST_SPEED = Figure("speed after enabling", "m/s")

Press = Callable[[], Awaitable[object]]  # a command returns its own time [ms]


class PressLog:
    """Times of all presses, by the presser's clock and by the robot's ticks."""

    def __init__(self, robot: RobotUnderTest) -> None:
        self._robot = robot
        self.answers_ms: list[float] = []  # until the presser has its answer
        self.zeros_ms: list[float] = []  # until a state shows the gate latched
        self.latched_ms: list[float] = []  # the same, by the robot's ticks
        self.unlatched = 0

    async def press(self, press: Press) -> None:
        """Press once. Raises Failed where the press is not counted."""
        probe, loop = self._robot.probe, asyncio.get_running_loop()
        before, begin_s = probe.state, loop.time()
        generation = before.gate.estop_generation
        counted: asyncio.Future[tuple[RobotState, float]] = loop.create_future()

        def on_state(state: RobotState) -> None:
            if state.gate.estop_generation > generation and not counted.done():
                counted.set_result((state, loop.time()))

        probe.on_state = on_state
        own_ms = await press()
        answered_s = loop.time()
        await until(counted.done, "the press is counted")
        probe.on_state = lambda _state: None
        after, seen_s = counted.result()
        self.unlatched += after.gate.mode != "latched"
        if isinstance(own_ms, float):  # of a command, which takes a while to start
            self.answers_ms.append(own_ms)
            return
        self.answers_ms.append((answered_s - begin_s) * 1e3)
        self.zeros_ms.append((seen_s - begin_s) * 1e3)
        self.latched_ms.append((after.tick - before.tick) * TICK_MS)

    def figures(self) -> dict[Figure, float]:
        """Return the figures of all presses."""
        return {
            UNLATCHED: self.unlatched,
            LATCHED: max(self.latched_ms),
            ANSWER_P99: _p99(self.answers_ms),
            ANSWER: max(self.answers_ms),
            ZERO_P99: _p99(self.zeros_ms),
            ZERO_MAX: max(self.zeros_ms),
        }


def _p99(times_ms: list[float]) -> float:
    return sorted(times_ms)[-1 - len(times_ms) // 100]


@fault_row(
    43, "sim", UNLATCHED.at_most(0), LATCHED.at_most(100), ANSWER_P99.at_most(50),
    ANSWER.at_most(100), ZERO_P99.at_most(50), ZERO_MAX.at_most(100), TRAVEL.at_most(0.06),
    FROZEN_CONFIRMED.at_most(0),
)  # fmt: skip
async def e_stop_pressed(rig: Rig) -> Measured:
    """Press while it drives, stops, stands and is latched; from client, foreign client and CLI."""
    robot = await rig.robot("sim")
    presses, travel_m = PressLog(robot), 0.0
    endpoint = robot.endpoint
    transport = await ZenohTransport.open(endpoint)

    async def ours() -> None:
        await robot.operator.estop("fault suite")

    async def foreign() -> None:
        await transport.query(ESTOP.key, b"", "", 1.0, "real_time")

    async def command() -> float:
        return await _command_ms(endpoint.connect[0])

    async def both() -> None:
        await asyncio.gather(ours(), foreign())

    try:
        drives = LONG_DRIVES if rig.long else DRIVES
        for press in itertools.islice(itertools.cycle((ours, foreign)), drives):
            travel_m = max(travel_m, await _while_driving(robot, presses, press))
        await _while_stopping(robot, presses, ours)
        await presses.press(command)
        for _ in range(LONG_PRESSES if rig.long else PRESSES):
            await presses.press(ours)
            await presses.press(foreign)
        generation = robot.probe.state.gate.estop_generation
        await presses.press(both)
        await robot.probe.ticks(5)
        presses.unlatched += robot.probe.state.gate.estop_generation < generation + 2
        flood = CmdVel(linear_x=0.2, source="flooder")
        async with _publishing(robot, CMD_VEL, flood, FLOOD_S):
            for _ in range(PRESSES):
                await presses.press(ours)
    finally:
        await transport.close()
    confirmed = await _confirmed_while_frozen(robot)
    return {**presses.figures(), TRAVEL: travel_m, FROZEN_CONFIRMED: confirmed}


async def _command_ms(endpoint: str) -> float:
    """Run `gigabrain estop`; return the time until confirmation that it prints [ms]."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, *CLI, endpoint, stdout=asyncio.subprocess.PIPE
    )
    out, _ = await process.communicate()
    printed = re.fullmatch(r"CONFIRMED by .* \((\d+) ms\)\s*", out.decode())
    if process.returncode or not printed:
        raise Failed(f"gigabrain estop ended with {process.returncode}: {out.decode()}")
    return float(printed[1])


async def _while_driving(robot: RobotUnderTest, presses: PressLog, press: Press) -> float:
    """Press while it drives; return the travel until rest [m]."""
    await robot.until_driving(room=0.8)
    before_m = await robot.travelled()
    await presses.press(press)
    await robot.probe.at_rest()
    return await robot.travelled() - before_m


async def _while_stopping(robot: RobotUnderTest, presses: PressLog, press: Press) -> None:
    """Press while the body ramps down because control has died."""
    probe = robot.probe
    await robot.until_driving(room=0.8)
    pid = robot.kill("control")
    await until(lambda: probe.state.gate.mode != "enabled", "it stops", within_s=5.0)
    await presses.press(press)
    await robot.until_restarted("control", pid)


async def _confirmed_while_frozen(robot: RobotUnderTest) -> int:
    """Count confirmations of an e-stop while the driver is frozen."""
    robot.freeze("driver")
    bus = robot.probe.bus
    try:
        replies: list[Any] = await bus.ask(ESTOP, EstopRequest(source="suite"), timeout_s=0.5)
    except GigabrainError:
        replies = []
    robot.thaw()
    return len(replies)


@asynccontextmanager
async def _publishing(
    robot: RobotUnderTest, topic: Topic[Any], message: Message, period_s: float
) -> AsyncIterator[None]:
    """Publish a message again and again while the block runs."""

    async def publish() -> None:
        while True:
            robot.probe.bus.publish(topic, message)
            await asyncio.sleep(period_s)

    task = asyncio.create_task(publish())
    try:
        yield
    finally:
        task.cancel()


@fault_row(
    44, "sim", WRONGLY_RELEASED.at_most(0), MOVED_LATCHED.at_most(0.005), FIRST_SPEED.at_most(0.02)
)
async def release_and_re_enable(rig: Rig) -> Measured:
    """Release too early, with an old generation, twice at once; enable with a joystick held."""
    robot = await rig.robot("sim")
    probe, wrong = robot.probe, 0
    await robot.until_driving(room=0.8)
    await robot.operator.estop("fault suite")
    generation = probe.state.gate.estop_generation
    wrong += await _released(robot, generation)  # while it still moves
    await robot.operator.estop("fault suite")
    await until(lambda: probe.state.gate.estop_generation > generation, "the press is counted")
    async with _publishing(robot, TELEOP, Twist(linear_x=0.2), JOYSTICK_S):
        await probe.at_rest(30)
        rest_m = await robot.travelled()
        wrong += await _released(robot, generation)  # of an older stop
        await probe.ticks(25)
        newest = probe.state.gate.estop_generation
        await asyncio.gather(_released(robot, newest), _released(robot, newest))
        await probe.ticks(50)
        if probe.state.gate.mode != "idle":
            raise Failed(f"the gate is {probe.state.gate.mode} after a release")
        moved_m = await robot.travelled() - rest_m
        await probe.enable_brain()
        speed = await _first_speed(robot)
    await probe.ticks(20)  # teleop commands stay valid for a moment after the last
    await probe.enable_brain()
    return {WRONGLY_RELEASED: wrong, MOVED_LATCHED: moved_m, FIRST_SPEED: speed}


async def _released(robot: RobotUnderTest, generation: int) -> bool:
    """Ask for a release; return whether it was granted."""
    request = ReleaseRequest(estop_generation=generation, source="suite")
    try:
        replies = await robot.probe.bus.ask(RELEASE, request)
    except Refused:
        return False
    return any(reply.ok for reply in replies)


async def _first_speed(robot: RobotUnderTest) -> float:
    """Return the greatest speed in the first 100 ms after an enable [m/s]."""
    probe = robot.probe
    await until(lambda: probe.state.gate.mode == "enabled", "it is enabled")
    await probe.ticks(2 * CALM_TICKS)
    enabled = itertools.takewhile(lambda s: s.gate.mode == "enabled", reversed(probe.states))
    states = list(enabled)[::-1]
    first = [s for s in states if s.tick - states[0].tick <= CALM_TICKS]
    return max(abs(state.velocity.linear_x) for state in first)
