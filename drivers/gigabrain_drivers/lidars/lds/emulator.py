"""Emulated LDS-01 and LDS-03. They start and stop on command."""

from typing import Any

from gigabrain_drivers.driver.robot import ScanOptions
from gigabrain_drivers.emulators.base import Device, EmulatedBody, Sample, Sweep, Wire
from gigabrain_drivers.lidars.ld.emulator import MAX_SAG_VOLTS
from gigabrain_drivers.lidars.lds import lds01, lds03

LDS01_HZ = 5.0  # turns per second
LDS03_HZ, LDS03_SAMPLES_HZ = 10.0, 4000.0
LDS03_POINTS = 20  # maximum in a packet
INTENSITY, QUALITY = 1000, 60
COMMAND_BYTES = 4


class Lds01Device(Device):
    """Turns from its start command `b` to its stop command `e`."""

    Options = ScanOptions
    baud = lds01.BAUD

    def __init__(self, body: EmulatedBody, options: Any, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self._sweep = Sweep(body, 0.12, 3.5)

    def feed(self, data: bytes) -> None:
        """Obey the newest command."""
        if data.rfind(lds01.START) > data.rfind(lds01.STOP):
            self._sweep.start(LDS01_HZ * lds01.PACKETS * lds01.SAMPLES, LDS01_HZ)
        elif lds01.STOP in data:
            self._sweep.stop()

    def reset(self) -> None:
        """Come to rest."""
        self._sweep.stop()

    def step(self, now_ns: int) -> None:
        """Send all complete packets. The first samples are skipped, up to the start of a packet."""
        while samples := self._sweep.next_samples(lds01.SAMPLES):
            first = round(samples[0].angle) - 1
            while first % lds01.SAMPLES:
                samples = samples[1:] + self._sweep.next_samples(1)
                first += 1
            if len(samples) == lds01.SAMPLES and self.sag_volts <= MAX_SAG_VOLTS:
                number = first // lds01.SAMPLES % lds01.PACKETS
                self.wire.write(lds01.encode(_lds01_packet(number, samples)))


class Lds03Device(Device):
    """Turns from its start command to its stop command."""

    Options = ScanOptions
    baud = lds03.BAUD

    def __init__(self, body: EmulatedBody, options: Any, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self._sweep = Sweep(body, 0.1, 8.0)
        self.reset()

    def reset(self) -> None:
        """Come to rest."""
        self._received = b""
        self._waiting: list[Sample] = []
        self._begins = False
        self._sweep.stop()

    def feed(self, data: bytes) -> None:
        """Obey the newest command."""
        self._received += data
        start, stop = self._received.rfind(lds03.START), self._received.rfind(lds03.STOP)
        if start > stop:
            self._sweep.start(LDS03_SAMPLES_HZ, LDS03_HZ)
        elif stop >= 0:
            self._sweep.stop()
        self._received = b"" if max(start, stop) >= 0 else self._received[-COMMAND_BYTES:]

    def step(self, now_ns: int) -> None:
        """Send all complete packets; none crosses 0 degrees."""
        while samples := self._sweep.next_samples(1):
            wraps = bool(self._waiting) and samples[0].angle < self._waiting[-1].angle
            if wraps or len(self._waiting) == LDS03_POINTS:
                self._send()
                self._begins = wraps
            self._waiting += samples

    def _send(self) -> None:
        points, self._waiting = self._waiting, []
        packet = lds03.Lds03Packet(
            begins=self._begins,
            rate=LDS03_HZ if self._begins else 0.0,
            samples=tuple(_lds03_sample(point) for point in points),
        )
        if self.sag_volts <= MAX_SAG_VOLTS:
            self.wire.write(lds03.encode(packet))


def _lds01_packet(number: int, samples: list[Sample]) -> lds01.Lds01Packet:
    ranges = tuple(round(sample.distance) for sample in samples)
    intensities = tuple(INTENSITY if distance else 0 for distance in ranges)
    return lds01.Lds01Packet(number, LDS01_HZ * 60, intensities, ranges)


def _lds03_sample(point: Sample) -> lds03.Lds03Sample:
    distance = round(point.distance)
    return lds03.Lds03Sample(point.angle, distance, QUALITY if distance else 0, reflective=False)
