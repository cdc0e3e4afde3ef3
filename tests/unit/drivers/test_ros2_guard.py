"""The driver's side of a ROS 2 robot's guard: a failed guard is reported and restarted."""

import sys
from pathlib import Path

import pytest

from gigabrain_drivers.bodies.ros2 import guard as guards
from gigabrain_drivers.bodies.ros2.guard import Guard
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.testing.waiting import until
from tests.unit.drivers.test_ros2_options import ROBOT, options_of

GOOD = "#!/bin/sh\necho 1\ncat > /dev/null\n"


@pytest.mark.parametrize(
    ("program", "fault"),
    [
        (None, "cannot be started: no such file or folder; check the path"),
        ("#!/bin/sh\necho hello\n", "printed something other than a number"),
        ("#!/bin/sh\nprintf '%070000d'\n", "printed something other than a number"),
        ("#!/bin/sh\n", "has ended"),
    ],
)
async def test_a_failed_guard_is_reported_and_restarted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str | None, fault: str
) -> None:
    monkeypatch.setattr(guards, "RESTART_NS", 1_000_000)
    file = tmp_path / "guard"
    monkeypatch.setattr(sys, "executable", str(file))
    if program:
        file.write_text(program)
        file.chmod(0o755)
    guard = Guard(options_of(tmp_path, ROBOT), Clock(), lambda: True)
    assert "is starting" in guard.problem
    guard.open()
    await until(lambda: fault in guard.problem, fault)
    good = tmp_path / "good"
    good.write_text(GOOD)
    good.chmod(0o755)
    good.replace(file)
    await until(lambda: not guard.problem, "a guard that works")
    await guard.close()
