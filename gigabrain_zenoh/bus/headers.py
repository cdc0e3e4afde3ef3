"""Headers of messages, and counts of the messages that are missing between them."""

from collections import Counter
from typing import Any

import msgspec

from gigabrain_schemas.topics import BODY, IMAGE, IMU, SCAN, STATE
from gigabrain_zenoh.host.bounded import put_newest

DRIVER_KEYS = (STATE.key, SCAN.key, IMU.key, BODY.key, IMAGE.key)  # they carry the driver's boot
MAX_COUNT = 2**63 - 1
MAX_GAP = 1_000_000  # messages; a larger jump is a new count, not a loss
MAX_SENDERS = 4096  # pairs of key and sender that are remembered


class Header(msgspec.Struct, frozen=True):
    """Fields that a recorder reads of any message."""

    stamp_ns: int = 0
    seq: int = 0
    boot: int = 0
    tick: int = 0
    basis: int = 0
    process: Any = ""  # of log and audit records: several processes share a key
    source: Any = ""  # of commands, likewise


_msgpack = msgspec.msgpack.Decoder(Header)
_json = msgspec.json.Decoder(Header)
NO_HEADER = Header()


def is_json(payload: bytes) -> bool:
    """Return whether `payload` is JSON; a MessagePack map never begins with ASCII."""
    return payload[:1] < b"\x80"


def header_of(payload: bytes) -> Header:
    """Return the header of a message of any type; an empty one if `payload` is not a message."""
    try:
        header = _json.decode(payload) if is_json(payload) else _msgpack.decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return NO_HEADER
    valid = 0 <= header.seq <= MAX_COUNT and 0 <= header.stamp_ns <= MAX_COUNT
    return header if valid else NO_HEADER


class SequenceGaps:
    """Counts, per key, the messages missing between those received."""

    def __init__(self) -> None:
        self.missing: Counter[str] = Counter()
        self.restarts: Counter[str] = Counter()  # times that a sender began a new count
        self._last: dict[tuple[str, str], Header] = {}

    def count(self, key: str, header: Header) -> int:
        """Count one message, and return how many are missing before it.

        A sender that restarts counts from 1. Before the first message, and after a jump of more
        than MAX_GAP, none are missing.
        """
        if header.seq == 0:  # the sender does not count
            return 0
        name = header.process or header.source
        sender = key, str(name)[:64] if name else ""
        last = self._last.get(sender)
        put_newest(self._last, sender, header, MAX_SENDERS)
        if last is None:
            return 0
        if header.seq == last.seq + 1 and header.boot == last.boot:  # the usual case
            return 0
        new_driver = header.boot != last.boot and key.startswith(DRIVER_KEYS)
        restarted = header.seq <= last.seq or new_driver
        missing = header.seq - 1 if restarted else header.seq - last.seq - 1
        if restarted or missing > MAX_GAP:
            self.restarts[key] += 1
        if missing > MAX_GAP:
            return 0
        self.missing[key] += missing
        return missing
