"""Log records as flat mappings, as JSON lines, and as lines for people."""

import logging
import time
from collections.abc import Mapping
from typing import Any, Final

import msgspec

LEVELS: Final = ("debug", "info", "warning", "error", "critical")
_SHOWN_APART = frozenset({"t", "level", "process", "event", "text", "traceback"})
_COLOURS = {"debug": "2", "warning": "33", "error": "31", "critical": "1;31"}
_FORMATTER = logging.Formatter()


def level_of(record: logging.LogRecord) -> str:
    """The name of the nearest of LEVELS that is not above the record's own level."""
    return LEVELS[min(max(record.levelno // 10 - 1, 0), len(LEVELS) - 1)]


def fields(record: logging.LogRecord, process: str) -> dict[str, Any]:
    """`{"t": unix_ns, "level", "process", "event", "text"}` and the record's own `data`.

    `data` comes in by `extra={"data": {...}}`; it names the event, and cannot overwrite the rest.
    """
    data = getattr(record, "data", {})
    known: dict[str, Any] = {
        "t": int(record.created * 1e9),
        "level": level_of(record),
        "process": process,
        "event": str(data.get("event", "log")),
        "text": _message(record),
    }
    if record.exc_info:
        known["traceback"] = _FORMATTER.formatException(record.exc_info)
    return known | {str(k): v for k, v in data.items() if k not in known}


def _message(record: logging.LogRecord) -> str:
    try:
        return record.getMessage()
    except (TypeError, ValueError, KeyError):  # a library's arguments do not fit its own format
        return f"{record.msg} {record.args}"


def encode(record: Mapping[str, Any]) -> bytes:
    """One line of JSON without its newline, whatever the values are; NaN becomes null."""
    try:
        return _ENCODER.encode(record)
    except (TypeError, ValueError, OverflowError, RecursionError):
        # a cycle, a lone surrogate or an odd key: the line matters more than its looks
        return _ENCODER.encode({ascii(key)[1:-1]: _safe(value) for key, value in record.items()})


def readable(record: Mapping[str, Any], *, colour: bool = False) -> str:
    """`12:03:44 driver     warning  text key=value`, in local time, without its newline."""
    clock = time.strftime("%H:%M:%S", time.localtime(record["t"] / 1e9))
    level, text = str(record["level"]), printable(record.get("text") or record["event"])
    data = [
        f"{printable(key)}={printable(_value(value))}"
        for key, value in record.items()
        if key not in _SHOWN_APART
    ]
    shown = f"\033[{_COLOURS[level]}m{level:<8}\033[0m" if colour and level in _COLOURS else level
    line = f"{clock} {printable(record['process']):<10} {shown:<8} {' '.join([text, *data])}"
    rest = str(record.get("traceback", "")).splitlines()
    return "\n".join([line, *("    " + printable(more) for more in rest)])


def _plain(value: object) -> object:
    """What msgspec does not know: numpy scalars and arrays as numbers, all else as its repr."""
    to_list = getattr(value, "tolist", None)
    return to_list() if callable(to_list) else str(value)


def _safe(value: object) -> object:
    return value if isinstance(value, int) else ascii(value)


def _value(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str) and value and " " not in value:
        return value
    return encode({"": value})[4:-1].decode()


def printable(text: object) -> str:
    """Text from anywhere must not move the cursor of the terminal that shows it."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))


_ENCODER = msgspec.json.Encoder(enc_hook=_plain)
