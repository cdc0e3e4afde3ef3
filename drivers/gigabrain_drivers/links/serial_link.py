"""A body on a serial line: opened by pyserial, read and written by the event loop."""

import asyncio
import contextlib
import errno
import os
from collections.abc import Callable
from pathlib import Path

import serial

from gigabrain_drivers.links import ports
from gigabrain_drivers.links.link import Link, LinkProblem
from gigabrain_drivers.links.port_name import AUTO
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.host.posix import termios

Probe = Callable[[serial.Serial], bool]

NO_MODEM_LINES = (errno.ENOTTY, errno.EINVAL)  # ptys have none, nor have some USB adapters


class SerialLink(Link):
    """`port` is a path, `usb:VID:PID[:SERIAL]`, or `auto` with a probe that knows its device.

    The probe gets an open port with a short read timeout, in a thread, and says whether it is
    the right one. Half of a line that could not be sent is discarded, not sent later.
    """

    def __init__(self, port: str, baud: int, clock: Clock, *, probe: Probe | None = None) -> None:
        super().__init__(clock)
        self.baud = baud  # holds from the next connection on
        self._port, self._probe = port, probe
        self._serial: serial.Serial | None = None
        self.path = ""  # of the device that was opened last

    def __str__(self) -> str:
        return self._port

    def set_dtr(self, on: bool) -> None:
        """Drive the data-terminal-ready line, where there is one."""
        self._set_line("dtr", on)

    def set_rts(self, on: bool) -> None:
        """Drive the request-to-send line, where there is one."""
        self._set_line("rts", on)

    def _set_line(self, name: str, on: bool) -> None:
        if self._serial is None:
            return
        try:
            setattr(self._serial, name, on)
        except OSError as error:
            if error.errno not in NO_MODEM_LINES:
                self.drop(str(error.strerror or error))

    async def _connect(self) -> int:
        opening = asyncio.get_running_loop().run_in_executor(None, self._open)
        try:
            self._serial = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_close_unwanted)
            raise
        return self._serial.fileno()

    def _open(self) -> serial.Serial:
        """In a thread: some adapters take tens of milliseconds."""
        paths = ports.candidates(self._port)
        if not paths:
            raise LinkProblem(ports.missing(self._port))
        if self._port != AUTO:
            self.path = paths[0]
            return ready(open_port(self.path, self.baud))
        for self.path in paths:
            if port := self._probed(self.path):
                return ready(port)
        raise LinkProblem(f"none of {', '.join(paths)} answers like this device")

    def _probed(self, path: str) -> serial.Serial | None:
        """The port, if it is the right one; others are left as they were."""
        try:
            port = open_port(path, self.baud)
        except LinkProblem:
            return None
        found = False
        try:
            found = self._probe is not None and self._probe(port)
        except (OSError, termios.error):  # it is gone, or no terminal
            pass
        finally:
            if not found:
                port.close()
        return port if found else None

    def _shut(self) -> None:
        if self._serial:
            with contextlib.suppress(OSError, termios.error):
                termios.tcflush(self._serial.fileno(), termios.TCIOFLUSH)  # or closing waits
            with contextlib.suppress(OSError):
                self._serial.close()
            self._serial = None

    def _cut_short(self) -> None:
        if self._serial:
            with contextlib.suppress(OSError, termios.error):
                termios.tcflush(self._serial.fileno(), termios.TCOFLUSH)


def open_port(path: str, baud: int) -> serial.Serial:
    """Open a serial port for us alone. Raises LinkProblem saying what to do about it."""
    if not Path(path).exists():
        raise LinkProblem(ports.missing(path))
    try:
        return serial.Serial(path, baud, timeout=0.2, write_timeout=0.2, exclusive=True)
    except OSError as error:  # serial.SerialException is one
        raise LinkProblem(ports.refused(path, error)) from None
    except (ValueError, termios.error) as error:
        raise LinkProblem(f"{path}: {error}") from None


def ready(port: serial.Serial) -> serial.Serial:
    """Ready an open port for the event loop: nothing old in it, and a read tells an unplugging.

    Raises LinkProblem, with the port closed.
    """
    try:
        fd = port.fileno()
        os.set_blocking(fd, False)
        settings = termios.tcgetattr(fd)
        settings[6][termios.VMIN] = 1  # at 0, no data and no device would both read as b""
        termios.tcsetattr(fd, termios.TCSANOW, settings)
        termios.tcflush(fd, termios.TCIOFLUSH)
    except (OSError, termios.error) as error:
        port.close()
        raise LinkProblem(f"{port.name}: {error.args[-1]}: unplugged?") from None
    return port


def _close_unwanted(opening: "asyncio.Future[serial.Serial]") -> None:
    if not opening.cancelled() and not opening.exception():
        opening.result().close()
