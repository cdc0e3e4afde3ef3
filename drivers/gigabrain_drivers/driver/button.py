"""An e-stop button on a USB-serial adapter: a normally closed contact between its TX and RX."""

import asyncio
import logging
import os
from collections import deque
from collections.abc import Callable

from gigabrain_drivers.links.serial_link import SerialLink
from gigabrain_schemas.base import Cause
from gigabrain_schemas.safety import ButtonState
from gigabrain_schemas.topics import BUTTON, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.requests import press_estop
from gigabrain_zenoh.config.settings import ButtonConfig
from gigabrain_zenoh.errors import NotConfirmed
from gigabrain_zenoh.gate import causes as why

log = logging.getLogger(__name__)

ECHO_TIMEOUT_NS = 200_000_000  # later echoes are ignored
PROBE_BYTES = 2  # random, so that an echo cannot be guessed or be an old one

BAUD = 115_200
PERIOD_NS = 20_000_000  # between two probes
PUBLISH_EVERY = 2  # probes: 25 times a second
STARTUP_NS = 1_000_000_000  # an open contact is not published before, as the port opens
RECHECK_S = 0.1  # period of checking that the robot is latched


class EchoLoop:
    """Sends random bytes from TX, through a normally closed contact, back to RX.

    With an open contact, a broken wire or no adapter, no bytes come back. With a short circuit to
    another sender, wrong bytes come back.
    """

    def __init__(self, random: Callable[[int], bytes] = os.urandom) -> None:
        self._random = random
        self._expected: deque[tuple[int, int]] = deque()  # byte, sent at [ns]
        self._good_ns: int | None = None  # when the newest echoed byte was sent
        self._ignored_until_ns = 0

    def opened(self) -> None:
        """Forget all bytes: the line was opened again."""
        self._expected.clear()
        self._good_ns = None

    def next_bytes(self, now_ns: int) -> bytes:
        """Return the bytes to send now."""
        if now_ns < self._ignored_until_ns:
            return b""
        while self._expected and now_ns - self._expected[0][1] > ECHO_TIMEOUT_NS:
            self._expected.popleft()
        data = self._random(PROBE_BYTES)
        self._expected.extend((byte, now_ns) for byte in data)
        return data

    def check_echo(self, data: bytes, now_ns: int) -> None:
        """Check received bytes. After a wrong one, all are ignored until the line is quiet."""
        for byte in data:
            if now_ns < self._ignored_until_ns:
                return
            expected, sent_ns = self._expected.popleft() if self._expected else (None, 0)
            if byte != expected:
                self._ignored_until_ns, self._good_ns = now_ns + ECHO_TIMEOUT_NS, None
                self._expected.clear()
            elif now_ns - sent_ns <= ECHO_TIMEOUT_NS:
                self._good_ns = sent_ns

    def problem(self, now_ns: int) -> str:
        """Return why the contact counts as open; empty if it is closed."""
        if now_ns < self._ignored_until_ns:
            return "other bytes come back than were sent"
        if self._good_ns is None or now_ns - self._good_ns > ECHO_TIMEOUT_NS:
            return "the contact is open, or its wire is broken"
        return ""


class Button:
    """Probes the contact, and publishes its state on `robot/button`."""

    def __init__(self, config: ButtonConfig, bus: Bus) -> None:
        self._bus, self._loop = bus, EchoLoop()
        self._link = SerialLink(config.port, BAUD, bus.clock)
        self._link.on_open = self._loop.opened
        self._link.on_bytes = lambda data: self._loop.check_echo(data, bus.clock.now_ns())
        self._states = bus.latest(STATE)
        self._problem: str | None = None  # None: not known yet
        self._began_ns = bus.clock.now_ns()
        self._pressed = asyncio.Event()

    async def run(self, ready: Callable[[], None]) -> None:
        """Watch the contact until cancelled."""
        self._link.open()
        ready()
        try:
            async with asyncio.TaskGroup() as tasks:  # an error in either ends both
                tasks.create_task(self._keep_latched())
                await self._watch()
        finally:
            await self._link.close()

    async def _watch(self) -> None:
        count = 0
        async for now_ns in self._bus.clock.every(PERIOD_NS):
            self._link.write(self._loop.next_bytes(now_ns))
            changed = self._update(now_ns)
            count += 1
            if self._problem is not None and (changed or count % PUBLISH_EVERY == 0):
                state = ButtonState(pressed=bool(self._problem), text=self._problem[:500])
                self._bus.publish(BUTTON, state)

    def _update(self, now_ns: int) -> bool:
        """Update the state of the contact; return whether it changed."""
        before, now = self._problem, self._problem_at(now_ns)
        starting = before is None and now_ns - self._began_ns < STARTUP_NS
        if now == before or (starting and now):
            return False
        self._problem = now
        if self._problem:
            log.warning("e-stop button pressed: %s", self._problem)
            self._pressed.set()
        else:
            log.info("e-stop button released: the contact is closed")
            self._pressed.clear()
        return True

    def _problem_at(self, now_ns: int) -> str:
        if not self._link.connected:
            return self._link.problem
        return self._loop.problem(now_ns)

    async def _keep_latched(self) -> None:
        """Keep the robot latched while the contact is open."""
        while True:
            await self._pressed.wait()
            state = self._states.fresh()
            if state is None or state.gate.mode != "latched":
                try:
                    reply = await press_estop(self._bus, self._problem or "")
                    log.info("%s: %s", reply.robot_type, reply.text)
                except NotConfirmed as error:
                    log.error("%s", error)
            await asyncio.sleep(RECHECK_S)


async def run(config: ButtonConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Watch one button until the process ends."""
    await Button(config, bus).run(ready)


class ButtonWatch:
    """Keeps the gate closed while the button is pressed, or silent for 200 ms.

    `on_press` is called at once when it is pressed. Before its first message, the button's silence
    does not latch.
    """

    def __init__(self, bus: Bus, on_press: Callable[[str], object]) -> None:
        self._on_press = on_press
        self._pressed = self._was_seen = False
        self._newest = bus.latest(BUTTON, self._on_state)

    def faults(self) -> tuple[Cause, ...]:
        """Return the causes that forbid moving now."""
        state = self._newest.fresh()
        if state is None:
            return (why.BUTTON_LOST if self._was_seen else why.BUTTON_AWAITED,)
        self._was_seen = True
        return (why.button(state.text),) if state.pressed else ()

    def _on_state(self, state: ButtonState) -> None:
        pressed, self._pressed = self._pressed, state.pressed
        if state.pressed and not pressed:
            self._on_press(state.text)
