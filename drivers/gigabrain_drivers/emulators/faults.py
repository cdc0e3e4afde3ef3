"""Faults for tests, between a device and its wire."""

import random
from collections.abc import Iterable
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from gigabrain_drivers.emulators.base import Wire
from gigabrain_schemas.base import Finite, NonNegative
from gigabrain_zenoh.errors import ConfigError, unknown

Natural = Annotated[int, Meta(ge=0, le=255)]
Chance = Annotated[float, Meta(ge=0.0, le=1.0)]

MAX_GARBAGE_BYTES = 64

VALUE_HINTS = {  # expected values, by fault
    "garbage": "from 0 to 1, such as garbage=0.1",
    "bit_errors": "from 0 to 1, such as bit_errors=0.001",
    "half_frames": "from 0 to 1, such as half_frames=0.1",
    "brown_out": "of volts from 0, such as brown_out=6",
    "runaway": "of m/s, such as runaway=0.1",
    "silent_servo": "that is an id, such as silent_servo=3",
}


class Faults(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The present faults of a device. Written as JSON, or as words such as `silence`."""

    silence: bool = False  # its bytes are lost; it still receives
    deaf: bool = False  # bytes to it are lost; it still sends
    frozen: bool = False  # its line hangs and bytes queue up; the motors' watchdog still works
    garbage: Chance = 0.0  # that random bytes precede a piece that it sends
    bit_errors: Chance = 0.0  # that a bit of a byte is flipped, in both directions
    half_frames: Chance = 0.0  # that the second half of a piece that it sends is lost
    unplugged: bool = False  # the port does not exist
    reboot: bool = False  # held in reset, motors off; afterwards it boots and sends its banner
    brown_out: NonNegative = 0.0  # [V], drop of its supply
    frozen_values: bool = False  # it still reports, but its measurements no longer change
    runaway: Finite = 0.0  # [m/s], of the wheels, regardless of commands
    stuck_wheel: bool = False  # the first wheel does not turn
    silent_servo: Natural = 0  # id of a servo that neither receives nor answers

    def __str__(self) -> str:
        """Return the present faults in words."""
        words = []
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if value:
                words.append(name if value is True else f"{name}={value:g}")
        return " ".join(words)


NO_FAULTS = Faults()


def faults_in(words: Iterable[str], stations: Iterable[str]) -> Faults:
    """Return the faults of words such as `silence` and `garbage=0.1`. Raises ConfigError."""
    faults = NO_FAULTS
    for word in words:
        name, given, value = word.partition("=")
        if word == "off":
            continue
        if name not in Faults.__struct_fields__:
            raise unknown("fault", name, [*Faults.__struct_fields__, *stations, "off"])
        if name not in VALUE_HINTS and given:
            raise ConfigError(f"{name} takes no number: write {name}, and off to end it")
        try:
            change = msgspec.convert({name: value if given else True}, Faults, strict=False)
        except msgspec.ValidationError:
            raise ConfigError(f"{name} needs a number {VALUE_HINTS[name]}") from None
        faults = msgspec.structs.replace(faults, **{name: getattr(change, name)})
    return faults


class FaultyWire:
    """Passes bytes between a device and its wire, and applies the faults to them."""

    def __init__(self, wire: Wire, seed: int = 0) -> None:
        self.faults = NO_FAULTS
        self._wire = wire
        self._random = random.Random(seed)
        self._waiting = bytearray()  # received while the device was frozen

    def write(self, data: bytes) -> bool:
        """Send from the device to the host."""
        faults = self.faults
        if faults.silence or faults.frozen or faults.reboot:
            return True
        if self._happens(faults.garbage):
            data = self._random.randbytes(self._random.randint(1, MAX_GARBAGE_BYTES)) + data
        if self._happens(faults.half_frames):
            data = data[: len(data) // 2]
        return self._wire.write(self._flipped(data))

    def incoming(self, data: bytes) -> bytes:
        """Return the bytes that reach the device, including those that waited."""
        faults = self.faults
        if faults.deaf or faults.reboot:
            return b""
        if faults.frozen:
            self._waiting += data
            return b""
        waited, self._waiting = bytes(self._waiting), bytearray()
        return self._flipped(waited + data)

    def _happens(self, chance: float) -> bool:
        return chance > 0 and self._random.random() < chance

    def _flipped(self, data: bytes) -> bytes:
        chance = self.faults.bit_errors
        if not chance:
            return data
        noisy = bytearray(data)
        for place in range(len(noisy)):
            if self._happens(chance):
                noisy[place] ^= 1 << self._random.randrange(8)
        return bytes(noisy)
