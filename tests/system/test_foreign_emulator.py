"""A package may bring the emulator of its driver: entry point `gigabrain.emulators`."""

from pathlib import Path

import pytest

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.emulator import device_class
from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.errors import UnknownName
from gigabrain_zenoh.qa.conformance.driver_checks import CheckedRobot, DriverSession

NAME = "foreign_base"
DRIVER = '''"""Somebody's driver, and the board that it talks to."""

from gigabrain_drivers.bodies.line.emulator import LineBase
from gigabrain_drivers.bodies.line.driver import LineDriver


class ForeignDriver(LineDriver):
    """A body on a line."""


class ForeignBoard(LineBase):
    """Its electronics."""

    watchdog_ns = 80_000_000
    promised_in = "its data sheet"
'''
ENTRY_POINTS = f"""[gigabrain.drivers]
{NAME} = {NAME}_driver:ForeignDriver
[gigabrain.emulators]
{NAME} = {NAME}_driver:ForeignBoard
"""


@pytest.fixture
def package(site: Path) -> Path:
    """Write the package and its metadata into `site`, as pip does; return the package's folder."""
    folder = site / f"{NAME}_driver"
    info = site / f"{NAME}-1.0.dist-info"
    folder.mkdir()
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {NAME}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (folder / "__init__.py").write_text(DRIVER)
    ours = catalog.robot_path("mycustombot")
    (folder / "model.xml").write_text((ours.parent / "model.xml").read_text())
    text = ours.read_text().replace("robot_type: mycustombot", f"robot_type: {NAME}")
    (folder / "robot.yaml").write_text(text.replace("driver: line", f"driver: {NAME}"))
    return folder


async def test_a_packaged_driver_drives_the_packaged_emulator(package: Path) -> None:
    async with CheckedRobot(NAME, "emulated", package / "run") as subject:
        assert subject.promise == "80 ms (its data sheet)"
        async with DriverSession(subject) as session:
            await session.connected()
            session.wanted = Velocity(linear_x=0.2)
            assert await session.until(lambda: subject.commanded(None)[0] == 0.2, 100) is not None


def test_a_packaged_emulator_is_found_by_the_name_of_its_driver(package: Path) -> None:
    assert device_class(NAME).__name__ == "ForeignBoard"
    robot, driver = catalog.make_driver(NAME, Run(folder=Path(), link="real"))
    assert (robot.robot_type, type(driver).__name__) == (NAME, "ForeignDriver")


def test_a_driver_without_an_emulator_is_named(package: Path) -> None:
    with pytest.raises(
        UnknownName, match="no emulator for driver 'forein_base'; did you mean 'foreign_base'"
    ):
        device_class("forein_base")
