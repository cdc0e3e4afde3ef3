"""An e-stop button on a USB-serial adapter: a normally closed contact between its TX and RX."""

import asyncio
import logging
from collections.abc import Callable

from gigabrain_drivers.echo_loop import EchoLoop
from gigabrain_drivers.links.serial_link import SerialLink
from gigabrain_schemas.safety import ButtonState
from gigabrain_schemas.topics import BUTTON, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.estop import press
from gigabrain_zenoh.config.settings import ButtonConfig
from gigabrain_zenoh.errors import NotConfirmed

log = logging.getLogger(__name__)

BAUD = 115_200
PERIOD_NS = 20_000_000  # between two questions
TELL_EVERY = 2  # of them: 25 times a second
START_NS = 1_000_000_000  # for the port to open and the first echo, in which nothing is said
AGAIN_S = 0.1  # between two looks at whether the robot is latched


class Button:
    """Sends, listens, and says on `robot/button` what it knows of the contact."""

    def __init__(self, config: ButtonConfig, bus: Bus) -> None:
        self._bus, self._loop = bus, EchoLoop()
        self._link = SerialLink(config.port, BAUD, bus.clock)
        self._link.on_open = self._loop.opened
        self._link.on_bytes = lambda data: self._loop.heard(data, bus.clock.now_ns())
        self._states = bus.latest(STATE)
        self._problem: str | None = None  # not known yet
        self._began_ns = bus.clock.now_ns()
        self._pressed = asyncio.Event()

    async def run(self, ready: Callable[[], None]) -> None:
        """Until cancelled."""
        self._link.open()
        ready()
        try:
            async with asyncio.TaskGroup() as tasks:  # an error in either ends both
                tasks.create_task(self._press())
                await self._watch()
        finally:
            await self._link.close()

    async def _watch(self) -> None:
        count = 0
        async for now_ns in self._bus.clock.every(PERIOD_NS):
            self._link.write(self._loop.question(now_ns))
            changed = self._look(now_ns)
            count += 1
            if self._problem is not None and (changed or count % TELL_EVERY == 0):
                state = ButtonState(pressed=bool(self._problem), text=self._problem[:500])
                self._bus.publish(BUTTON, state)

    def _look(self, now_ns: int) -> bool:
        """Whether what is known of the contact has changed."""
        before, now = self._problem, self._problem_at(now_ns)
        starting = before is None and now_ns - self._began_ns < START_NS
        if now == before or (starting and now):
            return False
        self._problem = now
        if self._problem:
            log.warning("e-stop button pressed: %s", self._problem)
            self._pressed.set()
        else:
            log.info("e-stop button let go: the contact is closed")
            self._pressed.clear()
        return True

    def _problem_at(self, now_ns: int) -> str:
        if not self._link.connected:
            return self._link.problem
        return self._loop.problem(now_ns)

    async def _press(self) -> None:
        """For as long as the contact is open the robot has to be latched."""
        while True:
            await self._pressed.wait()
            state = self._states.fresh()
            if state is None or state.gate.mode != "latched":
                try:
                    reply = await press(self._bus, self._problem or "")
                    log.info("%s: %s", reply.robot_type, reply.text)
                except NotConfirmed as error:
                    log.error("%s", error)
            await asyncio.sleep(AGAIN_S)


async def run(config: ButtonConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Watch one button until the process ends."""
    await Button(config, bus).run(ready)
