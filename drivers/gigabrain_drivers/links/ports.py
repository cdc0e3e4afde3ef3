"""Which serial port is meant, and what to say when it cannot be had."""

import errno
import os
from pathlib import Path

from serial.tools import list_ports

from gigabrain_drivers.links.port_name import AUTO, USB, usb_id
from gigabrain_zenoh.host.posix import termios

NO_PORT = (errno.ENOTTY, errno.EINVAL, errno.EISDIR)  # a file, a folder, another device


def candidates(port: str) -> list[str]:
    """The paths that `port` (a path, `usb:VID:PID[:SERIAL]` or `auto`) may stand for."""
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


def missing(port: str) -> str:
    """What to say when there is no such device."""
    if port == AUTO:
        return "no serial port at all: is it plugged in?"
    what = "USB device " if port.startswith(USB) else ""
    return f"no {what}{port}: is it plugged in?"


def absent(port: str) -> str:
    """What to say of a port that is not there now; nothing where it is. Raises ValueError."""
    return "" if any(Path(path).exists() for path in candidates(port)) else missing(port)


def refused(path: str, error: OSError) -> str:
    """What to say when the device is there but cannot be opened."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return (
            f"no permission to open {path}; add yourself to its group (dialout on Debian), or "
            f'this udev rule: KERNEL=="{Path(path).resolve().name}", MODE="0666"'
        )
    if error.errno in (errno.EAGAIN, errno.EBUSY):
        holders = ", ".join(map(str, _holders(path)))
        return f"{path} is in use{f' by pid {holders}' if holders else ''}"
    cause = error.__context__  # of pyserial's errors without a number
    number = cause.args[0] if isinstance(cause, termios.error) else error.errno
    if number in NO_PORT:
        return f"{path} is no serial port"
    return f"{path}: {error.strerror or error}"


def _holders(path: str) -> list[int]:
    """Who has the device open, as far as we may look (Linux)."""
    device, found = os.path.realpath(path), []
    for entry in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if os.readlink(entry) == device:
                found.append(int(entry.parts[2]))
        except OSError:
            continue  # not ours to look at, or gone meanwhile
    return sorted(set(found))
