"""An SO-101 that was let go of stays so: only a command to its joints switches them on again."""

import pytest

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_zenoh.errors import BodyLost
from tests.unit.drivers.feetech import Rig, opened


def holding(rig: Rig) -> list[str]:
    """Return the joints whose motors are on."""
    return [name for name, servo in rig.arm.servos.items() if servo[feetech.TORQUE]]


async def test_a_limp_arm_whose_line_is_plugged_in_again_stays_limp() -> None:
    rig = Rig()
    async with opened(rig):
        await rig.driver.limp()
        rig.link.drop("unplugged?")
        await rig.wait(100)
        rig.link.open()
        await rig.wait(1000)
        state = await rig.driver.read_state()
        assert state.link.connected
        assert state.limp
        assert holding(rig) == []
        await rig.go(500, gripper=0.5)
        assert len(holding(rig)) == 6
        assert not (await rig.driver.read_state()).limp


async def test_an_arm_that_is_not_there_cannot_be_let_go_of_later() -> None:
    rig = Rig()
    async with opened(rig):
        rig.link.drop("unplugged?")
        await rig.wait(100)
        with pytest.raises(BodyLost, match="memory: unplugged"):
            await rig.driver.limp()
        rig.link.open()
        await rig.wait(1000)
        assert len(holding(rig)) == 6
        assert not (await rig.driver.read_state()).limp
