"""A whole emulated robot: one body in MuJoCo, a station for each of its links."""

import contextlib
import functools
import importlib
from collections.abc import Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, Self

import msgspec

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import LinkOptions, Run
from gigabrain_drivers.emulators import DEVICES
from gigabrain_drivers.emulators.base import Broken, Device, EmulatedBody
from gigabrain_drivers.emulators.claim import claimed, no_ports
from gigabrain_drivers.emulators.faults import NONE, Faults, faults_in
from gigabrain_drivers.emulators.physics import emulated_body
from gigabrain_drivers.emulators.station import Station
from gigabrain_drivers.emulators.tcp import TcpPort
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import unknown

BASE, SCAN = "base", "scan"


class Emulator:
    """The robot called `name`. Used as `async with`; its ports are there inside.

    `run` says in which world, with which seed, and in which folder its ports appear.
    """

    def __init__(self, name: str, run: Run) -> None:
        _, _, options, _ = catalog.load_link(name, msgspec.structs.replace(run, link="emulated"))
        self.body: EmulatedBody = emulated_body(name, run)
        self.ports, self._folder = _ports(options), run.emulator
        self._claim = contextlib.ExitStack()
        clock = Clock()
        self.stations: dict[str, Station] = {}
        for station, its in _parts(options).items():
            device = device_class(its.driver)
            make = functools.partial(device, self.body, its)
            self.stations[station] = Station(make, device.port(its), clock)

    async def __aenter__(self) -> Self:
        folder = Path(self._folder)
        if self._folder:
            self._claim.enter_context(claimed(folder))
        try:
            for station in self.stations.values():
                station.start()
        except OSError as error:
            await self._end()
            raise no_ports(folder, error) from None
        self.body.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._end()

    async def _end(self) -> None:
        for station in self.stations.values():
            await station.close()
        await self.body.close()
        self._claim.close()

    def set(self, faults: Mapping[str, Faults]) -> None:
        """Have these faults, by station, and no others."""
        for name, station in self.stations.items():
            wanted = faults.get(name, NONE)
            if wanted != station.faults:
                station.set(wanted)
        body = faults.get(BASE, NONE)
        self.body.break_down(Broken(body.runaway, body.stuck_wheel, body.frozen_values))

    def report(self) -> Mapping[str, float | int | str | None]:
        """The truth of the run so far, and whether this machine has kept the body waiting."""
        return self.body.report()

    def told(self) -> str:
        """The faults that it has now, in the words of `faults_of`."""
        parts = [f"{name} {s.faults}" for name, s in self.stations.items() if s.faults != NONE]
        return "; ".join(parts) or "none"

    def faults_of(self, words: str) -> dict[str, Faults]:
        """The faults in `[STATION] FAULT[=VALUE] ...`; for all stations where none is named.

        Nothing, or `off`, is no fault. Raises ConfigError naming what there is.
        """
        named = words.split()
        wanted = list(self.stations)
        if named and named[0] in self.stations:
            wanted = [named.pop(0)]
        faults = faults_in(named, self.stations)
        now = {name: station.faults for name, station in self.stations.items()}
        return {**now, **dict.fromkeys(wanted, faults)}


def device_class(driver: str) -> type[Device]:
    """The device that answers a driver or a scan source, ours or an installed package's.

    Packages offer theirs in the group `gigabrain.emulators`. Raises UnknownName.
    """
    offered = {point.name: point for point in entry_points(group="gigabrain.emulators")}
    if driver not in DEVICES and driver in offered:
        return offered[driver].load()  # type: ignore[no-any-return]
    if driver not in DEVICES:
        raise unknown("emulator for driver", driver, [*DEVICES, *offered])
    module, _, attribute = DEVICES[driver].partition(":")
    return getattr(importlib.import_module(module), attribute)  # type: ignore[no-any-return]


def wire_of(name: str) -> Literal["serial", "tcp", ""]:
    """What an emulated robot's base is plugged into; nothing where it cannot be emulated.

    Raises ConfigError, and UnknownName.
    """
    if "emulated" not in catalog.links_of(catalog.load_robot(name)):
        return ""
    run = Run(folder=Path(), link="emulated")
    _, _, options, _ = catalog.load_link(name, run)
    port = device_class(options.driver).port(options)
    return "tcp" if isinstance(port, TcpPort) else "serial"


def _parts(options: LinkOptions) -> dict[str, Any]:
    """Each station's options."""
    return {BASE: options, **({SCAN: options.scan} if options.scan else {})}


def _ports(options: LinkOptions) -> dict[str, str]:
    """Where each station is to be found."""
    return {name: str(getattr(its, "port", "")) for name, its in _parts(options).items()}
