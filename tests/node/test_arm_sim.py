"""An arm in MuJoCo, behind the gate: nothing moves it but the commander, and it is held."""

from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.geometry.joints import JointMotion, accelerated, stopped

HOME = (0.0, -1.7, 1.4, 0.6, 0.0, 0.0)
NAMES = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
OUTSTRETCHED = (-0.8, 0.4, -0.8, -0.5, 0.0, 0.0)
SAG = 0.03  # [rad], of a servo that is held by its gain alone


def make() -> Driver:
    _, driver = catalog.make_driver("so101", Run(folder=Path(), world="arena", speed=50.0))
    return driver


async def run(
    driver: Driver, ticks: AsyncIterator[int], count: int, act: Callable[[], Awaitable[object]]
) -> RobotState:
    for _ in range(count):
        await act()
        await anext(ticks)
    return await driver.read_state()


async def test_it_stands_in_its_home_posture_and_goes_where_it_is_sent() -> None:
    driver = make()
    goal = dict(zip(NAMES, (0.5, -0.5, 0.6, 0.4, 1.0, 0.8), strict=True))

    async def aim() -> None:
        assert await driver.set_joint_positions(goal) == goal

    async with driver:
        ticks = driver.ticks(Clock())
        state = await run(driver, ticks, 50, driver.stop)
        assert tuple(joint.name for joint in state.joints) == NAMES
        assert [j.position for j in state.joints] == pytest.approx(HOME, abs=SAG)
        state = await run(driver, ticks, 100, aim)
        assert [j.position for j in state.joints] == pytest.approx(list(goal.values()), abs=SAG)
        held = await run(driver, ticks, 50, driver.hold)
        assert [j.position for j in held.joints] == pytest.approx(
            [j.position for j in state.joints], abs=0.01
        )
        assert all(joint.effort is not None and joint.current is not None for joint in held.joints)
        assert not held.limp
        await ticks.aclose()  # type: ignore[attr-defined]
    assert driver.report()["falls"] == 0


async def test_a_limp_arm_falls_and_holds_again_where_it_is_sent() -> None:
    driver = make()

    async def nothing() -> None: ...

    async with driver:
        ticks = driver.ticks(Clock())
        stretched = dict(zip(NAMES, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), strict=True))
        await run(driver, ticks, 100, lambda: driver.set_joint_positions(stretched))
        await driver.limp()
        state = await run(driver, ticks, 100, nothing)
        assert state.limp
        assert state.joints[2].position > 0.2
        where = {joint.name: joint.position for joint in state.joints}
        state = await run(driver, ticks, 20, lambda: driver.set_joint_positions(where))
        assert not state.limp
        assert state.joints[2].position == pytest.approx(where["elbow_flex"], abs=SAG)
        await ticks.aclose()  # type: ignore[attr-defined]


def test_the_brain_gets_its_model_as_text() -> None:
    model = make().arm_model()
    assert model
    assert "<mujoco" in model.mjcf


@pytest.mark.parametrize("name", NAMES[:5])
async def test_a_joint_at_its_greatest_speed_is_at_rest_120_ms_after_it_is_stopped(
    name: str,
) -> None:
    robot, driver = catalog.make_driver("so101", Run(folder=Path(), world="arena", speed=50.0))
    index = NAMES.index(name)
    joint = robot.joints[index]
    posture = dict(zip(NAMES, OUTSTRETCHED, strict=True))
    sent = JointMotion(posture[name])

    async def aim() -> None:
        await driver.set_joint_positions(posture | {name: sent.position})

    async with driver:
        ticks = driver.ticks(Clock())
        await run(driver, ticks, 100, aim)
        for _ in range(18):
            sent = accelerated(sent, joint.max_speed, joint, 0.02)
            state = await run(driver, ticks, 1, aim)
        assert state.joints[index].velocity > 0.9 * joint.max_speed
        sent = stopped(sent, joint)
        await run(driver, ticks, 6, aim)
        for _ in range(25):
            state = await run(driver, ticks, 1, aim)
            assert abs(state.joints[index].velocity) < 0.2
        await ticks.aclose()  # type: ignore[attr-defined]
