"""The base of every lidar on a line of its own, how a body carries one, and its scans."""

import abc
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Generic, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gigabrain_drivers import LIDARS, shipped_hosts
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import ScanOptions
from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.body import Lidar, LinkHealth
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import SCAN
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.plugins import load_plugin

Samples = NDArray[np.float64]
Piece = TypeVar("Piece")
MAX_SAMPLES = 20_000  # per turn; the fastest lidar here measures 3200
CLOCKWISE = -math.pi / 180  # from degrees clockwise to radians counter-clockwise
MIN_PERIODS = 0.25  # of the nominal period, for one turn; less is a backlog,
MAX_PERIODS = 3.0  # and more is two turns mixed


class ScanSource(abc.ABC):
    """A lidar that emits one LaserScan per turn, as the body's file describes it.

    Scans run counter-clockwise in `lidar.beams` equal bins, bin 0 around straight ahead: inf where
    the sensor saw no return, nan where it measured nothing. A source whose line is down keeps on
    trying; it never raises.
    """

    Options: ClassVar[type[ScanOptions]] = ScanOptions  # its part of a robot's file
    turns_hz: ClassVar[float | None] = None  # turns a second, where they are fixed
    samples_hz: ClassVar[float | None] = None  # samples a second, where that is known

    def __init__(self, options: Any, lidar: Lidar, clock: Clock) -> None:
        self.options, self.lidar, self.clock = options, lidar, clock
        self.emit: Callable[[LaserScan], None] = lambda scan: None  # the owner puts its own here

    @abc.abstractmethod
    def open(self) -> None:
        """Start connecting in the background. Needs a running event loop."""

    @abc.abstractmethod
    async def close(self) -> None:
        """Bring the lidar to rest and free its port; any number of times, in any state."""

    @property
    @abc.abstractmethod
    def health(self) -> LinkHealth:
        """The state of the line to the lidar."""

    @property
    @abc.abstractmethod
    def problem(self) -> str:
        """The reason in one line why there are no scans, or an empty text."""


def source_class(name: str) -> type[ScanSource]:
    """Return the scan source called `name`: one of ours, or one that a package offers.

    Raises UnknownName listing the known ones, and ConfigError where it cannot be imported.
    """
    source = load_plugin("lidar", name, shipped_hosts(LIDARS), "gigabrain.lidars")
    return cast("type[ScanSource]", source)


def check_turns(name: str, lidar: Lidar | None) -> None:
    """Raise ConfigError where the lidar called `name` cannot make the turns of `lidar`."""
    source = source_class(name)
    turns_hz, samples_hz = source.turns_hz, source.samples_hz
    if lidar and turns_hz and lidar.rate_hz != turns_hz:
        raise ConfigError(
            f"its lidar has rate_hz {lidar.rate_hz:g}, but an {name} makes {turns_hz:g} turns a "
            f"second; beside its `scan` write `lidar:` with rate_hz: {turns_hz:g}"
        )
    if lidar and samples_hz and lidar.beams > samples_hz / lidar.rate_hz:
        raise ConfigError(
            f"its lidar has {lidar.beams} beams, but an {name} at {lidar.rate_hz:g} turns a second "
            f"measures {samples_hz / lidar.rate_hz:.0f} in each; expected no more"
        )


def open_lidar(driver: Driver, clock: Clock) -> ScanSource | None:
    """Open the lidar of `driver`'s link, whose scans become the driver's own; None without one.

    For a driver's `open`; its `close` awaits the `close` of what this returns. Raises ConfigError
    when the body's file does not describe a lidar.
    """
    options: ScanOptions | None = driver.options.scan
    if options is None:
        return None
    lidar = driver.robot.lidar
    if lidar is None:
        raise ConfigError(
            f"{driver.robot.robot_type} has `scan` on its link but no `lidar`; "
            "expected its beams, rate_hz, range_min and range_max"
        )
    source = source_class(options.driver)(options, lidar, clock)

    source.emit = lambda scan: driver.publish("scan", SCAN, scan)
    source.open()
    return source


class TurnBuffer(abc.ABC, Generic[Piece]):
    """The turn that is being measured, in the pieces that came. Its size is bounded."""

    def __init__(self, lidar: Lidar) -> None:
        self._lidar = lidar
        self._period_ns = 1e9 / lidar.rate_hz
        self.clear()

    @abc.abstractmethod
    def unpack(self, pieces: list[Piece]) -> tuple[Samples, Samples]:
        """Angles (n,) [deg] clockwise, and distances (n,) [mm], of all samples in the pieces.

        0 mm where there was no return, nan where it cannot be trusted.
        """

    def clear(self) -> None:
        """Drop what was gathered."""
        self._pieces: list[Piece] = []
        self._count = self._began_ns = self._last_ns = 0
        self._whole = False  # whether it was seen from its start

    def add(self, piece: Piece, count: int, now_ns: int) -> None:
        """Add a piece with `count` samples.

        After a whole turn of silence what was gathered before is dropped.
        """
        silent = self._count and now_ns - self._last_ns > self._period_ns
        if silent or self._count + count > MAX_SAMPLES:
            self.clear()
        if not self._count:
            self._began_ns = now_ns
        self._last_ns = now_ns
        self._pieces.append(piece)
        self._count += count

    def finish(self, now_ns: int) -> LaserScan | None:
        """Return the scan of the turn that ends here; a new one begins.

        None when its start was not seen, and when its bytes came faster or slower than a lidar
        turns: a process that was held up gets what waited in the port at once, and that is old.
        """
        pieces, count, whole = self._pieces, self._count, self._whole
        took = (now_ns - self._began_ns) / self._period_ns
        self.clear()
        self._whole = True
        if not count or not whole or not MIN_PERIODS <= took <= MAX_PERIODS:
            return None
        angles, distances = self.unpack(pieces)
        ranges = np.where(distances == 0.0, np.inf, distances / 1000)
        return bin_scan(self._lidar, angles * CLOCKWISE, ranges)


class SampleBuffer(TurnBuffer[tuple[Sequence[float], Sequence[float]]]):
    """A turn of samples as numbers: angles [deg] clockwise, and distances [mm]."""

    def unpack(
        self, pieces: list[tuple[Sequence[float], Sequence[float]]]
    ) -> tuple[Samples, Samples]:
        """Join the pieces one after the other."""
        angles, distances = map(itertools.chain.from_iterable, zip(*pieces, strict=True))
        return np.fromiter(angles, np.float64), np.fromiter(distances, np.float64)

    def add_samples(
        self,
        angles_deg: Sequence[float],
        distances_mm: Sequence[float],
        turn_at: int | None,
        now_ns: int,
    ) -> LaserScan | None:
        """Add samples (n,) of a lidar that turns clockwise and sends 0 mm for no return.

        `turn_at` is the index of the first that belongs to a new turn; the scan of the turn that
        ends there is returned.
        """
        if turn_at is None:
            self.add((angles_deg, distances_mm), len(angles_deg), now_ns)
            return None
        if turn_at:
            self.add((angles_deg[:turn_at], distances_mm[:turn_at]), turn_at, now_ns)
        scan = self.finish(now_ns)
        rest = angles_deg[turn_at:], distances_mm[turn_at:]
        self.add(rest, len(rest[0]), now_ns)
        return scan


def bin_scan(lidar: Lidar, angles: ArrayLike, ranges: ArrayLike) -> LaserScan:
    """Return one scan of samples (n,) at `angles` [rad] with `ranges` [m], inf for no return.

    Of samples that share a bin the nearest counts. Beyond `range_max` counts as no return; nearer
    than `range_min`, as in the simulation, as being at `range_min`, which is never free space.
    """
    increment = math.tau / lidar.beams
    index = np.rint(np.asarray(angles) / increment).astype(np.intp) % lidar.beams
    values = np.maximum(np.asarray(ranges, np.float64), lidar.range_min)
    values[values > lidar.range_max] = np.inf
    bins = np.full(lidar.beams, np.nan)
    np.fmin.at(bins, index, values)  # fmin: a measured value wins over nan
    return LaserScan(
        angle_min=0.0,
        angle_increment=increment,
        range_min=lidar.range_min,
        range_max=lidar.range_max,
        ranges=ranges_bytes(bins),
    )
