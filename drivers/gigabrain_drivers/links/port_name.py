"""How a serial port is named in a robot's file: a path, `usb:VID:PID[:SERIAL]`, or `auto`."""

import re

AUTO = "auto"
USB = "usb:"
_ID = re.compile(r"[0-9A-Fa-f]{1,4}")


def check_port(name: str) -> None:
    """Raises ValueError, as `port: ...`, for what can be no serial port."""
    if not name.strip() or "://" in name:
        raise ValueError(
            f"port: expected a path such as /dev/ttyUSB0, usb:VID:PID or auto, got {name!r}"
        )
    for word in (AUTO, USB):
        if name.lower().startswith(word) and not name.startswith(word):
            right = word + name[len(word) :]
            raise ValueError(f"port: expected small letters; did you mean {right!r}?")
    if name.startswith(USB):
        try:
            usb_id(name)
        except ValueError as error:
            raise ValueError(f"port: {error}") from None


def usb_id(port: str) -> tuple[int, int, str]:
    """(vendor, product, serial number or "") of `usb:VID:PID[:SERIAL]`. Raises ValueError."""
    parts = port.removeprefix(USB).split(":", 2)
    if len(parts) < 2:
        raise ValueError(f"expected usb:VID:PID or usb:VID:PID:SERIAL, got {port!r}")
    if not all(_ID.fullmatch(part) for part in parts[:2]):
        raise ValueError(f"expected VID and PID of up to four hexadecimal digits, got {port!r}")
    return int(parts[0], 16), int(parts[1], 16), parts[2] if len(parts) > 2 else ""
