"""The emulated servo bus with third-party clients, over a real pty.

Each client runs in a separate environment: both SDKs of the vendor have the same import name.
"""

import asyncio
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.places import ROOT
from tests.system.servos import emulated_arm

pytestmark = pytest.mark.qa
PROGRAMS = ROOT / "tests/system/servo_clients"
HOME_TICKS = [2048, 1500, 2500, 2300, 2016, 1600]  # [ticks], start posture
TOLERANCE_TICKS = 8  # play and friction of the gears
MOVE_TIMES_S = [3.0, 20.0]  # the longer one for a busy machine


async def run_client(package: str, program: str, port: Path, seconds: float) -> dict[str, Any]:
    """Run a client, and return the JSON that it prints."""
    uv = [sys.executable, "-m", "uv", "run", "-q", "--isolated", "--no-project"]
    command = [*uv, "--with", package, "python", str(PROGRAMS / program), str(port), str(seconds)]
    client = await asyncio.create_subprocess_exec(
        *command, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    out, error = await client.communicate()
    assert client.returncode == 0, error.decode()
    seen: dict[str, Any] = json.loads(out)
    return seen


async def run_moving_client(package: str, program: str, port: Path) -> dict[str, Any]:
    """Run a client that moves the arm, and return the JSON that it prints.

    Where the arm misses its goals, the client runs again, for longer.
    """
    for seconds in MOVE_TIMES_S:
        async with emulated_arm(port) as (arm, body):
            for joint, servo, at in zip(
                body.free.values(), arm.servos.values(), HOME_TICKS, strict=True
            ):
                joint.position = servo.angle(at)
            arm.reset()
            seen = await run_client(package, program, port, seconds)
        goals = [2200, 1400, 2600, *HOME_TICKS[3:]]
        if all(
            abs(at - goal) <= TOLERANCE_TICKS for at, goal in zip(seen["after"], goals, strict=True)
        ):
            break
    else:
        pytest.fail(f"{seen['after']} instead of {goals}")
    assert seen["before"] == HOME_TICKS
    return seen


@pytest.mark.parametrize(
    ("package", "program"),
    [
        ("feetech-servo-sdk==1.0.0", "feetech_servo_sdk.py"),
        ("ftservo-python-sdk==2.0.1", "ftservo_python_sdk.py"),
    ],
)
async def test_the_vendors_sdk_finds_reads_and_moves_the_arm(
    package: str, program: str, tmp_path: Path
) -> None:
    seen = await run_moving_client(package, program, tmp_path / "base")
    assert seen["models"] == [777] * 6
    assert not any(seen["results"])
    assert seen["missing"] == -6  # there is no status packet


async def test_rustypot_finds_reads_and_moves_the_arm(tmp_path: Path) -> None:
    seen = await run_moving_client("rustypot==1.13.1", "rustypot_client.py", tmp_path / "base")
    assert seen["pinged"] == [True] * 6
    assert seen["models"] == [777] * 6
    assert seen["volts"] == [74] * 6
    assert not seen["missing"]
