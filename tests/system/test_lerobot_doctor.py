"""lerobot-doctor examines one of our datasets, in a separate environment."""

import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import GateStatus, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_zenoh import codec
from gigabrain_zenoh.recording.lerobot import convert
from tests.unit.recording import bags
from tests.unit.recording.test_bag_lerobot_video import TICK_NS, pictures, write

pytestmark = pytest.mark.qa
DOCTOR = "lerobot-doctor==0.2.0"


def winding_drive(states: int) -> Iterator[tuple[int, str, bytes]]:
    """Yield states, commands and scans of a drive in which all values change."""
    for seq in range(1, states + 1):
        seconds = seq / 50
        speeds = 0.2 * math.sin(seconds), 0.1 * math.cos(1.3 * seconds), 0.5 * math.sin(seconds / 2)
        command = CmdVel(
            linear_x=speeds[0], linear_y=speeds[1], angular_z=speeds[2], source="control"
        )
        yield seq * TICK_NS - 2, "robot/cmd_vel", codec.encode(command)
        if seq % 5 == 0:
            yield seq * TICK_NS - 1, "robot/scan", bags.scan(seq)
        state = RobotState(
            boot=7, tick=seq, basis=seq, robot_type="mecanum_cart",
            pose=Pose(x=math.sin(seconds / 3), y=seconds / 20, yaw=math.sin(seconds / 5)),
            velocity=Velocity(linear_x=speeds[0], linear_y=speeds[1], angular_z=speeds[2]),
            gate=GateStatus(mode="enabled"),
        )  # fmt: skip
        yield seq * TICK_NS, "robot/state", codec.encode(state)


def test_lerobot_doctor_finds_no_fault_in_our_dataset(tmp_path: Path) -> None:
    path, folder = tmp_path / "a.mcap", tmp_path / "dataset"
    ticks = range(5, 1001, 5)
    write(path, winding_drive(1000), pictures(ticks), pictures(ticks, "robot/depth/front"))
    convert(path, folder)
    command = [sys.executable, "-m", "uv", "tool", "run", DOCTOR, "check", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert "[PASS] Video Integrity" in done.stdout, done.stderr
    assert "WARN" not in done.stdout, done.stdout
    assert "FAIL" not in done.stdout, done.stdout
