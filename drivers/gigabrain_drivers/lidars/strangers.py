"""Whose bytes these are: for the one line that says that the wrong lidar was named."""

import re

from gigabrain_drivers.lidars.ld import protocol as ld

_LDS01 = re.compile(rb"\xfa[\xa0-\xdb].{40}\xfa[\xa0-\xdb]", re.DOTALL)
_COIN_D4 = re.compile(rb"\xaa\x55.{8}", re.DOTALL)


def who_sends(data: bytes) -> str:
    """Which known lidar sends such bytes, or an empty text."""
    if ld.Decoder().feed(data):
        return "an LDROBOT lidar (ld06, ld19, lds02)"
    if _LDS01.search(data):
        return "an LDS-01"
    if b"\xa5\x5a" in data:
        return "an RPLIDAR"
    if _COIN_D4.search(data):
        return "an LDS-03 or a YDLIDAR"
    return ""
