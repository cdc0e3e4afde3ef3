"""Base class of lidars on their own line, and conversion of their samples to scans."""

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
MIN_PERIODS = 0.25  # shortest turn, in nominal periods; a shorter one is a backlog,
MAX_PERIODS = 3.0  # and a longer one is two turns mixed


class ScanSource(abc.ABC):
    """A lidar that emits one LaserScan per turn, as the body's file describes it.

    Scans run counter-clockwise in `lidar.beams` equal bins; bin 0 is centered straight ahead. A
    range is inf without a return, and nan without a measurement. A source never raises: it keeps
    trying to connect.
    """

    Options: ClassVar[type[ScanOptions]] = ScanOptions  # the `scan` part of a robot's file
    turns_hz: ClassVar[float | None] = None  # turns per second, if fixed
    samples_hz: ClassVar[float | None] = None  # samples per second, if known

    def __init__(self, options: Any, lidar: Lidar, clock: Clock) -> None:
        self.options, self.lidar, self.clock = options, lidar, clock
        self.emit: Callable[[LaserScan], None] = lambda scan: None  # set by the owner

    @abc.abstractmethod
    def open(self) -> None:
        """Start connecting in the background. Needs a running event loop."""

    @abc.abstractmethod
    async def close(self) -> None:
        """Stop the lidar and free its port. May be called any number of times, in any state."""

    @property
    @abc.abstractmethod
    def health(self) -> LinkHealth:
        """The state of the line to the lidar."""

    @property
    @abc.abstractmethod
    def problem(self) -> str:
        """The reason in one line why there are no scans; empty while there are."""


def source_class(name: str) -> type[ScanSource]:
    """Return the scan source called `name`: one from `LIDARS`, or from another package.

    Raises UnknownName, which lists the known ones, or ConfigError if it cannot be imported.
    """
    source = load_plugin("lidar", name, shipped_hosts(LIDARS), "gigabrain.lidars")
    return cast("type[ScanSource]", source)


def check_turns(name: str, lidar: Lidar | None) -> None:
    """Raise ConfigError if a lidar called `name` cannot have the rate and beams of `lidar`."""
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
    """Open the lidar of `driver`'s link, and publish its scans as the driver's; None without one.

    A driver calls this in `open`, and must close the returned source in its `close`. Raises
    ConfigError if the body's file does not describe a lidar.
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
    """Collects the pieces of the current turn. Its size is bounded."""

    def __init__(self, lidar: Lidar) -> None:
        self._lidar = lidar
        self._period_ns = 1e9 / lidar.rate_hz
        self.clear()

    @abc.abstractmethod
    def unpack(self, pieces: list[Piece]) -> tuple[Samples, Samples]:
        """Return angles (n,) [deg] clockwise, and distances (n,) [mm], of all samples.

        A distance is 0 without a return, and nan if it is not reliable.
        """

    def clear(self) -> None:
        """Drop all pieces."""
        self._pieces: list[Piece] = []
        self._count = self._began_ns = self._last_ns = 0
        self._start_seen = False  # False for the first turn after a gap

    def add(self, piece: Piece, count: int, now_ns: int) -> None:
        """Add a piece with `count` samples. Older pieces are dropped after a turn of silence."""
        silent = self._count and now_ns - self._last_ns > self._period_ns
        if silent or self._count + count > MAX_SAMPLES:
            self.clear()
        if not self._count:
            self._began_ns = now_ns
        self._last_ns = now_ns
        self._pieces.append(piece)
        self._count += count

    def finish(self, now_ns: int) -> LaserScan | None:
        """Return the scan of the turn that ends now, and begin a new turn.

        Return None if the start of the turn was not seen, or it was much too short or too long.
        After a delay of the process, old bytes arrive from the port at once.
        """
        pieces, count, start_seen = self._pieces, self._count, self._start_seen
        periods = (now_ns - self._began_ns) / self._period_ns
        self.clear()
        self._start_seen = True
        if not count or not start_seen or not MIN_PERIODS <= periods <= MAX_PERIODS:
            return None
        angles, distances = self.unpack(pieces)
        ranges = np.where(distances == 0.0, np.inf, distances / 1000)
        return bin_scan(self._lidar, angles * CLOCKWISE, ranges)


class SampleBuffer(TurnBuffer[tuple[Sequence[float], Sequence[float]]]):
    """Collects a turn as sequences of angles [deg] clockwise, and distances [mm]."""

    def unpack(
        self, pieces: list[tuple[Sequence[float], Sequence[float]]]
    ) -> tuple[Samples, Samples]:
        """Join the pieces in order."""
        angles, distances = map(itertools.chain.from_iterable, zip(*pieces, strict=True))
        return np.fromiter(angles, np.float64), np.fromiter(distances, np.float64)

    def add_samples(
        self,
        angles_deg: Sequence[float],
        distances_mm: Sequence[float],
        turn_at: int | None,
        now_ns: int,
    ) -> LaserScan | None:
        """Add samples (n,) of a lidar that turns clockwise; 0 mm means no return.

        `turn_at` is the index of the first sample of a new turn, if one begins. Then the scan of
        the ended turn is returned.
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
    """Return one scan of samples (n,) at `angles` [rad] with `ranges` [m]; inf means no return.

    The nearest sample in a bin counts. A range above `range_max` counts as no return. A range
    below `range_min` becomes `range_min`, as in the simulation, because it is not free space.
    """
    increment = math.tau / lidar.beams
    index = np.rint(np.asarray(angles) / increment).astype(np.intp) % lidar.beams
    values = np.maximum(np.asarray(ranges, np.float64), lidar.range_min)
    values[values > lidar.range_max] = np.inf
    bins = np.full(lidar.beams, np.nan)
    np.fmin.at(bins, index, values)  # fmin ignores nan
    return LaserScan(
        angle_min=0.0,
        angle_increment=increment,
        range_min=lidar.range_min,
        range_max=lidar.range_max,
        ranges=ranges_bytes(bins),
    )
