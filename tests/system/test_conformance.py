"""Every robot of the package passes the driver author's kit, on every link without hardware."""

import asyncio
import types
from asyncio.subprocess import Process
from pathlib import Path
from unittest import mock

import pytest

from gigabrain_drivers.driver.catalog import load_robot, robot_files, robot_links
from gigabrain_zenoh.qa.conformance import gate_checks, kit
from gigabrain_zenoh.qa.conformance.driver_checks import CheckedRobot
from gigabrain_zenoh.qa.conformance.gate_checks import driver_killed
from gigabrain_zenoh.qa.judging import Failed

QUICK = ("mock", "mycustombot", "so101")  # other robots only in `make qa`
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
async def test_every_robot_passes_the_conformance_kit(
    name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    links = [link for link in robot_links(load_robot(name)) if link != "real"]
    checked = [  # one at a time: a simulation in lock-step would slow down an emulator
        await kit.check(name, link, tmp_path / link, lambda result: None) for link in links
    ]
    assert "dropped a message" not in caplog.text  # the kit's invalid messages are not logged
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
        await driver_killed(robot)  # raises Failed if the wheels keep turning


async def test_a_driver_that_does_not_start_fails_at_once_with_its_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gate_checks, "__name__", "no_such_module")  # the child runs this module
    async with CheckedRobot("mycustombot", "emulated", tmp_path) as robot:
        with pytest.raises(Failed, match="the driver ended with exit code 1 before it drove"):
            await driver_killed(robot)


async def test_a_commander_that_already_ended_is_not_killed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gate_checks, "COMMANDER", "")
    start, started = asyncio.create_subprocess_exec, list[Process]()

    async def record(*command: str, stdout: int) -> Process:
        started.append(await start(*command, stdout=stdout))
        return started[0]

    gated = types.SimpleNamespace(wanted=None)
    with mock.patch.object(asyncio, "create_subprocess_exec", record):
        async with gate_checks._commander(gated):  # type: ignore[arg-type]
            await started[0].wait()
    assert started[0].returncode == 0
