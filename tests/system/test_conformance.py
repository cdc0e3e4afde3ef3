"""Every robot of the package passes the driver author's kit, on every link without hardware."""

from pathlib import Path

import pytest

from gigabrain_drivers.driver.catalog import load_robot, robot_files, robot_links
from gigabrain_zenoh.qa.conformance import kit
from gigabrain_zenoh.qa.conformance.driver_checks import CheckedRobot
from gigabrain_zenoh.qa.conformance.gate_checks import driver_killed

QUICK = ("mock", "mycustombot", "so101")  # the others in `make qa`
BODIES = [
    pytest.param(name, marks=() if name in QUICK else pytest.mark.qa) for name in robot_files()
]
NEEDS_A_PEER = {
    "stops when it is killed",
    "stops unplugged",
    "stops on a frozen peer",
    "reconnects",
    "command to byte",
}


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.slow
async def test_every_robot_passes_the_kit(
    name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    links = [link for link in robot_links(load_robot(name)) if link != "real"]
    checked = [  # not at once: a simulation in lock-step takes the time that an emulator needs
        await kit.check(name, link, tmp_path / link, lambda result: None) for link in links
    ]
    assert "dropped a message" not in caplog.text  # the kit's own are not said
    for link, results in zip(links, checked, strict=True):
        assert [result for result in results if result.verdict == "FAILED"] == []
        robot = load_robot(name)
        base, joints = robot.drive_type != "arm", bool(robot.joints)
        assert len(results) == 2 + 14 * base + 7 * joints
        not_applicable = {
            result.check
            for result in results
            if result.verdict == "skipped" and "too busy to judge" not in result.measured
        }
        assert not_applicable == (NEEDS_A_PEER if link == "sim" and base else set())


async def test_wheels_without_a_watchdog_are_stopped_when_their_driver_is_killed(
    tmp_path: Path,
) -> None:
    async with CheckedRobot("lekiwi", "emulated", tmp_path) as robot:
        assert robot.goes_on
        await driver_killed(robot)  # raises Failed if they turn on
