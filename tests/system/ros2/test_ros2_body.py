"""A TurtleBot3 simulated by rclpy as a body; its node is killed and frozen while it drives."""

import asyncio
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from gigabrain_drivers.bodies.ros2.driver import Ros2Driver
from gigabrain_drivers.bodies.ros2.guard import Guard
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.qa.conformance import ros2_bringup
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.judge import Judge, Program, frozen

ROOM = [[-2, -2, 4, -2], [4, -2, 4, 2], [4, 2, -2, 2], [-2, 2, -2, -2]]
DRIVE = """
import asyncio, sys
from pathlib import Path
from tests.system.ros2.test_ros2_body import Session
async def main():
    async with Session(Path(sys.argv[1])) as it:
        await it.found()
        it.wanted = 0.15
        await asyncio.sleep(60)
asyncio.run(main())
"""


def robot_file(judge: Judge, folder: Path, *, humble: bool = False) -> Path:
    """Write a file of the shipped TurtleBot3 in the judge's domain; `humble`: with Twist and TF."""
    text = catalog.robot_path("turtlebot3_ros2").read_text()
    text = text.replace("domain: 30", f"localhost: true\n  domain: {judge.domain}")
    if humble:
        text = text.replace("TwistStamped", "Twist")
        text = text.replace("  watchdog:", "  mounting: tf_static\n  watchdog:")
    file = folder / "turtlebot3.yaml"
    file.write_text(text)
    return file


class Session:
    """Runs a driver as its process does: every 20 ms, it reads a state and commands `wanted`."""

    def __init__(self, file: Path) -> None:
        _, driver = catalog.make_driver(str(file), Run(folder=file.parent, link="real"))
        assert isinstance(driver, Ros2Driver)
        self.driver, self.wanted = driver, 0.0
        self.state: Any = None
        self.sent = Velocity()

    async def __aenter__(self) -> "Session":
        await self.driver.__aenter__()
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(self, *error: Any) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        await self.driver.__aexit__(*error)

    async def _run(self) -> None:
        async for _ in self.driver.ticks(Clock()):
            self.state = await self.driver.read_state()
            wanted = self.wanted if self.connected else 0.0
            self.sent = await self.driver.set_base_velocity(wanted, 0.0, 0.0)

    @property
    def connected(self) -> bool:
        return self.state is not None and self.state.link.connected

    async def found(self) -> None:
        await until(lambda: self.connected, f"found: {self.driver.problem}")

    async def lost(self) -> None:
        await until(lambda: not self.connected, f"lost: {self.driver.problem}")


async def truth(robot: Program) -> dict[str, Any]:
    return dict(await robot.query("truth"))


async def moving(robot: Program, it: Session) -> None:
    it.wanted = 0.15
    await asyncio.to_thread(robot.poll, "truth", lambda now: now["speed_mps"] > 0.1)


async def standing(robot: Program) -> None:
    """Wait until it is at rest; without a stop it would continue with the last command."""
    await asyncio.to_thread(robot.poll, "truth", lambda now: now["speed_mps"] < 0.005)


@pytest.mark.parametrize("humble", [False, True])
async def test_the_robot_is_driven_and_its_motion_measured(
    judge: Judge, tmp_path: Path, humble: bool
) -> None:
    robot = judge.start("turtlebot3", walls=ROOM, stamped=not humble)
    async with Session(robot_file(judge, tmp_path, humble=humble)) as it:
        await it.found()
        await moving(robot, it)
        await until(lambda: it.state.velocity.linear_x > 0.12, "the measured speed")
        assert it.sent.linear_x == pytest.approx(0.15)
        await until(lambda: it.driver.sensors["scan"], "a scan")
        await until(lambda: it.state.imu, "its attitude")
        assert it.state.imu.linear_acceleration[2] == pytest.approx(9.8, abs=0.1)
        assert it.state.battery.percentage == pytest.approx(83.3, abs=0.1)
        turns = pytest.approx(0.15 / 0.033, rel=0.2)
        await until(lambda: it.state.joints[0].velocity == turns, "the speed of its wheels")
        it.wanted = 0.0
        await standing(robot)


@pytest.mark.parametrize("fault", ["killed", "frozen"])
async def test_a_failure_of_the_robots_node_while_driving_stops_it(
    judge: Judge, tmp_path: Path, fault: str
) -> None:
    robot = judge.start("turtlebot3", walls=ROOM, stamped=True)
    node = (await robot.wait_async("node"))["pid"]
    async with Session(robot_file(judge, tmp_path)) as it:
        await it.found()
        await moving(robot, it)
        if fault == "killed":
            os.kill(node, 9)
            await asyncio.gather(it.lost(), standing(robot))
            await robot.query("start_node")
        else:
            with frozen(node):
                await asyncio.gather(it.lost(), standing(robot))
                it.wanted = 0.0
                await asyncio.sleep(1.0)  # then its queue contains only zeros
        assert it.driver.problem
        it.wanted = 0.0
        await it.found()
        assert (await truth(robot))["speed_mps"] == 0.0
        assert it.state.link.reconnects >= 1
        await moving(robot, it)


async def test_the_guard_stops_the_robot_of_a_killed_driver(judge: Judge, tmp_path: Path) -> None:
    robot = judge.start("turtlebot3", walls=ROOM, stamped=True)
    file = robot_file(judge, tmp_path)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    driver = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", DRIVE, str(file)), env=environment
    )
    try:
        await asyncio.to_thread(robot.poll, "truth", lambda now: now["speed_mps"] > 0.14)
    finally:
        driver.kill()
        await driver.wait()
    await standing(robot)


SLOW_GUARD = """#!/bin/sh
echo started >> "$FOLDER/starts"
until [ -e "$FOLDER/joined" ]; do sleep 0.02; done
echo 0
until [ -e "$FOLDER/found" ]; do sleep 0.02; done
echo 1
cat > /dev/null
"""


class SetClock(Clock):
    """A clock whose time the test sets."""

    ns = 0

    def now_ns(self) -> int:
        return self.ns


async def test_a_slowly_starting_guard_is_not_restarted(
    judge: Judge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "guard"
    program.write_text(SLOW_GUARD)
    program.chmod(0o755)
    monkeypatch.setenv("FOLDER", str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(program))
    _, driver = catalog.make_driver(
        str(robot_file(judge, tmp_path)), Run(folder=tmp_path, link="real")
    )
    assert isinstance(driver, Ros2Driver)
    clock = SetClock()
    guard = Guard(driver.options, clock, lambda: True)
    guard.open()
    await until((tmp_path / "starts").exists, "its start")
    clock.ns += 9_000_000_000
    (tmp_path / "joined").touch()
    await until(lambda: "does not reach it yet" in guard.problem, "its first word")
    (tmp_path / "found").touch()
    await until(lambda: not guard.problem, "the robot")
    assert (tmp_path / "starts").read_text() == "started\n"
    process = guard._process
    assert process
    await guard.close()
    assert process.returncode == 0  # its end was waited for


@pytest.mark.slow
async def test_bringup_finds_no_fault_or_names_the_wrong_type(judge: Judge, tmp_path: Path) -> None:
    judge.start("turtlebot3", walls=ROOM)  # it takes Twist, as on Humble
    file = robot_file(judge, tmp_path)
    found = await ros2_bringup.check(str(file), "real", tmp_path, 6.0)
    wrong = [each for each in found if each.verdict == "error"]
    assert [each.what for each in wrong] == ["/cmd_vel"]
    assert wrong[0].remedy == "write topics: {command: {type: geometry_msgs/msg/Twist}}"
    frames = [each.text for each in found if each.what == "scan frame"]
    assert frames
    assert "x -0.032 m" in frames[0]
