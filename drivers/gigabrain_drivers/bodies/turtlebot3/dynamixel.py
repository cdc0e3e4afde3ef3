"""Dynamixel Protocol 2.0: packets with byte stuffing and CRC-16.

Source: https://emanual.robotis.com/docs/en/dxl/protocol2/
"""

import struct
from typing import NamedTuple

from gigabrain_drivers.links.frames import FrameDecoder

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


def crc16(data: bytes) -> int:
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


class Decoder(FrameDecoder[Packet]):
    """Finds packets in whatever comes in."""

    HEADER = HEADER

    def __init__(self, longest: int = LONGEST) -> None:
        super().__init__()
        self._longest = longest

    def _size(self, buffer: bytearray) -> int | None:
        if len(buffer) < _PREFIX:
            return None
        length = int.from_bytes(buffer[_PREFIX - 2 : _PREFIX], "little")
        size = _PREFIX + length
        if not 1 + _CRC <= length <= self._longest:
            return 0
        inside = buffer.find(HEADER, len(HEADER), size - _CRC)
        return 0 if inside > 0 else size  # stuffing leaves no header inside a packet

    def _frame(self, data: bytes) -> Packet | None:
        right = crc16(data[:-_CRC]) == int.from_bytes(data[-_CRC:], "little")
        return _packet(data) if right else None


def _packet(frame: bytes) -> Packet:
    body = frame[_PREFIX:-_CRC].replace(_STUFFED, _MARK)
    return Packet(frame[4], body[0], body[1:])
