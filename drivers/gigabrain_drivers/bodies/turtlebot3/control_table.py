"""A Dynamixel device's memory: items of a fixed type at fixed addresses."""

import struct
from collections.abc import Mapping


class ControlTable:
    """Reads and writes as the vendor's slave library does: only whole items, gaps are zero."""

    def __init__(self, items: Mapping[int, str]) -> None:
        """`items` by address, each a `struct` code of one value."""
        self._codes = {address: struct.Struct("<" + code) for address, code in items.items()}
        self._data = bytearray(max(address + code.size for address, code in self._codes.items()))

    def __getitem__(self, address: int) -> float:
        return float(self._codes[address].unpack_from(self._data, address)[0])

    def __setitem__(self, address: int, value: float) -> None:
        code = self._codes[address]
        code.pack_into(self._data, address, value if code.format[-1:] in "fd" else round(value))

    def put(self, address: int, code: str, *values: float) -> None:
        """Set items of the same type in a row."""
        size = struct.calcsize(code)
        for place, value in enumerate(values):
            self[address + place * size] = value

    def read(self, address: int, length: int) -> bytes:
        """What a READ of this range answers."""
        answer = bytearray(length)
        for at in self._inside(address, length):
            size = self._codes[at].size
            answer[at - address : at - address + size] = self._data[at : at + size]
        return bytes(answer)

    def write(self, address: int, data: bytes) -> list[int]:
        """Do a WRITE; returns the addresses of the items that it reached."""
        reached = self._inside(address, len(data))
        for at in reached:
            size = self._codes[at].size
            self._data[at : at + size] = data[at - address : at - address + size]
        return reached

    def _inside(self, address: int, length: int) -> list[int]:
        """The items that lie wholly in a range."""
        end = address + length
        return [at for at, code in self._codes.items() if address <= at and at + code.size <= end]
