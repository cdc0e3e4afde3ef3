"""Checksums of text lines, by name."""

import binascii
import functools
import operator
import zlib
from collections.abc import Callable
from typing import NamedTuple

CRC8_POLYNOMIAL = 0x07


class Check(NamedTuple):
    """A checksum and how many hexadecimal digits it has."""

    of: Callable[[bytes], int]
    digits: int


def xor8(data: bytes) -> int:
    """All bytes in exclusive or, as in NMEA 0183."""
    return functools.reduce(operator.xor, data, 0)


def crc8(data: bytes) -> int:
    """CRC-8: polynomial 0x07, initial value 0, not reflected; 0xF4 for "123456789"."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ (CRC8_POLYNOMIAL if crc & 0x80 else 0)) & 0xFF
    return crc


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF; 0x29B1 for "123456789"."""
    return binascii.crc_hqx(data, 0xFFFF)


def crc32(data: bytes) -> int:
    """CRC-32 of Ethernet and zlib; 0xCBF43926 for "123456789"."""
    return zlib.crc32(data)


CHECKS = {
    "xor8": Check(xor8, 2),
    "crc8": Check(crc8, 2),
    "crc16": Check(crc16, 4),
    "crc32": Check(crc32, 8),
}
