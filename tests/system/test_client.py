"""`gigabrain_zenoh.connect()`: scripts beside a robot that drives autonomously."""

import asyncio
import contextlib
import itertools
import math
import re
from collections.abc import AsyncIterator

import pytest

import gigabrain_zenoh
from gigabrain_schemas.sensors import Imu, LaserScan
from gigabrain_schemas.topics import SCAN
from gigabrain_zenoh.client.connection import connect
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import (
    BodyLost,
    BusError,
    NotConfirmed,
    Refused,
    UnknownName,
    Unsupported,
)
from gigabrain_zenoh.gate.causes import LATE
from gigabrain_zenoh.qa.probe import Probe, probing
from gigabrain_zenoh.testing.processes import AVOID, CommandProcess, Home, free_port, robot_of
from gigabrain_zenoh.testing.waiting import until


@pytest.fixture(scope="module")
def demo(shared_home: Home) -> CommandProcess:
    return shared_home.start(*AVOID, "--headless")


@pytest.fixture
async def robot(
    shared_home: Home, demo: CommandProcess, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[Probe]:
    """The driving robot of the demo; scripts find it without an endpoint."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(shared_home.folder / "run"))
    async with probing(await robot_of(shared_home, demo)) as onlooker:
        await until(lambda: onlooker.state.gate.mode == "enabled", "driving")
        yield onlooker


async def square(script: Robot) -> None:
    for _ in range(4):
        await script.drive(linear_x=0.2, seconds=1.5)
        await script.drive(angular_z=1.0, seconds=math.pi / 2)


@pytest.mark.slow
async def test_a_script_drives_a_square_and_then_the_brain_drives_on(robot: Probe) -> None:
    async with gigabrain_zenoh.connect(take=True, source="square") as script:
        for _ in range(4):  # repeat: a busy machine may delay script or gate
            try:
                await script.set_base_velocity(0.0)
                await robot.at_rest()
                start = robot.state
                await square(script)
            except Refused:  # refused while a busy machine delays safety
                await robot.ticks(50)
                continue
            moved = robot.distance_from(start)
            turned = abs(math.remainder(robot.state.pose.yaw - start.pose.yaw, math.tau))
            if robot.state.gate.enables == start.gate.enables and moved < 0.05 and turned < 0.15:
                break
        assert robot.state.gate.commander == "square"
        assert (moved < 0.05, turned < 0.15) == (True, True), (moved, turned)
        x = [state.pose.x for state in robot.states if state.tick > start.tick]
        assert max(x) - min(x) > 0.25
    await until(lambda: robot.state.gate.commander == "control", "the brain goes on")
    await robot.driving_straight(speed=0.15, room=0.0)


async def test_a_script_moves_and_turns_by_odometry(robot: Probe) -> None:
    async with connect(take=True, source="measured") as script:
        await script.set_base_velocity(0.0)
        await robot.at_rest()
        start = robot.state
        turned = await script.turn(math.pi / 2)
        assert (turned.ok, turned.held_back) == (True, ())
        assert turned.angle == pytest.approx(math.pi / 2, abs=0.04)
        back = await script.turn(-math.pi / 2)
        assert abs(math.remainder(back.pose.yaw - start.pose.yaw, math.tau)) < 0.08
        moved = await script.move(-0.1, speed=0.1)
        assert moved.distance == pytest.approx(-0.1, abs=0.03)


async def test_a_script_can_use_the_robot_without_asyncio(robot: Probe) -> None:
    def script() -> tuple[str, float, int]:
        with gigabrain_zenoh.connect(take=True, source="plain") as plain:
            plain.set_base_velocity(0.0)
            turned = plain.turn(0.5)
            scans = list(itertools.islice(plain.topic("scan"), 2))
            return plain.read_state().gate.commander, turned.angle, len(scans)

    commander, angle, scans = await asyncio.to_thread(script)
    assert (commander, scans) == ("plain", 2)
    assert angle == pytest.approx(0.5, abs=0.04)
    await until(lambda: robot.state.gate.commander == "control", "the brain goes on")


async def test_a_script_keeps_the_body_between_its_commands(robot: Probe) -> None:
    kept = ""
    for _ in range(4):  # repeat: a busy machine may delay script or gate
        begin = robot.state.tick
        with contextlib.suppress(Refused):
            async with connect(take=True, source="thinker") as script:
                await script.drive(angular_z=0.5, seconds=0.4)
                await robot.ticks(75)
                kept, turning = robot.state.gate.commander, robot.state.velocity.angular_z
                await script.drive(angular_z=-0.5, seconds=0.4)
        if kept == "thinker":
            break
        gates = (state.gate for state in robot.states if state.tick >= begin)
        stops = {cause.code for gate in gates for cause in gate.causes}
        assert stops & LATE, stops
    assert kept == "thinker"
    assert turning < 0.05
    await until(lambda: robot.state.gate.commander == "control", "the brain goes on")


async def test_without_take_a_script_is_refused_with_the_present_commander(robot: Probe) -> None:
    async with connect() as script:
        with pytest.raises(Refused) as refused:
            await script.set_base_velocity(0.1)
    assert (
        str(refused.value)
        == "turtlebot3_waffle: control drives; take it over with --take (in a script take=True)"
    )
    assert robot.state.gate.commander == "control"


async def test_a_script_gets_a_body_that_still_stops_after_another_script(robot: Probe) -> None:
    async with connect(source="next") as after:
        async with connect(take=True, source="last") as last:
            await last.set_base_velocity(0.0, angular_z=1.0)
            await robot.ticks(25)
        await until(lambda: robot.state.gate.mode == "stopping", "the gate stops")
        assert (await after.enable(take=True)).gate.commander == "next"
    await until(lambda: robot.state.gate.commander == "control", "the brain goes on")


async def test_a_script_does_not_retake_a_body_that_was_taken_over(robot: Probe) -> None:
    async with connect(take=True, source="script") as script, connect(source="person") as person:
        await script.set_base_velocity(0.1)
        await person.enable(take=True)
        await person.set_base_velocity(0.05)
        await until(lambda: robot.state.gate.commander == "person", "the person drives")
        await robot.ticks(5)
        with pytest.raises(Refused, match=r"person drives; ask again with enable\(take=True"):
            await script.set_base_velocity(0.1)
        await script.enable(take=True)
        await script.set_base_velocity(0.1)
        await until(lambda: robot.state.gate.commander == "script", "the script drives again")
    await until(lambda: robot.state.gate.commander == "control", "the brain goes on")


async def test_a_velocity_lasts_one_second_and_is_limited_to_the_body(
    robot: Probe,
) -> None:
    async with connect(take=True) as script:
        for _ in range(4):  # repeat: a busy machine may delay script or gate
            start = robot.state
            asked = await script.set_base_velocity(0.0, 0.5, -9.0)
            assert (asked.linear_x, asked.linear_y, asked.angular_z) == (0.0, 0.0, -1.82)
            await until(lambda: robot.state.velocity.angular_z < -1.0, "turning")
            await robot.at_rest()
            new = [state for state in robot.states if state.tick > start.tick]
            turned = [state.tick for state in new if state.velocity.angular_z < -1.0]
            if min(state.velocity.angular_z for state in new) < -1.6:
                break
        assert 35 <= turned[-1] - turned[0] <= 75
    await until(lambda: robot.state.gate.commander == "control", "the brain goes on")


async def test_a_script_can_subscribe_to_topics(robot: Probe) -> None:
    async with connect() as script:
        scans: list[LaserScan] = []
        async with asyncio.timeout(60):
            async for scan in script.topic("scan"):
                scans.append(scan)  # a delayed subscriber misses some scans
                if [b.tick - a.tick for a, b in itertools.pairwise(scans[-3:])] == [5, 5]:
                    break
        assert {type(scan) for scan in scans} == {LaserScan}
        assert len(scans[0].ranges_m) == 360
        assert isinstance(await script.get_sensor_data("imu"), Imu)
        assert isinstance(await anext(script.topic(SCAN)), LaserScan)
        state = await script.read_state()
        assert state.robot_type == "turtlebot3_waffle"
        assert [joint.name for joint in await script.get_joint_states()] == [
            joint.name for joint in state.joints
        ]


async def test_unknown_names_are_refused_with_an_explanation(robot: Probe) -> None:
    async with connect() as script:
        with pytest.raises(UnknownName, match=r"no topic 'scna'; did you mean 'scan'\? known: "):
            script.topic("scna")
        with pytest.raises(BodyLost, match="no message on robot/map"):
            await script.get_sensor_data("map")
        with pytest.raises(Unsupported, match="no joint that can be positioned"):
            await script.set_joint_position("arm", 1.0)


@pytest.mark.slow
async def test_several_robots_are_listed(
    robot: Probe, shared_home: Home, demo: CommandProcess, home: Home
) -> None:
    second = shared_home.start(*AVOID, "--headless", "--world", "house")
    first_at, second_at = await robot_of(shared_home, demo), await robot_of(shared_home, second)
    with pytest.raises(BusError) as error:
        async with connect():
            pass
    text = str(error.value)
    assert text.startswith("several robots run here; choose one with --connect: ")
    assert f"{first_at.connect[0]} (turtlebot3_waffle in arena)" in text
    assert f"{second_at.connect[0]} (turtlebot3_waffle in house)" in text
    second.close()
    async with connect(first_at.connect[0]) as script:
        assert (await script.read_state()).boot == robot.state.boot


@pytest.mark.slow
async def test_errors_distinguish_no_robot_no_router_and_no_driver(
    tmp_path_factory: pytest.TempPathFactory, home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(home.folder / "run"))
    with pytest.raises(BusError, match=r"^no robot runs here; start one with `gigabrain demo`"):
        async with connect():
            pass
    nowhere = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(BusError, match=re.escape(f"no router answers at {nowhere}")):
        async with connect(nowhere):
            pass
    router = home.start("router", "--listen", nowhere)
    await until(lambda: "ready" in router.err, "the router")
    with pytest.raises(BodyLost, match="is the driver running"):
        async with connect(nowhere):
            pass
    with pytest.raises(NotConfirmed, match=r"^NOT CONFIRMED: no driver answers; press the hard"):
        async with connect(nowhere, wait=False) as script:
            await script.estop()


async def test_a_release_waits_until_the_body_is_at_rest(robot: Probe) -> None:
    async with connect(take=True) as script:
        assert isinstance(script, Robot)
        await script.set_base_velocity(0.15, 0.0, 0.0)
        await until(lambda: robot.state.velocity.linear_x > 0.1, "motion")
        await script.estop("test")
        assert (await script.release()).ok
        await robot.enable_brain()
