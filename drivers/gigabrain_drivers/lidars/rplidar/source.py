"""Slamtec's RPLIDARs: asked who they are, spun up and told to scan; again whenever silent."""

import asyncio
import logging
import time
from typing import Literal

import serial

from gigabrain_drivers.driver.robot import ScanOptions
from gigabrain_drivers.lidars.rplidar import protocol as rplidar
from gigabrain_drivers.lidars.rplidar.protocol import Answer, Info
from gigabrain_drivers.lidars.rplidar.requests import RequestDecoder, describe_request
from gigabrain_drivers.lidars.rplidar.scan_formats import Samples
from gigabrain_drivers.lidars.rplidar.startup import BAUDS, FAMILIES, MODELS, STOP_S, Trouble, start
from gigabrain_drivers.lidars.serial_source import LOOK_NS, SerialSource
from gigabrain_drivers.links.wording import Spelling, Wording
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.clock import Clock

log = logging.getLogger(__name__)

ANSWER_S = 0.5
SPIN_UP_NS = 4_000_000_000  # from the request to scan to the first sample
INFO_BYTES = 27  # its descriptor and itself
SILENT_NS = 1_000_000_000  # then it is started again
PWM = 660  # of 1023, the vendor's usual motor power

Model = Literal["auto", "a1", "a2m8", "a2m12", "a3", "c1", "s1", "s2", "s3"]
ScanMode = Literal["auto", "standard", "express", "dense"]


class RplidarOptions(ScanOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The RPLIDAR's part of a robot's file."""

    model: Model = "auto"  # says the baud rate; auto tries one after the other
    scan_mode: ScanMode = "auto"  # the lidar's own choice, where it is one of the other three


class Rplidar(SerialSource):
    """An RPLIDAR of the A, C or S series.

    A 0 in what it sends may be free space or nothing measurable: a body's file says
    `no_return: unknown` of it where that matters.
    """

    Options = RplidarOptions
    name = "RPLIDAR"

    def __init__(self, options: RplidarOptions, lidar: Lidar, clock: Clock) -> None:
        model = MODELS.get(options.model)
        self._bauds = [model.baud] if model else list(BAUDS)
        super().__init__(options, lidar, clock, self._bauds[0])
        self.link.on_lost = self._lost
        self.link.wording = Wording(
            Spelling(RequestDecoder().feed, describe_request),
            Spelling(rplidar.Decoder().feed, rplidar.describe),
        )
        self._decoder = rplidar.Decoder()
        self._connected = asyncio.Event()
        self._asked: tuple[int, asyncio.Future[bytes]] | None = None
        self._understood = False
        self._trouble = self._stranger = ""
        self._samples_ns = 0
        self._info: Info | None = None
        self._pwm = False  # whether an accessory board powers its motor

    def connected(self) -> None:
        """The start-up may begin."""
        self._decoder.clear()
        self._understood = False
        self._connected.set()

    def received(self, data: bytes) -> None:
        """Answers and samples, or parts of them."""
        now_ns = self.clock.now_ns()
        for item in self._decoder.feed(data):
            self._understood = True
            if isinstance(item, Samples):
                self._samples_ns = now_ns
                scan = self.turn.clockwise(*item, now_ns)
                self.finished(scan)
            elif self._asked and self._asked[0] == item.kind and not self._asked[1].done():
                self._asked[1].set_result(item.data)
        self.link.errors = self._decoder.errors

    def understands(self) -> bool:
        """Whether anything that came was an answer or a sample."""
        return self._understood

    def trouble(self) -> str:
        """What the last start-up failed for."""
        return self._trouble or super().trouble()

    def no_answer(self) -> str:
        """The same text for all baud rates that are tried, so that it is said once."""
        model = self.options.model
        if model != "auto":
            return f"{super().no_answer()} (model: {model})"
        self._stranger = self.stranger() or self._stranger
        guess = f"it looks like {self._stranger}" if self._stranger else "is it powered?"
        bauds = ", ".join(map(str, BAUDS))
        return f"no {self.name} answers on {self.link} at any of {bauds} baud: {guess}"

    def probe(self, port: serial.Serial) -> bool:
        """Whether an RPLIDAR answers here, at any of the baud rates that are tried."""
        for baud in self._bauds:
            port.baudrate = baud
            if answers(port):
                self._use(baud)
                return True
        return False

    async def run(self) -> None:
        """Start it, and start it again whenever it falls silent; until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._keep_scanning())
            async for now_ns in self.clock.every(LOOK_NS):
                self.look(now_ns)

    def farewell(self) -> bool:
        """Stop measuring and turning."""
        self.send(rplidar.request(rplidar.STOP))
        self.motor(on=False)
        return True

    # What the start-up needs.

    def send(self, data: bytes) -> None:
        """To the lidar, if it is there. What comes back begins with a descriptor."""
        self._decoder.clear()
        self.link.write(data)

    async def ask(self, request: bytes, kind: int) -> bytes:
        """The single answer to a request. Raises Trouble."""
        future: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._asked = kind, future
        self.send(request)
        try:
            async with asyncio.timeout(ANSWER_S):
                return await future
        except TimeoutError:
            if self._understood:
                raise Trouble(
                    f"the {self.name} on {self.link} does not answer request {request.hex(' ')}"
                ) from None
            raise Trouble(self.no_answer()) from None
        finally:
            self._asked = None

    def motor(self, *, on: bool) -> None:
        """By whatever this model has: the DTR line (cleared: it turns), PWM, or a speed."""
        self.link.set_dtr(not on)
        family = self._info.model >> 4 if self._info else 0
        if self._pwm:
            self.send(rplidar.request(rplidar.SET_PWM, (on * PWM).to_bytes(2, "little")))
        elif family >= 6:
            rpm = on * round(60 * self.lidar.rate_hz)
            self.send(rplidar.request(rplidar.SET_SPEED, rpm.to_bytes(2, "little")))

    def known(self, info: Info, *, pwm: bool) -> None:
        """It has said who it is."""
        if self._info != info:
            major, minor = info.firmware
            model = FAMILIES.get(info.model >> 4, f"model 0x{info.model:02x}")
            log.info("RPLIDAR %s on %s, firmware %d.%02d", model, self.link, major, minor)
            named = MODELS.get(self.options.model)
            if named and named.family != info.model >> 4:
                log.warning(
                    "the lidar on %s is an RPLIDAR %s, not model: %s",
                    self.link, model, self.options.model,
                )  # fmt: skip
        self._info, self._pwm = info, pwm

    async def _keep_scanning(self) -> None:
        while True:
            await self._connected.wait()
            connection = self.link.reconnects
            try:
                await start(self, self.options.scan_mode)
                await self._follow(connection)
            except Trouble as trouble:
                self._trouble = str(trouble)
                self._next_baud()
                self.link.drop(self._trouble)

    async def _follow(self, connection: int) -> None:
        """While samples come over the same connection. Raises Trouble."""
        limit, began_ns = SPIN_UP_NS, self.clock.now_ns()
        async for now_ns in self.clock.every(LOOK_NS):
            if not self.link.connected or self.link.reconnects != connection:
                return
            if self._samples_ns > began_ns:
                limit, self._trouble = SILENT_NS, ""
            if now_ns - max(self._samples_ns, began_ns) > limit:
                raise Trouble(f"the {self.name} on {self.link} answered, but sends no samples")

    def _next_baud(self) -> None:
        """Where the model is not known and nothing was understood, try the next baud rate."""
        if not self._understood:
            self._use(self._bauds[1 % len(self._bauds)])

    def _use(self, baud: int) -> None:
        at = self._bauds.index(baud)
        self._bauds = self._bauds[at:] + self._bauds[:at]
        self.baud = self.link.baud = baud

    def _lost(self, why: str) -> None:
        self._connected.clear()
        if self._asked and not self._asked[1].done():
            self._asked[1].set_exception(Trouble(why))


def answers(port: serial.Serial) -> bool:
    """Whether an RPLIDAR says who it is, at the port's present baud rate."""
    port.write(rplidar.request(rplidar.STOP))
    time.sleep(STOP_S)
    port.reset_input_buffer()
    port.write(rplidar.request(rplidar.GET_INFO))
    found = rplidar.Decoder().feed(port.read(INFO_BYTES))
    return any(isinstance(item, Answer) for item in found)
