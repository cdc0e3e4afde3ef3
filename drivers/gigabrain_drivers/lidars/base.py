"""What every lidar on a line of its own offers, and how a body carries one."""

import abc
import importlib
from collections.abc import Callable
from typing import Any, ClassVar, cast

from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import ScanOptions
from gigabrain_drivers.lidars import SCAN_SOURCES
from gigabrain_schemas.body import Lidar, LinkHealth
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import SCAN
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError, unknown


class ScanSource(abc.ABC):
    """A lidar that hands over one LaserScan per turn, as the body's file describes it.

    Scans run counter-clockwise in `lidar.beams` equal bins, bin 0 around straight ahead: inf where
    the sensor saw no return, nan where it measured nothing. A source whose line is down goes on
    trying for ever; nothing that comes out of it raises.
    """

    Options: ClassVar[type[ScanOptions]] = ScanOptions  # its part of a robot's file
    turns_hz: ClassVar[float | None] = None  # turns a second, where nobody can change them
    samples_hz: ClassVar[float | None] = None  # samples a second, where that is known

    def __init__(self, options: Any, lidar: Lidar, clock: Clock) -> None:
        self.options, self.lidar, self.clock = options, lidar, clock
        self.emit: Callable[[LaserScan], None] = lambda scan: None  # the owner puts its own here
        self.newest: LaserScan | None = None  # set by `carry`

    @abc.abstractmethod
    def open(self) -> None:
        """Start; returns at once and connects in the background. Needs a running event loop."""

    @abc.abstractmethod
    async def close(self) -> None:
        """Let the lidar come to rest and free its port; any number of times, in any state."""

    @property
    @abc.abstractmethod
    def health(self) -> LinkHealth:
        """How the line to the lidar is doing."""

    @property
    @abc.abstractmethod
    def problem(self) -> str:
        """In one line why there are no scans, or an empty text."""


def source_class(name: str) -> type[ScanSource]:
    """The scan source called `name`. Raises UnknownName listing the known ones."""
    if name not in SCAN_SOURCES:
        raise unknown("lidar", name, SCAN_SOURCES)
    module, _, attribute = SCAN_SOURCES[name].partition(":")
    return cast("type[ScanSource]", getattr(importlib.import_module(module), attribute))


def check_turns(name: str, lidar: Lidar | None) -> None:
    """Raise ConfigError where the lidar called `name` cannot make the turns that `lidar` says."""
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


def carry(driver: Driver, clock: Clock) -> ScanSource | None:
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

    def hand_on(scan: LaserScan) -> None:
        source.newest = scan
        driver.emit(SCAN, scan)

    source.emit = hand_on
    source.open()
    return source
