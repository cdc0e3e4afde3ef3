"""Links: they send and receive bytes on a port, and reopen it after every loss."""

import abc
import asyncio
import contextlib
import logging
import os
from collections.abc import Callable
from typing import TypeVar

from gigabrain_drivers.links.frames import Wording
from gigabrain_schemas.body import LinkHealth
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)

T = TypeVar("T")
Trace = Callable[[str, bytes], None]

FIRST_RETRY_NS = 100_000_000
MAX_RETRY_NS = 1_000_000_000
AGE_CHECK_S = 0.02  # period of checking the age of the newest bytes
READ_BYTES = 65536

LOG_AFTER_NS = 500_000_000  # silence is logged after this time


class LinkProblem(Exception):
    """The reason why a port cannot be opened, as one line for users."""


class Link(abc.ABC):
    """A connection to a body. After `open`, it reconnects by itself until `close`.

    Subclasses implement the connection. All callbacks run on the loop.
    """

    quiet_ns: int | None = None  # the peer counts as lost after this time without a byte
    gather_s = 0.0  # bytes within this time are read together, to reduce wake-ups

    def __init__(self, clock: Clock) -> None:
        self.on_bytes: Callable[[bytes], None] = _ignore
        self.on_open: Callable[[], None] = _nothing
        self.on_lost: Callable[[str], None] = _ignore
        self.trace: Trace | None = None  # ("tx" or "rx", bytes)
        self.wording = Wording()  # for the debug log; set by the owner
        self.problem = "not opened"
        self.errors = 0  # frames that the owner dropped
        self.reconnects = 0
        self._clock = clock
        self._received_ns = clock.now_ns()
        self._fd: int | None = None
        self._gathering: asyncio.TimerHandle | None = None
        self._opened_once = False
        self._reported: set[str] = set()
        self._ended = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    @property
    def connected(self) -> bool:
        """True while the port is open; the body need not answer."""
        return self._fd is not None

    @property
    def fd(self) -> int | None:
        """The descriptor of the open port, for processes that share it."""
        return self._fd

    @property
    def age_ns(self) -> int:
        """Time since the newest bytes, or since the connection [ns]."""
        return self._clock.now_ns() - self._received_ns

    @property
    def health(self) -> LinkHealth:
        """The state of the link for `robot/state`."""
        return LinkHealth(
            connected=self.connected,
            age_ms=self.age_ns / 1e6,
            errors=self.errors,
            reconnects=self.reconnects,
        )

    def open(self) -> None:
        """Connect in the background, and again after every loss. Return at once."""
        if self._task is None:
            self.problem, self._received_ns = "connecting", self._clock.now_ns()
            self._task = asyncio.create_task(self._keep_open(), name=f"link {self}")

    def write(self, data: bytes) -> bool:
        """Send now or not at all; return whether all was sent. Never blocks or raises."""
        if self._fd is None:
            return False
        try:
            sent = os.write(self._fd, data)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            self.drop(describe_error(error))
            return False
        if sent < len(data):
            self._cut_short()
            return False
        self._trace("tx", data)
        return True

    def drop(self, reason: str) -> None:
        """Close the connection, discard its queued bytes, and connect again."""
        if self._fd is None:
            return
        fd, self._fd, self.problem = self._fd, None, reason
        asyncio.get_running_loop().remove_reader(fd)
        if self._gathering:
            self._gathering.cancel()
        self._shut()
        self._ended.set()
        self._call(self.on_lost, reason)

    async def close(self) -> None:
        """Close the port. May be called any number of times."""
        task, self._task = self._task, None
        if task:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        self.drop("closed")
        self.problem = "closed"

    @abc.abstractmethod
    async def _connect(self) -> int:
        """Open the port; return a non-blocking descriptor. Raises LinkProblem and OSError."""

    @abc.abstractmethod
    def _shut(self) -> None:
        """Close the port and discard unsent bytes. Never raises."""

    @abc.abstractmethod
    def _cut_short(self) -> None:
        """Discard the rest of a partial write, so that it is never sent."""

    def _trace(self, way: str, data: bytes) -> None:
        if self.trace:
            self.trace(way, data)
        if log.isEnabledFor(logging.DEBUG):
            for line in self.wording.lines(way, data):
                log.debug("%s %s", self, line)

    async def _keep_open(self) -> None:
        retry_ns = FIRST_RETRY_NS
        while True:
            try:
                fd = await self._connect()
            except Exception as error:  # noqa: BLE001 - it tries again
                self._report(error)
                self.problem = describe_error(error)
                await self._clock.sleep_ns(retry_ns)
                retry_ns = min(2 * retry_ns, MAX_RETRY_NS)
                continue
            retry_ns = FIRST_RETRY_NS
            try:
                self._attach(fd)
                await self._until_ended()
            except Exception as error:  # noqa: BLE001 - it connects again
                self._report(error)
                self.drop(describe_error(error))
            await self._clock.sleep_ns(retry_ns)

    def _call(self, callback: Callable[[T], None], value: T) -> None:
        """Call the owner; if it raises, drop the connection."""
        try:
            callback(value)
        except Exception as error:  # noqa: BLE001 - a fault of the owner must not end the link
            self._report(error)
            self.drop(f"received data could not be handled: {describe_error(error)}")

    def _report(self, error: Exception) -> None:
        """Log an exception once, if it is a programming error."""
        text = f"{type(error).__name__}: {error}"
        if not isinstance(error, (LinkProblem, OSError)) and text not in self._reported:
            self._reported.add(text)
            log.error("%s: %s", self, text, exc_info=error)

    def _attach(self, fd: int) -> None:
        self._fd, self.problem, self._received_ns = fd, "", self._clock.now_ns()
        self._ended.clear()
        self.reconnects += self._opened_once
        self._opened_once = True
        asyncio.get_running_loop().add_reader(fd, self._readable)
        self._call(lambda _: self.on_open(), None)

    async def _until_ended(self) -> None:
        if self.quiet_ns is None:
            await self._ended.wait()
        while not self._ended.is_set():
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(AGE_CHECK_S):
                    await self._ended.wait()
            if self.quiet_ns is not None and self.age_ns > self.quiet_ns:
                self.drop(f"no data for {self.quiet_ns / 1e6:.0f} ms")

    def _readable(self) -> None:
        if self._fd is None:
            return
        if not self.gather_s:
            self._read(self._fd)
            return
        asyncio.get_running_loop().remove_reader(self._fd)
        self._gather()

    def _gather(self) -> None:
        loop = asyncio.get_running_loop()
        self._gathering = loop.call_later(self.gather_s, self._gathered)

    def _gathered(self) -> None:
        """Read the waiting bytes, and gather again while bytes arrive."""
        if self._fd is None:
            return
        if self._read(self._fd):
            self._gather()
        elif self._fd is not None:
            asyncio.get_running_loop().add_reader(self._fd, self._readable)

    def _read(self, fd: int) -> bool:
        """Read once; return whether there were bytes."""
        try:
            data = os.read(fd, READ_BYTES)
        except BlockingIOError:
            return False
        except OSError as error:
            self.drop(describe_error(error))
            return False
        if not data:  # end of file: the reader would be called for ever
            self.drop("the other end is gone: unplugged?")
            return False
        self._received_ns = self._clock.now_ns()
        self._trace("rx", data)
        self._call(self.on_bytes, data)
        return True


def describe_error(error: Exception) -> str:
    """Describe an exception in words, without asyncio's prefix."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)
    return str(error) or type(error).__name__


def _ignore(_: object) -> None:
    pass


def _nothing() -> None:
    pass


class Liveness:
    """Watches whether a body still sends its reports; logs each change once.

    The body counts as lost after `silent_ns` without a message. The text `no_message` is logged if
    the line itself works. A short silence is not logged; the gate reports it.
    """

    def __init__(
        self, link: Link, clock: Clock, silent_ns: int, no_message: str, log: logging.Logger
    ) -> None:
        self._link, self._clock = link, clock
        self._silent_ns, self._no_message = silent_ns, no_message
        self._received_ns: int | None = None  # None: no message since the line was opened or lost
        self._silent_since_ns = clock.now_ns()
        self._lost = False  # True after a loss, until the next message
        self._fault = Fault(log)

    @property
    def received(self) -> bool:
        """True after the first message since the line was opened."""
        return self._received_ns is not None

    def mark_received(self) -> bool:
        """Record a message; return whether it is the first on this line, or after a loss."""
        first = self._received_ns is None or self._lost
        self._received_ns, self._lost = self._clock.now_ns(), False
        return first

    def reset(self) -> None:
        """Forget all messages, because the line is lost or new."""
        if self._received_ns is not None:
            self._received_ns, self._silent_since_ns = None, self._clock.now_ns()

    def alive(self) -> bool:
        """Return whether the newest message is recent enough."""
        silent_ns = self._clock.now_ns() - (self._received_ns or self._silent_since_ns)
        alive = self._received_ns is not None and silent_ns <= self._silent_ns
        self._lost = self._lost or not alive
        if alive:
            self._fault.end(f"{self._link}: reports again")
        elif silent_ns > LOG_AFTER_NS:
            self._fault.begin(self._problem())
        return alive

    def _problem(self) -> str:
        problem, name = self._link.problem or self._no_message, str(self._link)
        return problem if name in problem else f"{name}: {problem}"
