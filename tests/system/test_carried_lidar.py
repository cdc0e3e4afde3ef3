from pathlib import Path

import pytest

from gigabrain_drivers import LIDARS
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run, ScanOptions
from gigabrain_drivers.lidars.base import ScanSource, source_class
from gigabrain_drivers.lidars.ld.emulator import LdDevice
from gigabrain_drivers.lidars.rplidar.source import RplidarOptions
from gigabrain_schemas.base import Message
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import SCAN
from gigabrain_zenoh.errors import ConfigError, UnknownName
from gigabrain_zenoh.testing.waiting import until
from tests.system.lidars import agreement, emulated, truth

BODY = """\
summary: a body in memory that carries a lidar
robot_type: carrier
drive_type: differential
max_linear_speed: 0.26
max_angular_speed: 1.82
footprint: [[0.15, 0.15], [-0.15, 0.15], [-0.15, -0.15], [0.15, -0.15]]
"""
LIDAR = "lidar: {beams: 360, rate_hz: 10, range_min: 0.12, range_max: 3.5}\n"


def make_carrier(folder: Path, scan: str, lidar: str = LIDAR) -> Driver:
    path = folder / "robot.yaml"
    path.write_text(f"{BODY}{lidar}real:\n  driver: mock\n  scan: {scan}\n")
    return make_driver(str(path), Run(folder=folder, link="real"))[1]


async def test_a_body_emits_the_scans_of_its_lidar(tmp_path: Path) -> None:
    port = str(tmp_path / "scan")
    driver = make_carrier(tmp_path, f"{{driver: ld19, port: {port}}}")
    scans: list[Message] = []
    driver.emit = lambda topic, message: scans.append(message) if topic is SCAN else None
    async with emulated(LdDevice, ScanOptions(driver="ld19", port=port)), driver:
        await until(lambda: len(scans) >= 2)
        newest = await driver.get_sensor_data("scan")

    assert newest in scans
    assert isinstance(newest, LaserScan)
    assert agreement(newest, truth()) > 0.97


async def test_a_body_opens_and_closes_without_its_lidar(tmp_path: Path) -> None:
    driver = make_carrier(tmp_path, f"{{driver: rplidar, port: {tmp_path}/none, model: c1}}")
    async with driver:
        assert await driver.get_sensor_data("scan") is None
    await driver.close()


def test_lidar_options_have_the_type_of_their_driver(tmp_path: Path) -> None:
    driver = make_carrier(tmp_path, "{driver: rplidar, port: /dev/ttyUSB0, model: s2}")

    assert driver.options.scan == RplidarOptions(
        driver="rplidar", port="/dev/ttyUSB0", model="s2", scan_mode="auto"
    )


@pytest.mark.parametrize(
    ("scan", "expected"),
    [
        ("{driver: rplidar, modell: c1}", "robot.yaml:10: .*modell"),
        ("{driver: rplidar, model: c2}", "robot.yaml:10: .*c2"),
        ("{driver: ld19, model: c1}", "robot.yaml:10: .*model"),
        ("{port: /dev/ttyUSB0}", "robot.yaml:10: .*driver"),
        ("ld19", "robot.yaml:10: "),
    ],
)
def test_unknown_lidar_options_are_refused_with_their_line(
    scan: str, expected: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=expected):
        make_carrier(tmp_path, scan)


def test_an_unknown_lidar_is_refused_with_the_nearest_known_one(tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match="no lidar 'ld18'; did you mean 'ld19'"):
        make_carrier(tmp_path, "{driver: ld18}")


async def test_a_scan_driver_without_a_lidar_description_is_refused(tmp_path: Path) -> None:
    driver = make_carrier(tmp_path, "{driver: ld19}", lidar="")

    with pytest.raises(ConfigError, match="has `scan` on its link but no `lidar`"):
        await driver.open()


@pytest.mark.parametrize("name", sorted(LIDARS))
def test_every_listed_lidar_can_be_loaded(name: str) -> None:
    assert issubclass(source_class(name), ScanSource)
