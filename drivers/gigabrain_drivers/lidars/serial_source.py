"""Lidars on a serial port: what they share, whatever their protocol."""

import abc
import asyncio
import contextlib
import logging
import re
from typing import Any, ClassVar, Protocol

import serial

from gigabrain_drivers.lidars.base import SampleBuffer, ScanSource
from gigabrain_drivers.lidars.ld import protocol as ld
from gigabrain_drivers.links.serial_link import SerialLink
from gigabrain_schemas.body import Lidar, LinkHealth
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.clock import Clock

log = logging.getLogger(__name__)

_LDS01 = re.compile(rb"\xfa[\xa0-\xdb].{40}\xfa[\xa0-\xdb]", re.DOTALL)
_COIN_D4 = re.compile(rb"\xaa\x55.{8}", re.DOTALL)

CHECK_PERIOD_NS = 100_000_000  # between two checks for scans
LOG_AFTER_NS = 2_000_000_000  # without a scan, until it is logged
REOPEN_NS = 5_000_000_000  # without a scan, until the port is reopened
GATHER_S = 0.01  # a turn takes ten times as long; its bytes come hundreds of times a second
GATHER_BAUD = 460_800  # what comes faster fills the 4 KB of a port too soon
FLUSH_S = 0.02
KEPT_BYTES = 256  # bytes, kept to say what else may be sending there


def identify_lidar(data: bytes) -> str:
    """Return the known lidar that sends such bytes, or an empty text."""
    if ld.LdDecoder().feed(data):
        return "an LDROBOT lidar (ld06, ld19, lds02)"
    if _LDS01.search(data):
        return "an LDS-01"
    if b"\xa5\x5a" in data:
        return "an RPLIDAR"
    if _COIN_D4.search(data):
        return "an LDS-03 or a YDLIDAR"
    return ""


class StreamDecoder(Protocol):
    """A decoder of what comes from a lidar."""

    errors: int  # how often something was thrown away

    def clear(self) -> None:
        """Forget what has begun to come in."""


class SerialSource(ScanSource):
    """Keeps its port open. Logs once why there are no scans, and once that they come again.

    A subclass sets `understood` when what came since the port was opened makes sense.
    """

    name: ClassVar[str]  # as people call it

    def __init__(
        self, options: Any, lidar: Lidar, clock: Clock, baud: int, decoder: StreamDecoder
    ) -> None:
        super().__init__(options, lidar, clock)
        self.baud, self._stream = baud, decoder
        self.understood = False
        self.link = SerialLink(options.port, baud, clock, probe=self.probe)
        self.link.on_bytes, self.link.on_open = self._on_bytes, self._on_open
        self.turn = SampleBuffer(lidar)
        self._newest = b""
        self._scan_ns = self._opened_ns = 0
        self._problem = ""
        self._task: asyncio.Task[None] | None = None

    @abc.abstractmethod
    def received(self, data: bytes) -> None:
        """Handle bytes from the lidar."""

    @abc.abstractmethod
    def connected(self) -> None:
        """Prepare for a newly opened port: nothing from before counts."""

    @abc.abstractmethod
    def probe(self, port: serial.Serial) -> bool:
        """Return whether the right lidar is on this port. In a thread; may raise OSError."""

    def open(self) -> None:
        """Connect in the background."""
        if self._task is None:
            self._scan_ns = self._opened_ns = self.clock.now_ns()
            self._problem = ""
            self.link.open()
            self._task = asyncio.create_task(self.run(), name=self.name)

    async def close(self) -> None:
        """Bring the lidar to rest and free the port."""
        task, self._task = self._task, None
        if task:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        if self.link.connected and self.send_stop():
            await asyncio.sleep(FLUSH_S)  # closing throws away what is not sent by then
        await self.link.close()

    @property
    def health(self) -> LinkHealth:
        """The line's state; connected means that scans come."""
        line = self.link.health
        return LinkHealth(
            connected=line.connected and not self.problem,
            age_ms=line.age_ms,
            errors=line.errors,
            reconnects=line.reconnects,
        )

    @property
    def problem(self) -> str:
        """The reason why there are no scans; empty while they come, and for 2 s without."""
        return self._problem

    async def run(self) -> None:
        """Watch the line until cancelled."""
        async for now_ns in self.clock.every(CHECK_PERIOD_NS):
            self.watch_scans(now_ns)
            if self.link.connected and now_ns - max(self._scan_ns, self._opened_ns) > REOPEN_NS:
                self._opened_ns = now_ns
                self.link.drop(self._problem)

    def watch_scans(self, now_ns: int) -> None:
        """Find out why there are no scans, and log it when that has changed."""
        before = self._problem
        self._problem = ""
        if now_ns - self._scan_ns > LOG_AFTER_NS:
            self._problem = self.explain() if self.link.connected else self.link.problem
        if self._problem and self._problem != before:
            log.warning("%s: %s", self.name, self._problem)
        elif before and not self._problem:
            log.info("%s: scans are back", self.name)

    def explain(self) -> str:
        """Return why there are no scans though the port is open."""
        if not self.understood:
            return self.explain_silence()
        return f"the {self.name} on {self.link} answers, but does not turn"

    def send_stop(self) -> bool:
        """Send the lidar to rest before its port is closed; return whether bytes were sent."""
        return False

    def explain_silence(self) -> str:
        """Return what may be wrong where bytes make no sense, or none come at all."""
        where = f"{self.link} at {self.baud} baud"
        if not self._newest:
            return f"no data comes from {where}: is the {self.name} powered, and wired both ways?"
        other = self.other_lidar()
        guess = f"it looks like {other}" if other else "another lidar, or another baud rate?"
        return f"{where} sends no {self.name} data: {guess}"

    def other_lidar(self) -> str:
        """Return the name of another lidar that sends such bytes, or an empty text."""
        return identify_lidar(self._newest)

    def emit_scan(self, scan: LaserScan | None) -> None:
        """Emit the scan of a turn that has ended, if it is one."""
        if scan:
            self._scan_ns = self.clock.now_ns()
            self.emit(scan)

    def _on_open(self) -> None:
        self._opened_ns = self.clock.now_ns()
        self.link.gather_s = GATHER_S if self.link.baud <= GATHER_BAUD else 0.0
        self._newest, self.understood = b"", False
        self._stream.clear()
        self.turn.clear()
        self.connected()

    def _on_bytes(self, data: bytes) -> None:
        self._newest = (self._newest + data)[-KEPT_BYTES:]
        self.received(data)
        self.link.errors = self._stream.errors
