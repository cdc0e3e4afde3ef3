"""A package may bring a lidar: entry points `gigabrain.lidars` and `gigabrain.emulators`."""

from pathlib import Path

import pytest

from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.emulator import device_class
from gigabrain_drivers.lidars.base import source_class
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.errors import ConfigError, UnknownName
from gigabrain_zenoh.testing.waiting import until
from tests.system.lidars import agreement, emulated, truth

NAME = "foreign_lidar"
SOURCE = '''"""A lidar on a serial line, and the lidar itself."""

from gigabrain_drivers.driver.robot import ScanOptions
from gigabrain_drivers.lidars.ld.emulator import LdDevice
from gigabrain_drivers.lidars.ld.source import Ld


class ForeignOptions(ScanOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Its part of a robot's file."""

    mirrored: bool = False


class ForeignLidar(Ld):
    """The host's end."""

    Options = ForeignOptions
    name, rate_baud = "foreign lidar", 230_400


class ForeignDevice(LdDevice):
    """Its electronics."""

    Options = ForeignOptions
'''
ENTRY_POINTS = f"""[gigabrain.lidars]
{NAME} = {NAME}_source:ForeignLidar
lost_lidar = {NAME}_source:LostLidar
[gigabrain.emulators]
{NAME} = {NAME}_source:ForeignDevice
"""
BODY = """\
summary: a body in memory that carries the lidar of a package
robot_type: carrier
drive_type: differential
max_linear_speed: 0.26
max_angular_speed: 1.82
footprint: [[0.15, 0.15], [-0.15, 0.15], [-0.15, -0.15], [0.15, -0.15]]
lidar: {beams: 360, rate_hz: 10, range_min: 0.12, range_max: 3.5}
real:
  driver: mock
"""


@pytest.fixture(autouse=True)
def package(site: Path) -> None:
    """Write the package's module and metadata into `site`, as pip does."""
    info = site / f"{NAME}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {NAME}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (site / f"{NAME}_source.py").write_text(SOURCE)


async def test_a_body_can_use_a_packaged_lidar(tmp_path: Path) -> None:
    file, port = tmp_path / "robot.yaml", tmp_path / "scan"
    file.write_text(f"{BODY}  scan: {{driver: {NAME}, port: {port}, mirrored: true}}\n")
    _, driver = make_driver(str(file), Run(folder=tmp_path, link="real"))
    assert driver.options.scan.mirrored
    scans: list[LaserScan] = []
    driver.emit = lambda _, message: scans.append(message)  # type: ignore[arg-type]
    async with emulated(device_class(NAME), driver.options.scan), driver:
        await until(lambda: len(scans) >= 2)
    assert agreement(scans[-1], truth()) > 0.97


def test_the_name_of_a_packaged_lidar_is_suggested_if_misspelt() -> None:
    with pytest.raises(UnknownName, match="no lidar 'forein_lidar'; did you mean 'foreign_lidar'"):
        source_class("forein_lidar")


def test_a_missing_class_of_a_package_is_named() -> None:
    with pytest.raises(ConfigError, match="lidar 'lost_lidar' of foreign_lidar_source:LostLidar"):
        source_class("lost_lidar")
