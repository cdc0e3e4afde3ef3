"""Source for Slamtec RPLIDARs: identifies and starts them, and restarts them after silence."""

import asyncio
import logging
import time
from typing import Literal, NamedTuple

import serial

from gigabrain_drivers.driver.robot import ScanOptions
from gigabrain_drivers.lidars.rplidar import protocol as rplidar
from gigabrain_drivers.lidars.rplidar.protocol import (
    Answer,
    Health,
    Info,
    RequestDecoder,
    describe_request,
)
from gigabrain_drivers.lidars.rplidar.scan_formats import FORMATS, Samples
from gigabrain_drivers.lidars.serial_source import CHECK_PERIOD_NS, SerialSource
from gigabrain_drivers.links.frames import Spelling, Wording
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.clock import Clock

log = logging.getLogger(__name__)

ANSWER_TIMEOUT_S = 0.5
SPIN_UP_TIMEOUT_NS = 4_000_000_000  # from the request to scan to the first sample
INFO_BYTES = 27  # size of the answer with its descriptor
SAMPLE_TIMEOUT_NS = 1_000_000_000  # the lidar is started again after this time without samples
PWM = 660  # of 1023, the vendor's usual motor power
STOP_S = 0.1  # pause after a stop request, as in the vendor's SDK
RESET_S = 2.0
PWM_FAMILIES = range(2, 6)  # may be on an accessory board that powers the motor
CONF_FIRMWARE = (1, 24)  # first firmware that reports its scan modes,
CONF_FAMILY = 4  # except from this family on, where all do
EXPRESS_FIRMWARE = (1, 17)  # first firmware with the express mode


ModelName = Literal["auto", "a1", "a2m8", "a2m12", "a3", "c1", "s1", "s2", "s3"]
ScanMode = Literal["auto", "standard", "express", "dense"]

BAUDS = (115_200, 460_800, 1_000_000, 256_000)
FAMILIES = {1: "A1", 2: "A2", 3: "A3", 4: "C1", 6: "S1", 7: "S2", 8: "S3"}
KINDS = {"standard": rplidar.STANDARD, "express": rplidar.EXPRESS, "dense": rplidar.DENSE}


class RplidarOptions(ScanOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The RPLIDAR's part of a robot's file."""

    model: ModelName = "auto"  # sets the baud rate; auto tries all
    scan_mode: ScanMode = "auto"  # auto: the lidar's typical mode, if it is one of the other three


class StartupError(Exception):
    """The reason in one line why the lidar does not scan."""


class ModelFigures(NamedTuple):
    """Baud rate and family of a model."""

    baud: int
    family: int  # high nibble of the reported model


MODELS = {
    "a1": ModelFigures(115_200, 1),
    "a2m8": ModelFigures(115_200, 2),
    "a2m12": ModelFigures(256_000, 2),
    "a3": ModelFigures(256_000, 3),
    "c1": ModelFigures(460_800, 4),
    "s1": ModelFigures(256_000, 6),
    "s2": ModelFigures(1_000_000, 7),
    "s3": ModelFigures(1_000_000, 8),
}


async def start(lidar: "Rplidar", scan_mode: str) -> None:
    """Start a stream of samples, from any state of the lidar. Raises StartupError.

    The order of requests is that of the vendor's SDK.
    """
    await _stop(lidar)
    info = Info.read(await lidar.ask(rplidar.request(rplidar.GET_INFO), rplidar.INFO))
    lidar.identified(info, pwm=await _has_board(lidar, info))
    await _check_health(lidar)
    lidar.motor(on=True)
    await _stop(lidar)
    kind, mode = await choose_mode(lidar, info, scan_mode)
    if kind == rplidar.STANDARD:
        lidar.send(rplidar.request(rplidar.SCAN))
    else:
        lidar.send(rplidar.express_request(mode))


async def choose_mode(lidar: "Rplidar", info: Info, scan_mode: str) -> tuple[int, int]:
    """Return the answer type and number of the scan mode to use. Raises StartupError.

    `auto` is the lidar's typical mode, or the fastest one that this source can decode.
    """
    if info.firmware < CONF_FIRMWARE and info.model >> 4 < CONF_FAMILY:
        return _old_mode(info, scan_mode), 0
    wanted = set(FORMATS) if scan_mode == "auto" else {KINDS[scan_mode]}
    typical = _unsigned(await _read_conf(lidar, rplidar.MODE_TYPICAL))
    kind = await _answer_type(lidar, typical)
    if kind in wanted:
        return kind, typical
    candidates = []
    for mode in range(_unsigned(await _read_conf(lidar, rplidar.MODE_COUNT))):
        if (kind := await _answer_type(lidar, mode)) in wanted:
            period = _unsigned(await _read_conf(lidar, rplidar.MODE_MICROSECONDS, mode))
            candidates.append((period, kind, mode))
    if not candidates:
        raise StartupError(f"this RPLIDAR has no scan_mode {scan_mode!r} that is understood here")
    return min(candidates)[1:]


def _old_mode(info: Info, scan_mode: str) -> int:
    """Return the answer type for firmware that does not report its modes."""
    supported = {"standard": rplidar.STANDARD}
    if info.firmware >= EXPRESS_FIRMWARE:
        supported |= {"auto": rplidar.EXPRESS, "express": rplidar.EXPRESS}
    if scan_mode not in {*supported, "auto"}:
        version = ".".join(map(str, info.firmware))
        raise StartupError(f"this RPLIDAR's firmware {version} has no scan_mode {scan_mode!r}")
    return supported.get(scan_mode, rplidar.STANDARD)


async def _stop(lidar: "Rplidar") -> None:
    lidar.send(rplidar.request(rplidar.STOP))
    await asyncio.sleep(STOP_S)


async def _has_board(lidar: "Rplidar", info: Info) -> bool:
    if info.model >> 4 not in PWM_FAMILIES:
        return False
    try:
        flags = await lidar.ask(rplidar.request(rplidar.GET_BOARD, bytes(4)), rplidar.BOARD)
    except StartupError:  # there is no answer without a board
        return False
    return bool(flags[0] & 1)


async def _check_health(lidar: "Rplidar") -> None:
    health = Health.read(await lidar.ask(rplidar.request(rplidar.GET_HEALTH), rplidar.HEALTH))
    if health.status == 2:
        lidar.send(rplidar.request(rplidar.RESET))
        await asyncio.sleep(RESET_S)
        raise StartupError(
            f"the RPLIDAR has stopped to protect itself, code {health.code}; was reset"
        )


async def _answer_type(lidar: "Rplidar", mode: int) -> int:
    return (await _read_conf(lidar, rplidar.MODE_ANSWER, mode))[0]


async def _read_conf(lidar: "Rplidar", key: int, mode: int | None = None) -> bytes:
    """Return the value of a setting, at least one byte. Raises StartupError."""
    data = await lidar.ask(rplidar.conf_request(key, mode), rplidar.CONF)
    if int.from_bytes(data[:4], "little") != key or len(data) < 5:
        raise StartupError(f"the RPLIDAR does not report setting 0x{key:02x}")
    return data[4:]


def _unsigned(data: bytes) -> int:
    return int.from_bytes(data, "little")


class Rplidar(SerialSource):
    """An RPLIDAR of the A, C or S series.

    Its 0 mm means free space, or an object that it cannot measure. If that matters, set
    `no_return: unknown` in the body's file.
    """

    Options = RplidarOptions
    name = "RPLIDAR"

    def __init__(self, options: RplidarOptions, lidar: Lidar, clock: Clock) -> None:
        model = MODELS.get(options.model)
        self._bauds = [model.baud] if model else list(BAUDS)
        self._decoder = rplidar.RplidarDecoder()
        super().__init__(options, lidar, clock, self._bauds[0], self._decoder)
        self.link.on_lost = self._lost
        self.link.wording = Wording(
            Spelling(RequestDecoder().feed, describe_request),
            Spelling(rplidar.RplidarDecoder().feed, rplidar.describe),
        )
        self._connected = asyncio.Event()
        self._asked: tuple[int, asyncio.Future[bytes]] | None = None  # type and awaited answer
        self._failure = self._other_lidar = ""
        self._samples_ns = 0
        self._info: Info | None = None
        self._pwm = False  # True if an accessory board powers its motor

    def connected(self) -> None:
        """Let `run` start the lidar."""
        self._connected.set()

    def received(self, data: bytes) -> None:
        """Decode answers and samples; keep partial ones."""
        now_ns = self.clock.now_ns()
        for item in self._decoder.feed(data):
            self.understood = True
            if isinstance(item, Samples):
                self._samples_ns = now_ns
                scan = self.turn.add_samples(*item, now_ns)
                self.emit_scan(scan)
            elif self._asked and self._asked[0] == item.kind and not self._asked[1].done():
                self._asked[1].set_result(item.data)

    def explain(self) -> str:
        """Return why the last start-up failed."""
        return self._failure or super().explain()

    def explain_silence(self) -> str:
        """Return one text for all tried baud rates, so that it is logged once."""
        model = self.options.model
        if model != "auto":
            return f"{super().explain_silence()} (model: {model})"
        self._other_lidar = self.other_lidar() or self._other_lidar
        guess = f"it looks like {self._other_lidar}" if self._other_lidar else "is it powered?"
        bauds = ", ".join(map(str, BAUDS))
        return f"no {self.name} answers on {self.link} at any of {bauds} baud: {guess}"

    def probe(self, port: serial.Serial) -> bool:
        """Return whether an RPLIDAR answers on this port, at any baud rate of the model."""
        for baud in self._bauds:
            port.baudrate = baud
            if is_rplidar(port):
                self._set_baud(baud)
                return True
        return False

    async def run(self) -> None:
        """Start the lidar, and restart it after silence; until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._keep_scanning())
            async for now_ns in self.clock.every(CHECK_PERIOD_NS):
                self.watch_scans(now_ns)

    def send_stop(self) -> bool:
        """Stop measuring and turning."""
        self.send(rplidar.request(rplidar.STOP))
        self.motor(on=False)
        return True

    # For `start`.

    def send(self, data: bytes) -> None:
        """Send a request if the line is open; its answer begins with a descriptor."""
        self._decoder.clear()
        self.link.write(data)

    async def ask(self, request: bytes, kind: int) -> bytes:
        """Return the answer to a request. Raises StartupError."""
        future: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._asked = kind, future
        self.send(request)
        try:
            async with asyncio.timeout(ANSWER_TIMEOUT_S):
                return await future
        except TimeoutError:
            if self.understood:
                raise StartupError(
                    f"the {self.name} on {self.link} does not answer request {request.hex(' ')}"
                ) from None
            raise StartupError(self.explain_silence()) from None
        finally:
            self._asked = None

    def motor(self, *, on: bool) -> None:
        """Switch the motor by the DTR line (cleared: it turns), and by PWM or speed."""
        self.link.set_dtr(not on)
        family = self._info.model >> 4 if self._info else 0
        if self._pwm:
            self.send(rplidar.request(rplidar.SET_PWM, (on * PWM).to_bytes(2, "little")))
        elif family >= 6:
            rpm = on * round(60 * self.lidar.rate_hz)
            self.send(rplidar.request(rplidar.SET_SPEED, rpm.to_bytes(2, "little")))

    def identified(self, info: Info, *, pwm: bool) -> None:
        """Store the lidar's identity, and log it if it is new."""
        if self._info != info:
            major, minor = info.firmware
            model = FAMILIES.get(info.model >> 4, f"model 0x{info.model:02x}")
            log.info("RPLIDAR %s on %s, firmware %d.%02d", model, self.link, major, minor)
            expected = MODELS.get(self.options.model)
            if expected and expected.family != info.model >> 4:
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
            except StartupError as error:
                self._failure = str(error)
                self._next_baud()
                self.link.drop(self._failure)

    async def _follow(self, connection: int) -> None:
        """Return when the connection is lost. Raises StartupError when samples stop."""
        limit, began_ns = SPIN_UP_TIMEOUT_NS, self.clock.now_ns()
        async for now_ns in self.clock.every(CHECK_PERIOD_NS):
            if not self.link.connected or self.link.reconnects != connection:
                return
            if self._samples_ns > began_ns:
                limit, self._failure = SAMPLE_TIMEOUT_NS, ""
            if now_ns - max(self._samples_ns, began_ns) > limit:
                raise StartupError(f"the {self.name} on {self.link} answered, but sends no samples")

    def _next_baud(self) -> None:
        """Try the next baud rate, if the model is not known and no data were valid."""
        if not self.understood:
            self._set_baud(self._bauds[1 % len(self._bauds)])

    def _set_baud(self, baud: int) -> None:
        at = self._bauds.index(baud)
        self._bauds = self._bauds[at:] + self._bauds[:at]
        self.baud = self.link.baud = baud

    def _lost(self, why: str) -> None:
        self._connected.clear()
        if self._asked and not self._asked[1].done():
            self._asked[1].set_exception(StartupError(why))


def is_rplidar(port: serial.Serial) -> bool:
    """Return whether an RPLIDAR answers at the port's baud rate."""
    port.write(rplidar.request(rplidar.STOP))
    time.sleep(STOP_S)
    port.reset_input_buffer()
    port.write(rplidar.request(rplidar.GET_INFO))
    found = rplidar.RplidarDecoder().feed(port.read(INFO_BYTES))
    return any(isinstance(item, Answer) for item in found)
