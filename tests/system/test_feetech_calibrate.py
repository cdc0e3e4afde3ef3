"""`gigabrain driver calibrate` in a terminal, with an emulated arm that a person moves."""

import asyncio
import os
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.calibration import load_calibration
from gigabrain_drivers.bodies.feetech.driver import FeetechDriver
from gigabrain_drivers.bodies.feetech.emulator import FeetechArm
from gigabrain_drivers.bodies.feetech.leader import LeaderArm
from gigabrain_drivers.bodies.feetech.protocol import FeetechPacket
from gigabrain_drivers.bodies.feetech.servo import ServoModel
from gigabrain_drivers.driver.robot import Run
from gigabrain_zenoh.host.terminal import READ_BYTES
from gigabrain_zenoh.testing.processes import GIGABRAIN
from gigabrain_zenoh.testing.waiting import until
from tests.system.servos import emulated_arm
from tests.unit.drivers.feetech import FOLDER, OPTIONS, ROBOT, FreeArm

ZERO_TICKS = [2100, 1900, 3900, 300, 2048, 1500]  # [encoder ticks] of the joints at 0 rad
ONE_DEGREE = 0.0175


class Calibration:
    """The command in a terminal, and the emulated arm."""

    def __init__(self, arm: FeetechArm, body: FreeArm, file: Path) -> None:
        self.arm, self.body, self.file = arm, body, file
        self.trigger = 1.0  # share of the gripper's range that its joint can reach
        self.text = ""
        self.reads: Counter[int] = Counter()  # position reads by servo
        self._execute = arm.bus.execute
        arm.bus.execute = self._count  # type: ignore[method-assign]

    def _count(self, packet: FeetechPacket) -> bytes:
        if packet.instruction == feetech.READ and packet.params[0] == feetech.POSITION.address:
            self.reads[packet.id] += 1
        return self._execute(packet)

    async def run(self, port: Path, *options: str) -> None:
        self._terminal, theirs = os.openpty()
        command = [*GIGABRAIN, "driver", "calibrate", "so101"]
        self._program = await asyncio.create_subprocess_exec(
            *command, "--port", str(port), "--file", str(self.file), *options,
            stdin=theirs, stdout=theirs, stderr=theirs,
        )  # fmt: skip
        os.close(theirs)
        asyncio.get_running_loop().add_reader(self._terminal, self._readable)

    def _readable(self) -> None:
        try:
            self.text += os.read(self._terminal, READ_BYTES).decode(errors="replace")
        except OSError:  # the command ended
            asyncio.get_running_loop().remove_reader(self._terminal)

    async def answer(self, request: str, typed: str = "") -> None:
        """Wait for a request of the command, and type a line."""
        await until(lambda: request in self.text)
        self.text = self.text.partition(request)[2]
        os.write(self._terminal, f"{typed}\n".encode())

    async def move(self, share: float) -> None:
        """Move all joints to a share of their range, and wait until the command read that."""
        for joint, its in zip(ROBOT.joints, self.body.free.values(), strict=True):
            reach = self.trigger if joint.part == "gripper" else 1.0
            off = (share - 0.5) * reach * (joint.upper - joint.lower)
            its.position = (joint.lower + joint.upper) / 2 + off
            its.velocity = 0.0
        before = self.reads.copy()
        await until(lambda: all(self.reads[n] >= before[n] + 3 for n in range(1, 7)))

    async def ended(self) -> int:
        return await self._program.wait()

    async def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._terminal)
        if self._program.returncode is None:
            self._program.kill()
            await self._program.wait()
        os.close(self._terminal)


@asynccontextmanager
async def calibrating(folder: Path, *options: str) -> AsyncIterator[Calibration]:
    """Run the command on a new arm, whose servos have no stored calibration."""
    port, file = folder / "base", folder / "so101.yaml"
    async with emulated_arm(port, replace(OPTIONS, calibration=str(file))) as (arm, body):
        servos = [ServoModel(n, centre=at) for n, at in enumerate(ZERO_TICKS, 1)]
        arm.servos = dict(zip(arm.servos, servos, strict=True))
        arm.bus.servos = servos
        it = Calibration(arm, body, file)
        await it.run(port, *options)
        try:
            yield it
        finally:
            await it.close()


async def answer_first_questions(it: Calibration, consent: str) -> None:
    await it.answer("Hold the arm")
    await until(lambda: "to the middle of its range" in it.text)
    assert not any(servo[feetech.TORQUE] for servo in it.arm.servos.values())
    for joint, its in zip(ROBOT.joints, it.body.free.values(), strict=True):
        its.position = (joint.lower + joint.upper) / 2
    await asyncio.sleep(0.1)
    await it.answer("to the middle of its range")
    await it.answer("May offsets and limits be written", consent)
    await until(lambda: "from one end of its range" in it.text)


async def test_an_arm_calibrated_by_hand_can_be_driven(tmp_path: Path) -> None:
    async with calibrating(tmp_path) as it:
        await answer_first_questions(it, "y")
        for share in (0.5, 0.0, 0.5):
            await it.move(share)
        await it.answer("from one end of its range")
        await until(lambda: "Not moved far enough: shoulder_pan, shoulder_lift" in it.text)
        await until(lambda: "Go on, and press Enter" in it.text)
        for share in (1.0, 0.5):
            await it.move(share)
        await it.answer("Go on, and press Enter")
        assert await it.ended() == 0, it.text
        calibration = load_calibration(it.file, "so101", ROBOT.joints, OPTIONS.servos)
        for (name, servo), joint in zip(it.arm.servos.items(), it.body.free.values(), strict=True):
            at = calibration.joints[name].to_radians(servo[feetech.POSITION])
            assert at == pytest.approx(joint.position, abs=ONE_DEGREE)
            servo.power_on()
            assert servo[feetech.OFFSET] == calibration.joints[name].offset
            assert servo[feetech.MIN_POSITION] > 0
        options = replace(OPTIONS, port=str(tmp_path / "base"), calibration=str(it.file))
        driver = FeetechDriver(ROBOT, options, Run(folder=FOLDER, link="real"))
        async with driver:
            await until(lambda: not driver.problem)


async def test_the_trigger_of_a_leader_needs_only_its_own_range(tmp_path: Path) -> None:
    async with calibrating(tmp_path, "--leader") as it:
        it.trigger = 0.3
        await answer_first_questions(it, "y")
        for share in (0.5, 0.0, 0.5, 1.0):
            await it.move(share)
        await it.answer("from one end of its range")
        assert await it.ended() == 0, it.text
        await until(lambda: "the calibration of the leader" in it.text)
        async with LeaderArm(str(tmp_path / "base"), str(it.file)) as leader:
            found = await leader.read()
        expected = {joint.name: joint.upper for joint in ROBOT.joints}
        assert found == pytest.approx(expected, abs=ONE_DEGREE)


async def test_without_consent_no_servo_is_changed(tmp_path: Path) -> None:
    async with calibrating(tmp_path) as it:
        kept = {name: servo.kept for name, servo in it.arm.servos.items()}
        await answer_first_questions(it, "")
        for share in (0.5, 0.0, 0.5, 1.0, 0.5):
            await it.move(share)
        await it.answer("from one end of its range")
        assert await it.ended() == 2, it.text
        await until(lambda: "servo 3 (elbow_flex) begins to count again" in it.text)
        assert not it.file.exists()
        assert {name: servo.kept for name, servo in it.arm.servos.items()} == kept
