"""Tells a service manager how this service is doing, as sd_notify(3) has it; nothing without one.

A datagram to the Unix socket named in the environment. What is started from here is not to speak in
this service's name, so the variables are taken out.
"""

import contextlib
import os
import socket
import time
from collections.abc import Callable
from typing import Self

SHARE = 0.4  # of the watchdog's time that may pass before it is fed again


class Notifier:
    """One service's word to its manager. The robot goes on where nobody listens any more."""

    def __init__(
        self,
        address: str = "",
        watchdog_s: float | None = None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._watchdog_s, self._now_s = watchdog_s, now_s
        self._fed_s: float | None = None
        self._status, self._ready = "", False

    @classmethod
    def from_environment(cls) -> Self:
        """What the service manager has left in the environment of this process."""
        address = os.environ.pop("NOTIFY_SOCKET", "")
        microseconds = os.environ.pop("WATCHDOG_USEC", "")
        meant = os.environ.pop("WATCHDOG_PID", "") or str(os.getpid())
        fed = microseconds.isdecimal() and meant == str(os.getpid())
        return cls(address, int(microseconds) / 1e6 if fed else None)

    def ready(self) -> None:
        """The service does what it is there for; said once."""
        if not self._ready:
            self._ready = True
            self._tell("READY=1")

    def status(self, text: str) -> None:
        """A line for people; said when it changes."""
        if text != self._status:
            self._status = text
            self._tell(f"STATUS={text}")

    def alive(self) -> None:
        """All make progress; without this the service manager starts the service anew."""
        now_s = self._now_s()
        if self._watchdog_s is None:
            return
        if self._fed_s is None or now_s - self._fed_s >= SHARE * self._watchdog_s:
            self._fed_s = now_s
            self._tell("WATCHDOG=1")

    def stopping(self) -> None:
        """The service ends because it was asked to."""
        self._tell("STOPPING=1")

    def _tell(self, line: str) -> None:
        if not self._address:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
            out.setblocking(False)
            out.sendto(line.encode(), self._address)
