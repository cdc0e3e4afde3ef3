"""Dynamixel Protocol 2.0: packets with byte stuffing and CRC-16.

Source: https://emanual.robotis.com/docs/en/dxl/protocol2/
"""

import struct
from typing import NamedTuple

HEADER = b"\xff\xff\xfd\x00"
PING, READ, WRITE, STATUS = 0x01, 0x02, 0x03, 0x55
LONGEST = 1024  # of the length field; nothing here sends as much, so more is noise

_PREFIX = len(HEADER) + 3  # header, id, length: what the length does not count
_CRC = 2
_MARK, _STUFFED = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"


class Packet(NamedTuple):
    """An instruction, or as STATUS an answer, whose first parameter is then its error."""

    id: int
    instruction: int
    params: bytes = b""


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte << 8
        for _ in range(8):
            value = (value << 1) ^ (0x8005 if value & 0x8000 else 0)
        table.append(value & 0xFFFF)
    return tuple(table)


_TABLE = _crc_table()


def crc16(data: bytes | bytearray) -> int:
    """The check of `data`: polynomial 0x8005, from 0, nothing reflected."""
    crc = 0
    for byte in data:
        crc = ((crc << 8) & 0xFFFF) ^ _TABLE[(crc >> 8) ^ byte]
    return crc


def encode(packet: Packet) -> bytes:
    """The bytes of a packet on the wire."""
    body = bytes([packet.instruction]) + packet.params
    body = body.replace(_MARK, _STUFFED)
    frame = HEADER + struct.pack("<BH", packet.id, len(body) + _CRC) + body
    return frame + struct.pack("<H", crc16(frame))


def ping(device: int) -> bytes:
    """Ask who is there; the answer is model number u16 and firmware version u8."""
    return encode(Packet(device, PING))


def read(device: int, address: int, length: int) -> bytes:
    """Ask for `length` bytes of the control table."""
    return encode(Packet(device, READ, struct.pack("<HH", address, length)))


def write(device: int, address: int, data: bytes) -> bytes:
    """Put `data` into the control table."""
    return encode(Packet(device, WRITE, struct.pack("<H", address) + data))


def status(device: int, data: bytes = b"", error: int = 0) -> bytes:
    """A device's answer."""
    return encode(Packet(device, STATUS, bytes([error]) + data))


class Decoder:
    """Finds packets in whatever comes in. `errors` counts stretches of bytes that were no packet.

    A broken packet costs no more than itself: the search goes on right behind its header.
    """

    def __init__(self, longest: int = LONGEST) -> None:
        self._longest = longest
        self._buffer = bytearray()
        self._lost = False  # inside a stretch that was counted
        self.errors = 0

    def clear(self) -> None:
        """Forget what has begun to come in."""
        self._buffer.clear()
        self._lost = False

    def feed(self, data: bytes) -> list[Packet]:
        """The packets that `data` completes, in order."""
        buffer, packets = self._buffer, []
        buffer += data
        while self._at_header():
            size = self._size()
            if size is None:
                break
            if size == 0 or buffer.find(HEADER, len(HEADER), size - _CRC) > 0:
                self._skip(len(HEADER))  # stuffing leaves no header inside a packet
            elif len(buffer) < size:
                break
            elif crc16(buffer[: size - _CRC]) != int.from_bytes(
                buffer[size - _CRC : size], "little"
            ):
                self._skip(len(HEADER))
            else:
                packets.append(_packet(bytes(buffer[:size])))
                del buffer[:size]
                self._lost = False
        return packets

    def _at_header(self) -> bool:
        """Drop what is before the next header; whether there is one."""
        at = self._buffer.find(HEADER)
        if at < 0:
            at = len(self._buffer) - _begun(self._buffer)
        if at:
            self._skip(at)
        return len(self._buffer) >= len(HEADER)

    def _size(self) -> int | None:
        """Bytes of the packet that begins here; 0: it cannot be one, None: not known yet."""
        if len(self._buffer) < _PREFIX:
            return None
        length = int.from_bytes(self._buffer[_PREFIX - 2 : _PREFIX], "little")
        return _PREFIX + length if 1 + _CRC <= length <= self._longest else 0

    def _skip(self, count: int) -> None:
        del self._buffer[:count]
        self.errors += not self._lost
        self._lost = True


def _begun(buffer: bytearray) -> int:
    """How many bytes at the end may be the beginning of a header."""
    return next((n for n in (3, 2, 1) if buffer.endswith(HEADER[:n])), 0)


def _intact(frame: bytearray) -> bool:
    return crc16(frame[:-_CRC]) == int.from_bytes(frame[-_CRC:], "little")


def _packet(frame: bytes) -> Packet:
    body = frame[_PREFIX:-_CRC].replace(_STUFFED, _MARK)
    return Packet(frame[4], body[0], body[1:])
