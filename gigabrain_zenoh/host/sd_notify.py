"""Client for the service manager's sd_notify(3) protocol; does nothing without a service manager.

Sends datagrams to the Unix socket named in the environment. The variables are removed from the
environment, so that child processes do not notify in this service's name.
"""

import contextlib
import os
import socket
import time
from collections.abc import Callable
from typing import Self

SHARE = 0.4  # fraction of the watchdog's timeout between two keep-alives


class Notifier:
    """Sends one service's state to its manager. Errors are ignored: the robot continues."""

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
        """Create a notifier from the service manager's variables, and unset them."""
        address = os.environ.pop("NOTIFY_SOCKET", "")
        microseconds = os.environ.pop("WATCHDOG_USEC", "")
        meant = os.environ.pop("WATCHDOG_PID", "") or str(os.getpid())
        fed = microseconds.isdecimal() and meant == str(os.getpid())
        return cls(address, int(microseconds) / 1e6 if fed else None)

    def ready(self) -> None:
        """Report that the service is ready; sent only once."""
        if not self._ready:
            self._ready = True
            self._tell("READY=1")

    def status(self, text: str) -> None:
        """Send a status line for people; sent only when it changes."""
        if text != self._status:
            self._status = text
            self._tell(f"STATUS={text}")

    def alive(self) -> None:
        """Feed the watchdog, if one is configured and it is due.

        Call this while all processes make progress. Otherwise the service manager restarts the
        service.
        """
        now_s = self._now_s()
        if self._watchdog_s is None:
            return
        if self._fed_s is None or now_s - self._fed_s >= SHARE * self._watchdog_s:
            self._fed_s = now_s
            self._tell("WATCHDOG=1")

    def stopping(self) -> None:
        """Report that the service is stopping on request."""
        self._tell("STOPPING=1")

    def _tell(self, line: str) -> None:
        if not self._address:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
            out.setblocking(False)
            out.sendto(line.encode(), self._address)
