"""Settings of the body that change while it runs: gate, safety, planner and control obey them."""

from itertools import pairwise
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.requests import EnableRequest
from gigabrain_schemas.topics import BODY, CMD_VEL, ENABLE, SAFETY
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.geometry.body_settings import SETTINGS, restricted
from gigabrain_zenoh.geometry.stopping import brakes
from gigabrain_zenoh.testing.in_memory import RobotInMemory
from tests.unit.navigation.drives import CAR, WAFFLE


async def driving(robot: RobotInMemory) -> None:
    for _ in range(20):
        if (await robot.go(10))[-1] == pytest.approx(0.26):
            return
    raise AssertionError(robot.causes)


async def test_the_gate_applies_a_speed_limit_to_every_commander(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        await robot.operator.ask(ENABLE, EnableRequest(source="hasty", take=True))
        assert robot.bus("driver").params.change("max_linear_speed", "0.1") == ("0.26", "0.1")
        speeds = []
        for _ in range(100):
            tick = robot.operator.time.tick
            command = CmdVel(linear_x=0.26, source="hasty")
            robot.operator.publish(CMD_VEL, command, basis=tick)
            speeds += await robot.go(1)
        assert robot.mode == "enabled"
        assert speeds[-1] == pytest.approx(0.1)


async def test_a_driving_body_slows_down_to_a_new_limit_on_its_ramp(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        robot.bus("driver").params.change("max_linear_speed", "0.1")
        speeds = await robot.go(50)
        drops = [before - after for before, after in pairwise(speeds)]
        assert 0.0 < max(drops) <= 0.04 + 1e-9  # two ticks of 1 m/s2: commands come in pairs
        assert speeds[-1] == pytest.approx(0.1)
        assert robot.mode == "enabled"


async def stop_zone(robot: RobotInMemory) -> float:
    """Return safety's stop zone ahead at 0.1 m/s [m], for the newest body description."""
    bodies = robot.operator.latest(BODY)
    await robot.go(60)
    assert bodies.newest
    return brakes(bodies.newest.description)["forward"].distance(0.1)


async def test_a_stop_margin_reaches_safety_and_its_caps(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        before = await stop_zone(robot)
        robot.bus("driver").params.change("stop_margin", "0.5")
        assert await stop_zone(robot) == pytest.approx(before + 0.42)
        caps = []
        robot.operator.subscribe(SAFETY, lambda _key, state: caps.append(state.caps.forward))
        robot.bus("driver").params.change("stop_margin", "3.2")  # the wall is 3 m away
        speeds = await robot.go(100)
        assert caps[-1] == 0.0
        assert speeds[-1] == 0.0
        assert robot.mode == "enabled"


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("max_linear_speed", "0.3", "above the body's own limit, 0.26 m/s"),
        ("max_angular_speed", "50", "above the body's own limit, 1.82 rad/s"),
        ("stop_margin", "0.02", "below the body's own need, 0.08 m"),
        ("side_margin", "0.01", "below the body's own need, 0.03 m"),
        ("stop_margin", "3.5", "the lidar sees no farther than 3.5 m"),
        ("max_linear_speed", "0", "expected"),
        ("max_linear_speed", "-0.1", "max_linear_speed: expected a number, above 0, at most 0.26"),
        ("max_linear_speed", "nan", "max_linear_speed: expected a number, above 0, at most 0.26"),
        ("stop_margin", "0", "stop_margin: expected a number, at least 0.08 [m]"),
        ("stop_margin", "inf", "stop_margin: expected a number, at least 0.08 [m]"),
        ("stop_margin", "much", "expected"),
    ],
)
async def test_unsafe_settings_are_refused_and_change_nothing(
    tmp_path: Path, name: str, value: str, reason: str
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        params, bodies = robot.bus("driver").params, robot.operator.latest(BODY)
        await robot.go(10)
        before = {one.name: one.value for one in params.all()}
        with pytest.raises(Refused) as refused:
            params.change(name, value)
        assert reason.lower() in str(refused.value).lower()
        await robot.go(60)
        assert bodies.newest
        assert bodies.newest.description == load_robot("mock").description()
        assert {one.name: one.value for one in params.all()} == before


async def test_several_settings_can_be_changed_and_changed_back(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        params, bodies = robot.bus("driver").params, robot.operator.latest(BODY)
        await robot.go(1)
        for name, value in (("max_linear_speed", "0.1"), ("stop_margin", "0.2")):
            params.change(name, value)
        await robot.go(60)
        assert bodies.newest
        now = bodies.newest.description
        assert (now.max_linear_speed, now.thresholds.stop_margin) == (0.1, 0.2)
        for name, value in (("max_linear_speed", "0.26"), ("stop_margin", "0.08")):
            params.change(name, value)
        await robot.go(60)
        assert bodies.newest.description == load_robot("mock").description()


async def test_every_setting_has_a_key_in_robot_files(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await robot.go(1)
        keys = {one.key for one in robot.bus("driver").params.all() if one.key}
        sideways = "robot.max_lateral_speed"  # the mock body cannot drive sideways
        assert keys == {f"robot.{path}" for path, one in SETTINGS.items() if one.live} - {sideways}


def test_a_speed_limit_keeps_the_turning_radius_of_a_car() -> None:
    slow = restricted(CAR, {"max_linear_speed": 0.5})
    assert slow.max_linear_speed / slow.max_angular_speed == pytest.approx(0.5)


def test_a_speed_limit_caps_the_following_tolerance() -> None:
    thresholds = replace(WAFFLE.thresholds, follow_linear=0.2)
    slow = restricted(replace(WAFFLE, thresholds=thresholds), {"max_linear_speed": 0.1})
    assert slow.thresholds.follow_linear == 0.1
