"""A calibration takes a person's time: what would lose it is found before it begins."""

import asyncio
import os
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_drivers.bodies.feetech.bus import HostBus
from gigabrain_drivers.bodies.feetech.calibrate import Calibrator, calibrate
from gigabrain_drivers.bodies.feetech.calibration import Calibration
from gigabrain_drivers.bodies.feetech.servo import ServoModel
from gigabrain_zenoh.cli.calibrating import Terminal
from gigabrain_zenoh.errors import ConfigError
from tests.unit.drivers.feetech import OPTIONS, ROBOT, Rig


@pytest.mark.parametrize(
    ("name", "reason"),
    [("file/so101.yaml", "a part of the path is a file"), ("folder", "it is a folder")],
)
async def test_a_file_that_cannot_be_written_is_refused_before_an_arm_is_touched(
    tmp_path: Path, name: str, reason: str
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    options, path = replace(OPTIONS, port=str(tmp_path / "no_port")), tmp_path / name
    with pytest.raises(ConfigError, match=f"cannot write {path}: {reason}"):
        await calibrate(ROBOT, options, path, Terminal())


async def test_a_refused_calibration_leaves_the_one_before(tmp_path: Path) -> None:
    options, path = replace(OPTIONS, port=str(tmp_path / "no_port")), tmp_path / "so101.yaml"
    path.write_text("joints: {}\n")
    with pytest.raises(ConfigError, match="no_port"):
        await calibrate(ROBOT, options, path, Terminal())
    assert os.listdir(tmp_path) == ["so101.yaml"]
    assert path.read_text() == "joints: {}\n"


class Person:
    """Moves the joints of an arm whose motors are off, each through its whole range."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._asked, self.shown_late = False, 0
        self._rounds, self._read = 0, asyncio.Event()
        self._disturb, rig.link.disturb = rig.link.disturb, self._count

    async def ask(self, text: str) -> str:
        self._asked = True
        if "middle of its range" in text:
            await self._move(0.5)
        elif "from one end" in text:
            for share in (0.25, 0.0, 0.25, 0.5, 0.75, 1.0):
                await self._move(share)
                self._rounds = 6
                self._read.clear()
                await self._read.wait()
        self._asked = False
        return "y" if "EEPROM" in text else ""

    def show(self, _: object) -> None:
        self.shown_late += not self._asked

    def _count(self, data: bytes) -> bytes:
        self._rounds -= data[2] == 1
        if not self._rounds:
            self._read.set()
        return self._disturb(data)

    async def _move(self, share: float) -> None:
        for joint, its in zip(ROBOT.joints, self._rig.body.free.values(), strict=True):
            its.position = joint.lower + share * (joint.upper - joint.lower)
        await self._rig.wait(20)


async def calibrated(rig: Rig, person: Person) -> Calibration:
    rig.link.open()
    servos = [ServoModel(n, centre=2100 + 20 * n) for n in range(1, 7)]
    rig.arm.servos = dict(zip(rig.arm.servos, servos, strict=True))
    rig.arm.bus.servos = servos
    bus = HostBus(rig.link, rig.clock)
    return await Calibrator(ROBOT, OPTIONS, bus, person, leader=False).run()


async def test_no_range_is_shown_once_the_person_is_done() -> None:
    rig, loop = Rig(), asyncio.get_running_loop()

    def later(data: bytes) -> bytes:
        loop.call_soon(rig.link.on_bytes, data)
        return b""

    rig.link.disturb = later
    person = Person(rig)
    await calibrated(rig, person)
    assert person.shown_late == 0


@pytest.mark.parametrize("period", [5, 7, 11])
async def test_wrong_answers_with_a_right_sum_change_no_calibration(period: int) -> None:
    quiet, noisy, answers = Rig(), Rig(), 0
    expected = await calibrated(quiet, Person(quiet))

    def disturb(data: bytes) -> bytes:
        nonlocal answers
        answers += 1
        wrong = bytearray(data)
        if len(data) > 7 and not answers % period:
            wrong[5], wrong[6] = (wrong[5] + 3) % 256, (wrong[6] - 3) % 256
        return bytes(wrong)

    noisy.link.disturb = disturb
    assert await calibrated(noisy, Person(noisy)) == expected
