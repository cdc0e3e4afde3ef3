"""What is checked: one robot on one link, with the peer that is at the other end of it."""

from pathlib import Path
from types import TracebackType
from typing import Self

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.base import Device
from gigabrain_drivers.emulators.emulator import BASE, Emulator
from gigabrain_drivers.links.link import Link
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gate.state import at_rest
from gigabrain_zenoh.qa.conformance.result import NotApplicable

REST_SPEED = 0.02  # [m/s], of the true body, below which it stands
WORLD = "arena"


class Subject:
    """A robot by name or by its file. Used as `async with`; its emulator runs inside.

    `folder` is for ports and for what the gate remembers.
    """

    def __init__(self, name: str, link: LinkName, folder: Path) -> None:
        if link == "real":
            raise ConfigError("the kit drives at once; it is for the links sim and emulated")
        self.name, self.link, self.folder = name, link, folder
        self.run = Run(folder=folder, link=link, world=WORLD, emulator=str(folder / "ports"))
        self.robot, _, _, _ = catalog.load_link(name, self.run)
        self._emulator: Emulator | None = None
        self._way = -1

    async def __aenter__(self) -> Self:
        if self.link == "emulated":
            self._emulator = await Emulator(self.name, self.run).__aenter__()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._emulator:
            await self._emulator.__aexit__(kind, error, traceback)

    def driver(self) -> Driver:
        """A new driver, not opened yet."""
        return catalog.make_driver(self.name, self.run)[1]

    def way(self) -> int:
        """1 or -1, the other one each time: who drives to and fro does not come to a wall."""
        self._way = -self._way
        return self._way

    @property
    def has_peer(self) -> bool:
        """Whether there is somebody at the other end of a line."""
        return self._emulator is not None

    @property
    def peer(self) -> Emulator:
        """The other end of the line. Raises NotApplicable where there is none."""
        if self._emulator is None:
            raise NotApplicable(f"link {self.link} has no peer that could fail")
        return self._emulator

    def faults(self, words: str) -> None:
        """Have these faults at the base's end of the line; none for an empty text."""
        self.peer.set(self.peer.faults_of(f"{BASE} {words}"))

    @property
    def promise(self) -> str:
        """After how long without a command the body's own firmware stops its motors."""
        device = type(self._emulator.stations[BASE].device) if self._emulator else Device
        return f"{device.watchdog_ns / 1e6:.0f} ms ({device.promised_in})"

    @property
    def promised_ms(self) -> float:
        """The same as a number [ms]."""
        return self.peer.stations[BASE].device.watchdog_ns / 1e6

    def told(self, state: RobotState | None) -> tuple[float, float, float]:
        """What the motors are told now, as the peer knows it, or as the body moves without one."""
        if self._emulator:
            return self._emulator.body.commanded
        velocity = state.velocity if state else None
        return (velocity.linear_x, velocity.linear_y, velocity.angular_z) if velocity else (0, 0, 0)

    def rests(self, state: RobotState | None) -> bool:
        """Whether the body stands still in truth, or as it says where nobody knows the truth."""
        if self._emulator is None:
            return state is not None and at_rest(state.velocity)
        speed = self._emulator.body.report().get("true_speed")
        still = isinstance(speed, float | int) and abs(speed) < REST_SPEED
        return still and not any(self._emulator.body.commanded)


def link_of(driver: Driver) -> Link:
    """The line of a driver, which it keeps in `link`. Raises NotApplicable."""
    link = getattr(driver, "link", None)
    if not isinstance(link, Link):
        raise NotApplicable("the driver keeps no Link in `link`: no bytes to look at")
    return link
