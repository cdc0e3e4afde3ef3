"""AgileX Piper: driver and emulator on a CAN bus, both judged by the vendor's SDK."""

import asyncio
import contextlib
import json
import math
import os
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from gigabrain_drivers.bodies.piper.driver import PiperDriver
from gigabrain_drivers.driver.catalog import load_robot, make_driver, robot_path
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.emulator import Emulator
from gigabrain_drivers.links.can_link import read_address
from gigabrain_zenoh.testing.waiting import until
from tests.ros2 import foreign

PACKAGES = ("piper_sdk==0.6.2", "python-can>=4.4,<5", "msgpack>=1.0")
JUDGE = Path(__file__).with_name("piper_judge.py")
DRIVER = """
import asyncio, sys
from pathlib import Path
from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run

async def drive():
    _, driver = make_driver("piper", Run(folder=Path(), link="emulated", emulator=sys.argv[1]))
    async with driver:
        while driver.problem:
            await asyncio.sleep(0.02)
        for tick in range(5000):
            await driver.set_joint_positions({"joint1": min(0.01 * tick, 2.5)})
            await asyncio.sleep(0.02)

asyncio.run(drive())
"""  # at 0.5 rad/s
HOME = load_robot("piper").arm.home[:6]  # type: ignore[union-attr]


@pytest.fixture(scope="module")
def python() -> Path:
    return foreign.built(lambda: foreign.environment("piper_sdk", PACKAGES))


@pytest.fixture(name="run")
def make_run(tmp_path: Path) -> Run:
    return Run(folder=tmp_path, link="emulated", emulator=str(tmp_path / "ports"))


@pytest.fixture(name="emulator")
async def make_emulator(run: Run) -> AsyncIterator[Emulator]:
    async with Emulator("piper", run) as emulator:
        yield emulator


@contextlib.asynccontextmanager
async def driver_of(run: Run) -> AsyncIterator[PiperDriver]:
    _, driver = make_driver("piper", run)
    assert isinstance(driver, PiperDriver)
    async with driver:
        await until(lambda: driver.problem == "")
        yield driver


async def angles(driver: PiperDriver) -> list[float]:
    return [joint.position for joint in (await driver.read_state()).joints[:6]]


async def start_judge(
    python: Path, *words: str, address: tuple[str, int] | None = None, given: Any = None
) -> asyncio.subprocess.Process:  # fmt: skip
    config = {"port": address[1], "hop_limit": 0} if address else {}
    return await asyncio.create_subprocess_exec(
        python, JUDGE, *words, env={**os.environ, "CAN_CONFIG": json.dumps(config)},
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip


async def result_of(process: asyncio.subprocess.Process, given: Any = None) -> Any:
    out, _ = await process.communicate(json.dumps(given).encode() if given else b"")
    (line,) = [line for line in out.decode().splitlines() if line.startswith("JSON ")]
    return json.loads(line.removeprefix("JSON "))


async def test_the_vendors_sdk_drives_the_emulated_arm(python: Path, emulator: Emulator) -> None:
    group, port = read_address(Path(emulator.ports["base"]))
    results = await result_of(await start_judge(python, "drive", group, address=(group, port)))
    assert results.pop("first") == pytest.approx(HOME, abs=0.01)
    assert results.pop("volts") == pytest.approx(24.0)
    assert 20 < results.pop("celsius") < 60
    assert results.pop("status") == [1, 0, 1]
    assert results.pop("on") == [True] * 6
    assert results == dict.fromkeys(results, True)
    assert len(results) == 11


async def test_the_vendors_sdk_reads_what_the_driver_commands(
    python: Path, emulator: Emulator, run: Run
) -> None:
    address = read_address(Path(emulator.ports["base"]))
    wanted = {"joint1": 0.3, "joint4": -0.2, "joint6": 1.0, "gripper": 0.02}
    async with driver_of(run) as driver:
        process = await start_judge(python, "listen", address[0], "4", address=address)
        assert process.stdout
        while b"listening" not in await process.stdout.readline():
            pass
        results = asyncio.create_task(result_of(process))
        while not results.done():
            await driver.set_joint_positions(wanted)
            await asyncio.sleep(0.02)
        measured = await angles(driver)
    goal = [0.3, *HOME[1:3], -0.2, HOME[4], 1.0]
    assert results.result()["joints"] == pytest.approx(goal, abs=0.01)
    assert results.result()["measured"] == pytest.approx(measured, abs=0.01)
    assert results.result()["gripper"] == [40_000, 1000, 1]
    assert results.result()["mode"] == [1, 1, 100, 0]


async def test_the_model_has_the_kinematics_of_the_vendors_sdk(python: Path) -> None:
    robot, noise = load_robot("piper"), np.random.default_rng(7)
    limits = np.array([(joint.lower, joint.upper) for joint in robot.joints[:6]])
    postures = noise.uniform(*limits.T, (200, 6))
    poses = await result_of(await start_judge(python, "kinematics"), postures.tolist())
    model = mujoco.MjModel.from_xml_path(str(robot_path("piper").with_name("model.xml")))
    data, worst_mm, worst_deg = mujoco.MjData(model), 0.0, 0.0
    for posture, pose in zip(postures, poses, strict=True):
        data.qpos[:6] = posture
        mujoco.mj_kinematics(model, data)
        link = data.body("link6")
        worst_mm = max(worst_mm, float(np.abs(link.xpos * 1e3 - pose[:3]).max()))
        turn = np.empty(9)
        roll, pitch, yaw = np.radians(pose[3:])
        quat = np.empty(4)
        mujoco.mju_euler2Quat(quat, np.array([roll, pitch, yaw]), "XYZ")
        mujoco.mju_quat2Mat(turn, quat)
        cosine = (np.trace(turn.reshape(3, 3).T @ link.xmat.reshape(3, 3)) - 1) / 2
        worst_deg = max(worst_deg, math.degrees(math.acos(min(1.0, max(-1.0, cosine)))))
    assert worst_mm < 0.01
    assert worst_deg < 0.01


async def test_opening_and_closing_the_driver_moves_the_arm_by_less_than_half_a_degree(
    emulator: Emulator, run: Run
) -> None:
    before = [motor.position for motor in emulator.body.joints[:6]]
    async with driver_of(run) as driver:
        await asyncio.sleep(0.5)
        assert await angles(driver) == pytest.approx(before, abs=math.radians(0.5))
    await asyncio.sleep(0.3)
    after = [motor.position for motor in emulator.body.joints[:6]]
    assert after == pytest.approx(before, abs=math.radians(0.5))


async def test_the_arm_holds_while_unplugged_and_is_found_again(
    emulator: Emulator, run: Run
) -> None:
    async with driver_of(run) as driver:
        emulator.set(emulator.parse_faults("base unplugged"))
        await until(lambda: "is the emulator running" in driver.problem)
        assert not (await driver.read_state()).link.connected
        emulator.set(emulator.parse_faults("base off"))
        await until(lambda: driver.problem == "")
        assert (await angles(driver)) == pytest.approx(HOME, abs=math.radians(0.5))
        assert (await driver.read_state()).link.reconnects == 1


async def test_a_killed_driver_leaves_the_arm_held(emulator: Emulator, run: Run) -> None:
    child = await asyncio.create_subprocess_exec(
        sys.executable, "-c", DRIVER, run.emulator,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    try:
        await until(lambda: emulator.body.joints[0].velocity > 0.3, "it moves", 60.0)
    finally:
        child.kill()
        await child.wait()
    at_kill = emulator.body.joints
    await until(lambda: all(abs(motor.velocity) < 0.01 for motor in emulator.body.joints))
    for _ in range(20):
        await asyncio.sleep(0.05)
        now = [motor.position for motor in emulator.body.joints]
        assert now[1:3] == pytest.approx(HOME[1:3], abs=math.radians(2))  # the joints under gravity
        assert abs(now[0] - at_kill[0].position) < 0.5 * 0.2  # near its last target


async def test_a_limp_arm_falls_and_a_frozen_arm_holds(emulator: Emulator, run: Run) -> None:
    async with driver_of(run) as driver:
        emulator.set(emulator.parse_faults("base frozen"))
        await until(lambda: driver.problem != "")
        await driver.set_joint_positions({"joint2": 0.2})
        await asyncio.sleep(0.5)
        held = [motor.position for motor in emulator.body.joints[:6]]
        assert held == pytest.approx(HOME, abs=math.radians(0.5))
        emulator.set(emulator.parse_faults("base off"))
        await until(lambda: driver.problem == "")
        await driver.limp()
        await until(lambda: emulator.body.joints[2].position > HOME[2] + 0.3)
        assert (await driver.read_state()).limp
