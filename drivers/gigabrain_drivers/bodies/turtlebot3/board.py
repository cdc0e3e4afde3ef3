"""The OpenCR board on its line: who answers there, and how old what it says is."""

import asyncio
import contextlib
import logging
from collections.abc import Callable

import serial
from msgspec.structs import replace

from gigabrain_drivers.bodies.turtlebot3 import dynamixel
from gigabrain_drivers.bodies.turtlebot3 import protocol as opencr
from gigabrain_drivers.bodies.turtlebot3.protocol import Readings
from gigabrain_drivers.links.link import Link
from gigabrain_drivers.links.wording import Spelling, Wording
from gigabrain_schemas.body import LinkHealth
from gigabrain_zenoh.clock import Clock

log = logging.getLogger(__name__)

LOST_NS = 100_000_000  # without an answer it counts as lost,
GIVE_UP_NS = 160_000_000  # and then its line is closed, with all that is still queued in it
KNOCK_NS = 100_000_000  # between two attempts to get an answer at all
PATIENCE_NS = 1_000_000_000  # for the first answer, until the port is opened anew
SETTLE_NS = 500_000_000  # after which a problem is spoken of
ANSWER_S = 0.01  # how long the answer to a question is waited for
ANSWER_BYTES = 14  # of the answer to a ping
WATCHDOG_FIRMWARE = 5  # before that, the byte of the debug mode was part of a clock


class Board:
    """Each question carries a new heartbeat, and its answer brings that back.

    So a late answer is never taken for a fresh one; and nothing counts that came before the answer
    to the first ping on a newly opened port. Every connection begins with zero velocity.
    """

    def __init__(self, link: Link, clock: Clock) -> None:
        self.link = link
        self.link.on_open, self.link.on_lost = self._opened, self._lost
        self.link.on_bytes = self._take
        self.link.wording = Wording(
            Spelling(dynamixel.Decoder().feed, opencr.describe),
            Spelling(dynamixel.Decoder().feed, opencr.describe),
        )
        self.on_readings: Callable[[Readings], None] = _ignore  # set by the owner
        self._clock = clock
        self._decoder = dynamixel.Decoder()
        self._firmware: int | None = None  # of the board that has answered since the port was open
        self._beat = 0
        self._answered = asyncio.Event()
        self._opened_ns = self._knocked_ns = self._asked_ns = self._fresh_ns = clock.now_ns()
        self._waiting_ns: int | None = None  # since when questions have been without an answer
        self._newest: Readings | None = None
        self._complaint = "not there yet"
        self._well_ns = clock.now_ns()

    @property
    def ready(self) -> bool:
        """Whether commands reach an OpenCR."""
        return self._firmware is not None

    @property
    def health(self) -> LinkHealth:
        """Connected means that it answers; the age is that of what it answered last."""
        age_ns = self._clock.now_ns() - self._fresh_ns
        return replace(
            self.link.health,
            connected=self.ready and age_ns <= LOST_NS and not self._fault(),
            age_ms=age_ns / 1e6,
            late_ms=0.0,  # an answer that is late is thrown away
        )

    @property
    def problem(self) -> str:
        """In one line why the body cannot be driven, or an empty text."""
        if self.link.problem:
            return self.link.problem
        if not self.ready:
            return f"{self.link} is open, but no OpenCR answers: right port, power on?"
        return self._fault()

    def halt(self) -> bool:
        """Zero velocity, whoever may be listening."""
        return self.link.write(opencr.velocity(0.0, 0.0).frame)

    def let_go(self) -> bool:
        """Motors without torque, until the driver finds the board again."""
        return self.link.write(opencr.torque(on=False))

    def drive(self, linear_x: float, angular_z: float) -> tuple[float, float]:
        """Send a velocity [m/s], [rad/s]; returns what was really sent."""
        sent = opencr.velocity(linear_x, angular_z)
        if self.ready and self.link.write(sent.frame):
            return sent.linear_x, sent.angular_z
        return 0.0, 0.0

    async def ask(self, patience_s: float = ANSWER_S) -> None:
        """Fetch the table and wait for it; `on_readings` gets it, now or a little later."""
        if not self.ready:
            return
        self._beat = self._beat + 1 & 0xFF
        self._asked_ns = self._clock.now_ns()
        self._waiting_ns = self._waiting_ns or self._asked_ns
        self._answered.clear()
        if self.link.write(opencr.heartbeat(self._beat) + opencr.ask()):
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(patience_s):
                    await self._answered.wait()

    def look(self, now_ns: int) -> None:
        """To be called often: knocks where nobody has answered, gives up where nobody will."""
        self._speak_up(now_ns)
        if not self.link.connected:
            return
        if self._waiting_ns and now_ns - self._waiting_ns > GIVE_UP_NS:
            self.link.drop("the OpenCR has stopped answering")
        elif not self.ready and now_ns - self._opened_ns > PATIENCE_NS:
            self.link.drop(self.problem)
        elif not self.ready and now_ns - self._knocked_ns >= KNOCK_NS:
            self._knock()

    def _speak_up(self, now_ns: int) -> None:
        """A problem that stays is logged once when it begins and once when it ends."""
        problem, before = self.problem, self._complaint
        if not problem:
            self._well_ns = now_ns
        elif now_ns - self._well_ns < SETTLE_NS:
            return
        if problem == before:
            return
        self._complaint = problem
        if problem:
            log.warning("%s", problem)
        else:
            log.info("OpenCR on %s answers, firmware %s", self.link, self._firmware)

    def _fault(self) -> str:
        """What the board itself says is wrong with it."""
        newest = self._newest
        if newest and newest.device_status == opencr.MOTORS_SILENT:
            return "OpenCR reaches no motors: switch their power on, then press its reset button"
        if newest and newest.watchdog_off and (self._firmware or 0) >= WATCHDOG_FIRMWARE:
            return "OpenCR is in debug mode, in which it does not stop by itself: restart it"
        return ""

    def _opened(self) -> None:
        self._decoder.clear()
        self._firmware = self._waiting_ns = None
        self._opened_ns = self._clock.now_ns()
        self._knock()

    def _lost(self, _why: str) -> None:
        self._firmware = self._waiting_ns = None

    def _knock(self) -> None:
        """Ask who is there; zero goes first, and so ends whatever may still be queued there."""
        self._knocked_ns = self._clock.now_ns()
        self.halt()
        self.link.write(dynamixel.ping(opencr.ID))

    def _take(self, data: bytes) -> None:
        for packet in self._decoder.feed(data):
            if packet.id != opencr.ID or packet.instruction != dynamixel.STATUS:
                continue
            answer = packet.params[1:]
            if model := opencr.model_of(answer):
                self._recognise(*model)
            elif self.ready and len(answer) == opencr.LENGTH:
                self._read(opencr.readings(answer))
        self.link.errors = self._decoder.errors

    def _recognise(self, model: int, firmware: int) -> None:
        if model != opencr.MODEL:
            self.link.drop(f"{self.link} leads to a Dynamixel of model {model}, not to an OpenCR")
        elif not self.ready:
            self._firmware = firmware
            self.halt()
            self.link.write(opencr.torque(on=True))

    def _read(self, now: Readings) -> None:
        if now.heartbeat != self._beat:  # the answer to a question that was given up
            return
        self._fresh_ns, self._waiting_ns, self._newest = self._asked_ns, None, now
        self.on_readings(now)
        self._answered.set()


def is_opencr(port: serial.Serial) -> bool:
    """Whether an OpenCR answers on this port. Runs in a thread; may raise OSError."""
    port.write(dynamixel.ping(opencr.ID))
    answers = dynamixel.Decoder().feed(port.read(ANSWER_BYTES))
    models = [opencr.model_of(packet.params[1:]) for packet in answers]
    return any(model is not None and model[0] == opencr.MODEL for model in models)


def _ignore(_: Readings) -> None:
    pass
