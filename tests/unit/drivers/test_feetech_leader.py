"""An arm that leads: it is read, switched off, and never moved."""

import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.calibration import (
    JointRange,
    load_calibration,
    save_calibration,
)
from gigabrain_drivers.bodies.feetech.leader import LeaderArm
from gigabrain_zenoh.errors import ConfigError
from tests.unit.drivers.feetech import FOLDER, NAMES, OPTIONS, ROBOT, Rig

CALIBRATION = str(FOLDER / "emulated.yaml")
TICK = feetech.RADIANS_PER_TICK
GRIPPER = ROBOT.joints[-1]


class Led(Rig):
    """A leader on the emulated bus, which a test moves by hand."""

    def __init__(self, calibration: str = CALIBRATION) -> None:
        super().__init__()
        self.leader = LeaderArm("memory", calibration, clock=self.clock, link=self.link)
        self.link.open = self._plug  # type: ignore[method-assign]
        self.kept = [servo.kept for servo in self.arm.servos.values()]

    def _plug(self) -> None:
        self.link._fd, self.link.problem = 0, ""
        self.link.on_open()

    async def move(self, speed: float = 2.0, **positions: float) -> dict[str, float]:
        """Bring joints somewhere by hand [rad], and return what is read then."""
        found, most = await self.read(), speed * 0.02
        for _ in range(200):
            for name, position in positions.items():
                joint = self.joint(name)
                joint.position += max(-most, min(most, position - joint.position))
            await self.wait(20)
            found = await self.read()
        return found

    async def read(self) -> dict[str, float]:
        return dict(await self.during(self.leader.read()))

    async def read_on(self, times: int = 40) -> dict[str, float]:
        """Read every 20 ms; return the last posture."""
        for _ in range(times):
            await self.wait(20)
            found = await self.read()
        return found


@asynccontextmanager
async def leading(rig: Led | None = None) -> AsyncIterator[Led]:
    rig = rig or Led()
    await rig.during(rig.leader.__aenter__())
    try:
        yield rig
    finally:
        await rig.leader.__aexit__()


async def test_its_posture_is_read_and_a_trigger_leads_through_the_gripper_s_range() -> None:
    async with leading() as rig:
        its = load_calibration(Path(CALIBRATION), "so101", ROBOT.joints, OPTIONS.servos).joints
        halfway = its["gripper"].to_radians((its["gripper"].lower + its["gripper"].upper) // 2)
        found = await rig.move(elbow_flex=0.5, gripper=halfway)
        assert list(found) == NAMES
        assert found["elbow_flex"] == pytest.approx(0.5, abs=TICK)
        middle = (GRIPPER.lower + GRIPPER.upper) / 2
        assert found["gripper"] == pytest.approx(middle, abs=2 * TICK)


async def test_a_motor_that_is_on_is_switched_off_and_nothing_else_is_written() -> None:
    rig = Led()
    rig.servo("elbow_flex").write(feetech.TORQUE.address, b"\1")
    async with leading(rig):
        assert rig.leader.let_go
        await rig.read()
        written = [(packet.id, packet.params) for packet in rig.written()]
        assert written == [(3, bytes([feetech.TORQUE.address, 0]))]
        assert not any(servo[feetech.TORQUE] for servo in rig.arm.servos.values())
    assert [servo.kept for servo in rig.arm.servos.values()] == rig.kept


async def test_a_limp_leader_is_not_written_to_at_all() -> None:
    async with leading() as rig:
        await rig.read()
        assert not rig.leader.let_go
        assert not rig.written()


async def test_a_fast_hand_is_believed_within_100_ms() -> None:
    async with leading() as rig:
        await rig.read()
        for number in range(1, 6):  # from rest to 10 rad/s at once
            rig.joint("wrist_roll").position = number * 0.2
            await rig.wait(20)
            found = await rig.read()
        assert found["wrist_roll"] == pytest.approx(1.0, abs=TICK)


async def test_one_lost_answer_does_not_end_it_and_silence_does() -> None:
    async with leading() as rig:
        before = await rig.read()
        rig.link.disturb = lambda _: b""
        assert await rig.read() == before
        with pytest.raises(
            ConfigError, match=r"memory: servo 1 \(shoulder_pan\) no longer answers"
        ):
            await rig.read_on()


async def test_silence_of_a_third_of_a_second_leaves_its_last_posture() -> None:
    async with leading() as rig:
        before = await rig.read()
        received, rig.link.disturb = rig.link.disturb, lambda _: b""
        assert await rig.read_on(8) == before  # each takes 38 ms
        rig.link.disturb = received
        rig.joint("wrist_roll").position = 0.2
        assert (await rig.read_on(10))["wrist_roll"] == pytest.approx(0.2, abs=TICK)


async def test_one_servo_that_falls_silent_is_named() -> None:
    async with leading() as rig:
        rig.arm.bus.servos.remove(rig.servo("elbow_flex"))
        with pytest.raises(ConfigError, match=r"servo 3 \(elbow_flex\) no longer answers"):
            await rig.read_on()


async def test_a_leader_that_is_unplugged_is_named() -> None:
    async with leading() as rig:
        rig.link.drop("unplugged?")
        with pytest.raises(ConfigError, match="the leader at memory: unplugged"):
            await rig.read()


async def opening_of(rig: Led) -> str:
    with pytest.raises(ConfigError) as found:
        await rig.during(rig.leader.__aenter__())
    assert not rig.written()
    assert not rig.link.connected
    return str(found.value)


async def test_a_missing_servo_is_named_and_nothing_is_written() -> None:
    rig = Led()
    rig.arm.bus.servos.remove(rig.servo("wrist_flex"))
    assert "servo 4 (wrist_flex) does not answer" in await opening_of(rig)


async def test_a_bus_without_power_is_named() -> None:
    rig = Led()
    rig.arm.bus.servos.clear()
    assert await opening_of(rig) == ("memory is open, but no servo answers: right port, power on?")


async def test_the_calibration_of_another_arm_is_refused() -> None:
    rig = Led()
    rig.servo("elbow_flex").keep(feetech.OFFSET, 7)
    text = await opening_of(rig)
    assert "servo 3 (elbow_flex) keeps offset 7" in text
    assert text.endswith("run gigabrain driver calibrate so101 --leader --port memory")


def test_a_leader_without_a_calibration_is_told_how_to_get_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with pytest.raises(ConfigError) as found:
        LeaderArm("/dev/ttyACM1")
    path = tmp_path / "gigabrain/calibration/so101-leader.yaml"
    assert str(found.value) == (
        f"{path}: no such file: the leader is not calibrated; "
        "run gigabrain driver calibrate so101 --leader --port /dev/ttyACM1"
    )
    save_calibration(
        path, load_calibration(Path(CALIBRATION), "so101", ROBOT.joints, OPTIONS.servos)
    )
    LeaderArm("/dev/ttyACM1")
    LeaderArm("/dev/ttyACM1", "emulated.yaml")  # beside the robot's file
    with pytest.raises(ConfigError, match=r"^nothing\.yaml: no such file"):
        LeaderArm("/dev/ttyACM1", "nothing.yaml")


def test_a_trigger_needs_no_more_than_a_range_of_its_own() -> None:
    trigger, gripper = JointRange(GRIPPER, 2000, trigger=True), JointRange(GRIPPER, 2000)
    for ticks in (2000, 2200, 2400, 2400):
        trigger.add(ticks)
        gripper.add(ticks)
    assert not trigger.missing
    assert math.degrees(gripper.missing) == pytest.approx(65, abs=1)
    for ticks in (1500, 1000, 500, 500):
        trigger.add(ticks)
    assert not trigger.endless
    made = trigger.calibrated(6, 1)
    assert (made.lower, made.upper) == (500, 2400)
