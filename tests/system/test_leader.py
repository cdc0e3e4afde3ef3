"""`gigabrain teleop --leader`: a second SO-101 on a pty leads a simulated one."""

import asyncio
import math
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.emulator import FeetechArm
from gigabrain_drivers.bodies.feetech.leader import LeaderArm
from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_S
from gigabrain_zenoh.qa.probe import Probe, probing
from gigabrain_zenoh.recording.lerobot import frames
from gigabrain_zenoh.testing.processes import GIGABRAIN, CommandProcess, Home, robot_of
from gigabrain_zenoh.testing.waiting import until
from tests.system.servos import emulated_arm
from tests.system.test_feetech_link import arm_on
from tests.unit.drivers.feetech import FreeArm

JOINTS = load_robot("so101").joints
NAMES = [joint.name for joint in JOINTS]
TEN_MS = 0.01
TOLERANCE_RAD = 0.02  # [rad]


@pytest.fixture(scope="module")
def demo(shared_home: Home) -> CommandProcess:
    return shared_home.start("demo", "--body", "so101", "--world", "arena", "--headless")


@pytest.fixture
async def arm(shared_home: Home, demo: CommandProcess) -> AsyncIterator[Probe]:
    async with probing(await robot_of(shared_home, demo)) as onlooker:
        await until(lambda: onlooker.state.gate.mode == "enabled", "enabled")
        yield onlooker


class Leader:
    """The leader arm, which the test moves, and the command that reads it."""

    def __init__(self, device: FeetechArm, body: FreeArm, port: Path) -> None:
        self.device, self.body, self.port = device, body, port

    async def move(self, **positions: float) -> None:
        """Move joints to positions at 1 rad/s."""
        moving = {self.body.free[name]: place for name, place in positions.items()}
        while any(abs(joint.position - place) > 1e-6 for joint, place in moving.items()):
            for joint, place in moving.items():
                joint.position += max(-TEN_MS, min(TEN_MS, place - joint.position))
                joint.velocity = 0.0
            await asyncio.sleep(TEN_MS)

    async def swing(self, name: str, one: float, other: float) -> None:
        """Move a joint to and fro for ever."""
        while True:
            await self.move(**{name: one})
            await self.move(**{name: other})

    def start(self, home: Home) -> CommandProcess:
        chosen = ("--leader", str(self.port), "--leader-calibration", "emulated.yaml")
        return home.start("teleop", *chosen, "--take")


@asynccontextmanager
async def leader_at(port: Path) -> AsyncIterator[Leader]:
    async with emulated_arm(port) as (device, body):
        device.reset()  # its motors are off after a power-up
        yield Leader(device, body, port)


async def wait_for_position(leader: LeaderArm, name: str, position: float) -> dict[str, float]:
    """Wait until a joint reads `position` [rad]; return the posture then."""
    for _ in range(6000):
        found = dict(await leader.read())
        if abs(found[name] - position) < TOLERANCE_RAD:
            return found
        await asyncio.sleep(TEN_MS)
    raise AssertionError(f"{name} is at {found[name]:.2f}")


def sent(arm: Probe, name: str) -> float:
    return arm.state.joints_sent[NAMES.index(name)]


def max_joint_speed(ways: dict[int, Floats]) -> float:
    """Return the maximum speed of a joint [rad/s], averaged over at least 0.2 s."""
    speeds = [0.0]
    for tick, begin in ways.items():
        end = next((later for later in sorted(ways) if later >= tick + 10), None)
        if end:
            speeds.append(float(np.abs(ways[end] - begin).max()) / ((end - tick) * TICK_S))
    return max(speeds)


@pytest.mark.slow
async def test_an_arm_goes_slowly_to_the_posture_of_its_leader_then_follows_it(
    shared_home: Home, arm: Probe, tmp_path: Path
) -> None:
    bag = tmp_path / "led.mcap"
    record = shared_home.start("record", "-o", str(bag))
    async with leader_at(tmp_path / "leader") as leader:
        kept = [servo.kept for servo in leader.device.servos.values()]
        await leader.move(shoulder_pan=0.8)
        ways = {}
        command = leader.start(shared_home)
        while "following" not in command.out:
            assert command.running, command.err
            ways[arm.state.tick] = np.array([joint.position for joint in arm.state.joints[:5]])
            await asyncio.sleep(TEN_MS)
        assert "slowly to the leader's posture: shoulder_pan has" in command.out
        assert max_joint_speed(ways) < 1.3  # [rad/s]; 45 degrees are 0.79
        assert arm.state.gate.commander.endswith("-leader")
        await leader.move(shoulder_pan=-0.3, wrist_roll=0.5, gripper=0.5)
        await until(lambda: abs(sent(arm, "shoulder_pan") + 0.3) < TOLERANCE_RAD, "it follows")
        await until(lambda: abs(sent(arm, "gripper") - 0.5) < TOLERANCE_RAD, "its gripper as well")
        await until(lambda: abs(arm.state.joints[0].position + 0.3) < 3 * TOLERANCE_RAD, "measured")
        assert not any(servo[feetech.TORQUE] for servo in leader.device.servos.values())
        assert [servo.kept for servo in leader.device.servos.values()] == kept
        command.send(signal.SIGINT)
        assert await command.ended() == 0, command.err
        assert command.out.endswith("so101 holds where it is\n")
    await until(lambda: arm.state.gate.commander == "control", "the brain goes on")
    await arm.ticks(25)
    assert sent(arm, "shoulder_pan") == pytest.approx(-0.3, abs=TOLERANCE_RAD)
    record.send(signal.SIGINT)
    assert await record.ended() == 0
    led = list(frames(bag))
    assert led
    action, observed = (
        np.stack([getattr(one, kind) for one in led]) for kind in ("action", "state")
    )
    assert action[:, 0].max() == pytest.approx(math.degrees(0.8), abs=1.5)
    assert action[-1, 0] == pytest.approx(math.degrees(-0.3), abs=1.5)
    share = (0.5 - JOINTS[-1].lower) / (JOINTS[-1].upper - JOINTS[-1].lower)
    assert action[-1, 5] == pytest.approx(100 * share, abs=1.5)
    assert observed[-1] == pytest.approx(action[-1], abs=4.0)


async def test_an_unplugged_leader_leaves_the_follower_at_rest(
    shared_home: Home, arm: Probe, tmp_path: Path
) -> None:
    async with leader_at(tmp_path / "leader") as leader:
        command = leader.start(shared_home)
        await until(lambda: "following" in command.out or not command.running)
        assert command.running, command.err
        moving = asyncio.ensure_future(leader.move(shoulder_pan=1.5))
        await until(lambda: sent(arm, "shoulder_pan") > 0.5, "on its way")
        moving.cancel()
    assert await command.ended() == 2
    assert command.err.startswith(f"gigabrain: the leader at {tmp_path}/leader: ")
    assert command.err.count("\n") == 1
    await arm.ticks(25)
    there = sent(arm, "shoulder_pan")
    await arm.ticks(25)
    assert sent(arm, "shoulder_pan") == pytest.approx(there, abs=0.001)
    assert there < 1.4


@pytest.mark.slow
async def test_an_estop_ends_following_and_the_arm_is_held(
    shared_home: Home, arm: Probe, tmp_path: Path
) -> None:
    async with leader_at(tmp_path / "leader") as leader:
        command = leader.start(shared_home)
        await until(lambda: "following" in command.out or not command.running)
        assert command.running, command.err
        moving = asyncio.ensure_future(leader.swing("shoulder_pan", -1.2, -0.4))
        await until(lambda: sent(arm, "shoulder_pan") < -0.3, "on its way")
        assert await (await shared_home.run("estop")).ended() == 0
        assert await command.ended() == 1
        assert "the gate has stopped the robot" in command.err
        await arm.ticks(25)
        there = sent(arm, "shoulder_pan")
        await arm.ticks(25)
        assert sent(arm, "shoulder_pan") == pytest.approx(there, abs=0.001)
        moving.cancel()
    assert -1.3 < there < -0.2
    for again in ("release", "enable"):
        assert await (await shared_home.run(again)).ended() == 0


@pytest.mark.slow
async def test_a_leader_with_a_missing_servo_moves_nothing(
    shared_home: Home, arm: Probe, tmp_path: Path
) -> None:
    before = arm.state.joints_sent
    async with leader_at(tmp_path / "leader") as leader:
        leader.device.bus.servos.pop(2)
        command = leader.start(shared_home)
        assert await command.ended() == 2
        assert "servo 3 (elbow_flex) does not answer" in command.err
    assert arm.state.gate.commander == "control"
    assert arm.state.joints_sent == pytest.approx(before, abs=0.001)


@pytest.mark.slow
async def test_the_port_of_the_follower_is_refused_as_leader(
    shared_home: Home, tmp_path: Path
) -> None:
    port = tmp_path / "base"
    async with leader_at(port) as leader, arm_on(port) as follower:
        await until(lambda: not follower.problem)
        command = leader.start(shared_home)
        assert await command.ended() == 2
        assert "base is in use by pid" in command.err
        await until(lambda: not follower.problem)


async def test_the_limp_arm_of_the_emulator_is_moved_by_typed_commands(
    shared_home: Home, tmp_path: Path
) -> None:
    command = (*GIGABRAIN, "emulate", "so101", "--ports", str(tmp_path), "--world", "arena")
    pipe = asyncio.subprocess.PIPE
    emulator = await asyncio.create_subprocess_exec(
        *command, stdin=pipe, stdout=pipe, env=shared_home.environment
    )
    assert emulator.stdin
    assert emulator.stdout
    try:
        while b"off takes it away" not in (line := await emulator.stdout.readline()):
            assert line
        emulator.stdin.write(b"move shoulder_pan=30 gripper=50\nmove elbow=3\n")
        assert b"no joint 'elbow'" in await emulator.stdout.readline()
        async with LeaderArm(str(tmp_path / "base"), "emulated.yaml") as leader:
            assert leader.let_go
            await wait_for_position(leader, "shoulder_pan", math.radians(30))
            found = await wait_for_position(leader, "gripper", math.radians(50))
            home = dict(zip(NAMES, load_robot("so101").arm.home, strict=True))  # type: ignore[union-attr]
            assert found["elbow_flex"] == pytest.approx(home["elbow_flex"], abs=0.1)
    finally:
        emulator.terminate()
        await emulator.wait()
