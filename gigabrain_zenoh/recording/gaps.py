"""Which messages never came: every sender counts what it sends on a key."""

from collections import Counter
from typing import Any

import msgspec

from gigabrain_schemas.topics import BODY, IMAGE, IMU, SCAN, STATE
from gigabrain_zenoh.host.bounded import put

OF_DRIVER = (STATE.key, SCAN.key, IMU.key, BODY.key, IMAGE.key)  # who makes the boot number


class Header(msgspec.Struct, frozen=True):
    """What a recorder has to know of any message."""

    stamp_ns: int = 0
    seq: int = 0
    boot: int = 0
    tick: int = 0
    basis: int = 0
    process: Any = ""  # on log and audit records: several may send on one key
    source: Any = ""  # on commands, likewise


_msgpack = msgspec.msgpack.Decoder(Header)
_json = msgspec.json.Decoder(Header)
NO_HEADER = Header()
HIGHEST = 2**63 - 1
MOST_SENDERS = 4096  # keys and senders whose messages are counted at a time


def is_json(payload: bytes) -> bool:
    """Whether `payload` is JSON; a MessagePack map never begins with ASCII."""
    return payload[:1] < b"\x80"


def header_of(payload: bytes) -> Header:
    """The header of a message of any type; an empty one where `payload` is no message."""
    try:
        header = _json.decode(payload) if is_json(payload) else _msgpack.decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return NO_HEADER
    return header if 0 <= header.seq <= HIGHEST and 0 <= header.stamp_ns <= HIGHEST else NO_HEADER


class Gaps:
    """Counts per key what is missing between the messages that came."""

    def __init__(self) -> None:
        self.missing: Counter[str] = Counter()
        self.restarts: Counter[str] = Counter()  # how often a sender began to count anew
        self._last: dict[tuple[str, str], Header] = {}

    def see(self, key: str, header: Header) -> int:
        """Take note of one message; how many are missing before it.

        A sender that starts anew counts from 1. What is missing before the first message that is
        seen at all was sent before anybody listened.
        """
        if header.seq == 0:  # from somebody who does not count
            return 0
        who = header.process or header.source
        sender = key, str(who)[:64] if who else ""
        last = self._last.get(sender)
        put(self._last, sender, header, MOST_SENDERS)
        if last is None:
            return 0
        if header.seq == last.seq + 1 and header.boot == last.boot:  # as nearly always
            return 0
        if header.seq <= last.seq or self._new_driver(key, last, header):
            self.restarts[key] += 1
            missing = header.seq - 1
        else:
            missing = header.seq - last.seq - 1
        self.missing[key] += missing
        return missing

    @staticmethod
    def _new_driver(key: str, last: Header, header: Header) -> bool:
        return header.boot != last.boot and key.startswith(OF_DRIVER)
