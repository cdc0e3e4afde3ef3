"""Base class of lidars on a serial port."""

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
LOG_AFTER_NS = 2_000_000_000  # missing scans are logged after this time
REOPEN_NS = 5_000_000_000  # the port is reopened after this time without a scan
GATHER_S = 0.01  # bytes within this time are read together; a turn takes ten times as long
MAX_GATHER_BAUD = 460_800  # at a higher rate, the port's buffer of 4 KB is full too soon
FLUSH_S = 0.02  # for the stop command, before the port is closed
MAX_KEPT_BYTES = 256  # newest bytes, from which another lidar is identified


def identify_lidar(data: bytes) -> str:
    """Return the name of a known lidar that sends such bytes, or an empty text."""
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
    """A decoder of a lidar's bytes."""

    errors: int  # number of times that bytes were dropped

    def clear(self) -> None:
        """Drop partial data."""


class SerialSource(ScanSource):
    """Keeps its port open. Logs once why there are no scans, and once that they are back.

    A subclass sets `understood` when it receives valid data; opening the port clears it.
    """

    name: ClassVar[str]  # in texts for users

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
        """Reset all state for a newly opened port."""

    @abc.abstractmethod
    def probe(self, port: serial.Serial) -> bool:
        """Return whether the right lidar is on this port. Runs in a thread; may raise OSError."""

    def open(self) -> None:
        """Connect in the background."""
        if self._task is None:
            self._scan_ns = self._opened_ns = self.clock.now_ns()
            self._problem = ""
            self.link.open()
            self._task = asyncio.create_task(self.run(), name=self.name)

    async def close(self) -> None:
        """Stop the lidar and free the port."""
        task, self._task = self._task, None
        if task:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        if self.link.connected and self.send_stop():
            await asyncio.sleep(FLUSH_S)  # closing drops unsent bytes
        await self.link.close()

    @property
    def health(self) -> LinkHealth:
        """The line's state; `connected` means that scans arrive."""
        line = self.link.health
        return LinkHealth(
            connected=line.connected and not self.problem,
            age_ms=line.age_ms,
            errors=line.errors,
            reconnects=line.reconnects,
        )

    @property
    def problem(self) -> str:
        """The reason why there are no scans; empty for the first 2 s without a scan."""
        return self._problem

    async def run(self) -> None:
        """Watch the line until cancelled."""
        async for now_ns in self.clock.every(CHECK_PERIOD_NS):
            self.watch_scans(now_ns)
            if self.link.connected and now_ns - max(self._scan_ns, self._opened_ns) > REOPEN_NS:
                self._opened_ns = now_ns
                self.link.drop(self._problem)

    def watch_scans(self, now_ns: int) -> None:
        """Update `problem`, and log it if it changes."""
        before = self._problem
        self._problem = ""
        if now_ns - self._scan_ns > LOG_AFTER_NS:
            self._problem = self.explain() if self.link.connected else self.link.problem
        if self._problem and self._problem != before:
            log.warning("%s: %s", self.name, self._problem)
        elif before and not self._problem:
            log.info("%s: scans are back", self.name)

    def explain(self) -> str:
        """Return why there are no scans although the port is open."""
        if not self.understood:
            return self.explain_silence()
        return f"the {self.name} on {self.link} answers, but does not turn"

    def send_stop(self) -> bool:
        """Stop the lidar before its port is closed; return whether bytes were sent."""
        return False

    def explain_silence(self) -> str:
        """Return the possible reasons for invalid bytes, or no bytes at all."""
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
        """Emit the scan of an ended turn, if there is one."""
        if scan:
            self._scan_ns = self.clock.now_ns()
            self.emit(scan)

    def _on_open(self) -> None:
        self._opened_ns = self.clock.now_ns()
        self.link.gather_s = GATHER_S if self.link.baud <= MAX_GATHER_BAUD else 0.0
        self._newest, self.understood = b"", False
        self._stream.clear()
        self.turn.clear()
        self.connected()

    def _on_bytes(self, data: bytes) -> None:
        self._newest = (self._newest + data)[-MAX_KEPT_BYTES:]
        self.received(data)
        self.link.errors = self._stream.errors
