"""The lidars of TurtleBot3: LDS-01 and LDS-03, which are told to turn, and LDS-02."""

import math
from collections import deque
from pathlib import Path
from typing import Any

from gigabrain_drivers.driver.robot import ScanOptions
from gigabrain_drivers.emulators.base import Device, EmulatedBody, Port, Wire
from gigabrain_drivers.emulators.pty import Pty
from gigabrain_drivers.emulators.sweep import Sample, Sweep
from gigabrain_drivers.lidars.ld import protocol as ld
from gigabrain_drivers.lidars.ld.emulator import LEAST_VOLTS, LdDevice
from gigabrain_drivers.lidars.lds import lds01 as lds01
from gigabrain_drivers.lidars.lds import lds03 as lds03

LDS01_HZ = 5.0  # turns
LDS03_HZ, LDS03_SAMPLES_HZ = 10.0, 4000.0
LDS03_POINTS = 20  # in a packet, at most
INTENSITY, QUALITY = 1000, 60
LONGEST_COMMAND = 4

LENS_X, LENS_Y, SLANT = 5.9, -20.14, 0.11923  # [mm], [mm], of LDS-02's beam beside the axis
FINE = 4  # rays for each of its samples
BEHIND = 3.0  # [deg] behind the newest ray, as the beam's slant needs rays on both sides
KEPT = 60  # rays, 23 degrees


class Lds01Device(Device):
    """Turns from `b` to `e`."""

    Options = ScanOptions

    def __init__(self, body: EmulatedBody, options: Any, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self._sweep = Sweep(body, 0.12, 3.5)

    @classmethod
    def port(cls, options: Any) -> Port:
        """A serial line at its only speed."""
        return Pty(Path(options.port), lds01.BAUD)

    def feed(self, data: bytes) -> None:
        """Obey the newest command."""
        if data.rfind(lds01.START) > data.rfind(lds01.STOP):
            self._sweep.start(LDS01_HZ * lds01.PACKETS * lds01.SAMPLES, LDS01_HZ)
        elif lds01.STOP in data:
            self._sweep.stop()

    def reset(self) -> None:
        """At rest."""
        self._sweep.stop()

    def step(self, now_ns: int) -> None:
        """All whole packets that were measured meanwhile; the first begins where one does."""
        while samples := self._sweep.take(lds01.SAMPLES):
            first = round(samples[0].angle) - 1
            while first % lds01.SAMPLES:
                samples = samples[1:] + self._sweep.take(1)
                first += 1
            if len(samples) == lds01.SAMPLES and self.sag_volts <= LEAST_VOLTS:
                number = first // lds01.SAMPLES % lds01.PACKETS
                self.wire.write(lds01.encode(_lds01_packet(number, samples)))


class Lds02Device(LdDevice):
    """Sends LD frames of what its lens sees, which stands beside the axis and looks across."""

    baud = 115_200
    samples_hz = 2300
    reach = 0.16, 8.0

    def reset(self) -> None:
        """It starts to turn."""
        self._rays = deque[Sample](maxlen=KEPT)
        self._frame_of: list[Sample] = []
        self._sweep.start(self.samples_hz * FINE, self._turn_hz)

    def step(self, now_ns: int) -> None:
        """All whole frames that were measured meanwhile."""
        while rays := self._sweep.take(FINE):
            self._rays += rays
            if len(self._rays) == KEPT:
                self._frame_of.append(self._by_the_lens((rays[-1].angle - BEHIND) % 360))
            if len(self._frame_of) == ld.POINTS:
                frame, self._frame_of = self._frame(self._frame_of), []
                if self.sag_volts <= LEAST_VOLTS:
                    self.wire.write(ld.encode(frame))

    def _by_the_lens(self, angle: float) -> Sample:
        """What the lens measures when the lidar says `angle` [deg]."""
        distance, seen_at = 0.0, angle
        for _ in range(4):  # where it looks depends on how far it sees; this settles quickly
            distance = self._ray(seen_at).distance
            raw = lens_distance(distance) if distance else 1e6
            seen_at = angle - math.degrees(math.atan2(SLANT * raw + LENS_Y, raw + LENS_X))
        return Sample(angle, lens_distance(distance) if distance else 0.0)

    def _ray(self, angle: float) -> Sample:
        """The ray that was cast nearest to `angle` [deg]."""
        step = 360 * self._turn_hz / self.samples_hz / FINE
        back = (self._rays[-1].angle - angle) % 360
        return self._rays[-1 - min(round(back / step), KEPT - 1)]


class Lds03Device(Device):
    """Turns from its start command to its stop command."""

    Options = ScanOptions

    def __init__(self, body: EmulatedBody, options: Any, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self._sweep = Sweep(body, 0.1, 8.0)
        self.reset()

    @classmethod
    def port(cls, options: Any) -> Port:
        """A serial line at its only speed."""
        return Pty(Path(options.port), lds03.BAUD)

    def reset(self) -> None:
        """At rest."""
        self._heard = b""
        self._waiting: list[Sample] = []
        self._begins = False
        self._sweep.stop()

    def feed(self, data: bytes) -> None:
        """Obey the newest command."""
        self._heard += data
        start, stop = self._heard.rfind(lds03.START), self._heard.rfind(lds03.STOP)
        if start > stop:
            self._sweep.start(LDS03_SAMPLES_HZ, LDS03_HZ)
        elif stop >= 0:
            self._sweep.stop()
        self._heard = b"" if max(start, stop) >= 0 else self._heard[-LONGEST_COMMAND:]

    def step(self, now_ns: int) -> None:
        """All whole packets that were measured meanwhile; none goes across 0 degrees."""
        while samples := self._sweep.take(1):
            wraps = bool(self._waiting) and samples[0].angle < self._waiting[-1].angle
            if wraps or len(self._waiting) == LDS03_POINTS:
                self._send()
                self._begins = wraps
            self._waiting += samples

    def _send(self) -> None:
        points, self._waiting = self._waiting, []
        packet = lds03.Packet(
            begins=self._begins,
            rate=LDS03_HZ if self._begins else 0.0,
            samples=tuple(_lds03_sample(point) for point in points),
        )
        if self.sag_volts <= LEAST_VOLTS:
            self.wire.write(lds03.encode(packet))


def lens_distance(distance: float) -> float:
    """What LDS-02's lens measures of something `distance` [mm] from the axis."""
    a, b = 1 + SLANT**2, LENS_X + SLANT * LENS_Y
    return (math.sqrt(max(b * b - a * (LENS_X**2 + LENS_Y**2 - distance**2), 0.0)) - b) / a


def _lds01_packet(number: int, samples: list[Sample]) -> lds01.Packet:
    ranges = tuple(round(sample.distance) for sample in samples)
    intensities = tuple(INTENSITY if distance else 0 for distance in ranges)
    return lds01.Packet(number, LDS01_HZ * 60, intensities, ranges)


def _lds03_sample(point: Sample) -> lds03.Sample:
    distance = round(point.distance)
    return lds03.Sample(point.angle, distance, QUALITY if distance else 0, reflective=False)
