"""Serial lines, opened by pyserial and used by the event loop, and names of ports.

A port's name is a path, `usb:VID:PID[:SERIAL]`, or `auto`.
"""

import asyncio
import contextlib
import errno
import os
import re
from collections.abc import Callable
from pathlib import Path

import serial
from serial.tools import list_ports

from gigabrain_drivers.links.link import Link, LinkProblem
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.host.posix import termios

AUTO = "auto"
USB = "usb:"
_ID = re.compile(r"[0-9A-Fa-f]{1,4}")

NO_PORT = (errno.ENOTTY, errno.EINVAL, errno.EISDIR)  # errors of files, folders and other devices
Probe = Callable[[serial.Serial], bool]
NO_MODEM_LINES = (errno.ENOTTY, errno.EINVAL)  # errors of ptys and some USB adapters


def check_port(name: str) -> None:
    """Raise ValueError, as `port: ...`, unless it may be a serial port."""
    if not name.strip() or "://" in name:
        raise ValueError(
            f"port: expected a path such as /dev/ttyUSB0, usb:VID:PID or auto, got {name!r}"
        )
    for word in (AUTO, USB):
        if name.lower().startswith(word) and not name.startswith(word):
            right = word + name[len(word) :]
            raise ValueError(f"port: expected lower case; did you mean {right!r}?")
    if name.startswith(USB):
        try:
            usb_id(name)
        except ValueError as error:
            raise ValueError(f"port: {error}") from None


def usb_id(port: str) -> tuple[int, int, str]:
    """Return (vendor, product, serial or "") of `usb:VID:PID[:SERIAL]`. Raises ValueError."""
    parts = port.removeprefix(USB).split(":", 2)
    if len(parts) < 2:
        raise ValueError(f"expected usb:VID:PID or usb:VID:PID:SERIAL, got {port!r}")
    if not all(_ID.fullmatch(part) for part in parts[:2]):
        raise ValueError(f"expected VID and PID of up to four hexadecimal digits, got {port!r}")
    return int(parts[0], 16), int(parts[1], 16), parts[2] if len(parts) > 2 else ""


def candidate_paths(port: str) -> list[str]:
    """Return the possible paths of `port` (a path, `usb:VID:PID[:SERIAL]`, `auto`)."""
    if port == AUTO:
        return sorted(p.device for p in list_ports.comports() if p.vid is not None)
    if not port.startswith(USB):
        return [port]
    vendor, product, serial_number = usb_id(port)
    return sorted(
        p.device
        for p in list_ports.comports()
        if (p.vid, p.pid) == (vendor, product) and serial_number in ("", p.serial_number)
    )


def describe_missing(port: str) -> str:
    """Return the error text for a missing device."""
    if port == AUTO:
        return "no serial port at all: is it plugged in?"
    what = "USB device " if port.startswith(USB) else ""
    return f"no {what}{port}: is it plugged in?"


def describe_absent(port: str) -> str:
    """Return the error text for a missing port; empty if it exists. Raises ValueError."""
    return (
        "" if any(Path(path).exists() for path in candidate_paths(port)) else describe_missing(port)
    )


def describe_refusal(path: str, error: OSError) -> str:
    """Return the error text for a device that cannot be opened."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return (
            f"no permission to open {path}; add yourself to its group (dialout on Debian), or "
            f'this udev rule: KERNEL=="{Path(path).resolve().name}", MODE="0666"'
        )
    if error.errno in (errno.EAGAIN, errno.EBUSY):
        holders = ", ".join(map(str, _holders(path)))
        return f"{path} is in use{f' by pid {holders}' if holders else ''}"
    cause = error.__context__  # for pyserial's errors without errno
    number = cause.args[0] if isinstance(cause, termios.error) else error.errno
    if number in NO_PORT:
        return f"{path} is not a serial port"
    return f"{path}: {error.strerror or error}"


def _holders(path: str) -> list[int]:
    """Return the ids of processes that have the device open, if they are visible (Linux)."""
    device, found = os.path.realpath(path), []
    for entry in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if os.readlink(entry) == device:
                found.append(int(entry.parts[2]))
        except OSError:
            continue  # no permission, or already closed
    return sorted(set(found))


class SerialLink(Link):
    """A serial line. `port` is a path, `usb:VID:PID[:SERIAL]`, or `auto` with a probe.

    The probe runs in a thread. It gets an open port with a short read timeout, and returns whether
    it is the right one. The rest of a partial write is discarded, not sent later.
    """

    def __init__(self, port: str, baud: int, clock: Clock, *, probe: Probe | None = None) -> None:
        super().__init__(clock)
        self.baud = baud  # a change is used at the next connection
        self._port, self._probe = port, probe
        self._serial: serial.Serial | None = None
        self.path = ""  # of the newest opened device

    def __str__(self) -> str:
        return self._port

    def set_dtr(self, on: bool) -> None:
        """Set the data-terminal-prepare line, if there is one."""
        if self._serial is None:
            return
        try:
            self._serial.dtr = on
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
        """Open the port, in a thread: some adapters take tens of milliseconds."""
        paths = candidate_paths(self._port)
        if not paths:
            raise LinkProblem(describe_missing(self._port))
        if self._port != AUTO:
            self.path = paths[0]
            return prepare(open_port(self.path, self.baud))
        for self.path in paths:
            if port := self._probed(self.path):
                return prepare(port)
        raise LinkProblem(f"none of {', '.join(paths)} answers like this device")

    def _probed(self, path: str) -> serial.Serial | None:
        """Open a port; return it if it is the right one, else close it."""
        try:
            port = open_port(path, self.baud)
        except LinkProblem:
            return None
        found = False
        try:
            found = self._probe is not None and self._probe(port)
        except (OSError, termios.error):  # unplugged, or not a terminal
            pass
        finally:
            if not found:
                port.close()
        return port if found else None

    def _shut(self) -> None:
        if self._serial:
            with contextlib.suppress(OSError, termios.error):
                termios.tcflush(self._serial.fileno(), termios.TCIOFLUSH)  # or closing would wait
            with contextlib.suppress(OSError):
                self._serial.close()
            self._serial = None

    def _cut_short(self) -> None:
        if self._serial:
            with contextlib.suppress(OSError, termios.error):
                termios.tcflush(self._serial.fileno(), termios.TCOFLUSH)


def open_port(path: str, baud: int) -> serial.Serial:
    """Open a serial port exclusively. Raises LinkProblem."""
    if not Path(path).exists():
        raise LinkProblem(describe_missing(path))
    try:
        return serial.Serial(path, baud, timeout=0.2, write_timeout=0.2, exclusive=True)
    except OSError as error:  # includes serial.SerialException
        raise LinkProblem(describe_refusal(path, error)) from None
    except (ValueError, termios.error) as error:
        raise LinkProblem(f"{path}: {error}") from None


def prepare(port: serial.Serial) -> serial.Serial:
    """Prepare an open port for the event loop: empty its buffers, and let unplugging end a read.

    Closes the port before it raises LinkProblem.
    """
    try:
        fd = port.fileno()
        os.set_blocking(fd, False)
        settings = termios.tcgetattr(fd)
        settings[6][termios.VMIN] = 1  # with 0, no data and no device would both read as b""
        termios.tcsetattr(fd, termios.TCSANOW, settings)
        termios.tcflush(fd, termios.TCIOFLUSH)
    except (OSError, termios.error) as error:
        port.close()
        raise LinkProblem(f"{port.name}: {error.args[-1]}: unplugged?") from None
    return port


def _close_unwanted(opening: "asyncio.Future[serial.Serial]") -> None:
    if not opening.cancelled() and not opening.exception():
        opening.result().close()
