"""Requests to let go of an arm and to hold it: the answer is what the arm really does."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.piper.driver import NOTHING_COMES
from gigabrain_drivers.driver.catalog import robot_path
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.requests import LimpRequest
from gigabrain_schemas.topics import LIMP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.config.settings import DriverConfig
from gigabrain_zenoh.runtime.audit import read_audit
from tests.unit.drivers import feetech as so101
from tests.unit.drivers import piper

Ask = Callable[[bool], Awaitable[tuple[bool, str]]]
LET_GO = (True, "all joints are limp")
HELD = (True, "the joints hold their positions")


@asynccontextmanager
async def asking(rig: so101.Rig | piper.Rig, folder: Path) -> AsyncIterator[Ask]:
    """Run the driver's process, and ask it to let go (True) or to hold (False)."""
    async with driving(rig, folder) as (_, ask):
        yield ask


@asynccontextmanager
async def driving(
    rig: so101.Rig | piper.Rig, folder: Path
) -> AsyncIterator[tuple[DriverProcess, Ask]]:
    """Run the driver's process, and give it with what asks it as above."""
    network, robot = LocalNetwork(), rig.driver.robot
    rig.driver.run = Run(folder=robot_path(robot.robot_type).parent, link="real")
    operator = Bus(network.transport(), rig.clock)
    config = DriverConfig(body=robot.robot_type, state_dir=str(folder))
    bus = Bus(network.transport(), rig.clock, "driver")
    process = DriverProcess(config, robot, rig.driver, bus)
    running = asyncio.ensure_future(process.run(lambda: None))

    async def ask(limp: bool) -> tuple[bool, str]:
        request = LimpRequest(limp=limp, source="ann")
        asked = asyncio.ensure_future(operator.ask(LIMP, request))
        while not asked.done():
            await rig.wait(10)
        [reply] = asked.result()
        return reply.ok, reply.text

    try:
        await rig.wait(1000)
        yield process, ask
    finally:
        running.cancel()
        while not running.done():
            await rig.wait(10)


def audited(folder: Path) -> list[tuple[str, bool, str]]:
    records = read_audit(folder, 1000)
    return [(one.what, one.ok, one.text) for one in records if one.source == "ann"]


@pytest.mark.long
async def test_an_arm_that_cannot_hold_where_it_is_is_not_said_to(tmp_path: Path) -> None:
    rig = so101.Rig()
    pan = rig.joint("shoulder_pan")
    async with asking(rig, tmp_path) as ask:
        assert await ask(True) == LET_GO
        pan.upper, pan.load = pan.upper + 0.3, 0.5
        await rig.wait(3000)
        refused = await ask(False)
        assert refused[0] is False
        assert "servo 1 (shoulder_pan) is 17 deg outside its calibrated range" in refused[1]
        assert (await rig.driver.read_state()).limp
        pan.load = -0.5
        await rig.wait(800)
        pan.load = 0.0
        await rig.wait(200)
        assert await ask(False) == HELD
        assert all(servo[feetech.TORQUE] == 1 for servo in rig.arm.servos.values())
    assert audited(tmp_path) == [
        ("limp", *LET_GO),
        ("hold", *refused),
        ("hold", *HELD),
    ]


@pytest.mark.parametrize("late", [False, True], ids=["before", "meanwhile"])
async def test_an_arm_that_somebody_is_given_is_not_said_to_be_let_go_of(
    tmp_path: Path, late: bool
) -> None:
    rig = so101.Rig()
    async with driving(rig, tmp_path) as (process, ask):
        limp, let_go = rig.driver.limp, list[None]()

        def enable() -> None:
            gate = process._gatekeeper
            gate.state = replace(gate.state, mode="enabled", causes=(), commander="control")

        async def lets_go() -> None:
            let_go.append(None)
            await limp()
            enable()

        rig.driver.limp = lets_go  # type: ignore[method-assign]
        await process._line.acquire()
        asked = asyncio.ensure_future(ask(True))
        await rig.wait(10)
        if not late:
            enable()
        process._line.release()
        assert await asked == (False, "control holds the arm; press the e-stop first")
        assert bool(let_go) is late
        await rig.wait(200)
        assert not (await rig.driver.read_state()).limp
    assert audited(tmp_path) == [("limp", False, "control holds the arm; press the e-stop first")]


@pytest.mark.long
async def test_an_arm_without_power_is_not_said_to_hold(tmp_path: Path) -> None:
    rig = so101.Rig()
    async with asking(rig, tmp_path) as ask:
        assert await ask(True) == LET_GO
        rig.link.to_arm = lambda data: None
        await rig.wait(200)
        refused = await ask(False)
        assert refused == (
            False,
            "servo 1 (shoulder_pan) no longer answers: check its cable and power",
        )
    assert audited(tmp_path)[1:] == [("hold", *refused)]


async def test_an_arm_whose_motors_switch_on_late_is_said_to_hold_once_it_does(
    tmp_path: Path,
) -> None:
    rig = piper.Rig()
    async with asking(rig, tmp_path) as ask:
        assert await ask(True) == LET_GO
        await rig.wait(300)
        assert await ask(False) == HELD
        assert all(servo.on for servo in rig.arm.joints)
        assert not (await rig.driver.read_state()).limp


async def test_an_arm_whose_motors_stay_off_is_not_said_to_hold(tmp_path: Path) -> None:
    rig = piper.Rig()
    async with asking(rig, tmp_path) as ask:
        assert await ask(True) == LET_GO
        await rig.wait(300)
        rig.cable.to_arm = lambda data: None
        assert await ask(False) == (False, "the joints do not hold")


async def test_an_arm_that_is_not_there_is_neither_let_go_of_nor_held(tmp_path: Path) -> None:
    rig = piper.Rig()
    rig.cable.cut = True
    async with asking(rig, tmp_path) as ask:
        let_go, held = await ask(True), await ask(False)
    assert let_go == (False, f"memory: {NOTHING_COMES}")
    assert held == (False, NOTHING_COMES)
    assert audited(tmp_path) == [("limp", *let_go), ("hold", *held)]
