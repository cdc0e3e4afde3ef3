"""A stop or a restart of the driver ends a motion: an enable alone does not resume it."""

import asyncio
import math
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import Body, GateMode, GateStatus, Joint, RobotState
from gigabrain_schemas.brain import CmdVel, JointCommand
from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import EnableRequest, GateReply, ReleaseRequest
from gigabrain_schemas.topics import BODY, ENABLE, JOINT_CMD, RELEASE, STATE, command_topic
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.waiting import PATIENCE_S

BODY_NOW = example(Body)
JOINT = BODY_NOW.description.joints[0]
GOAL = 0.9 * JOINT.upper


class Driver:
    """A driver whose gate grants the body to anyone, and whose joints follow at once."""

    def __init__(self, net: Net) -> None:
        self.bus, self.clock = net.one, net.clock
        self.gate = GateStatus(mode="idle")
        self.commands, self.joints = list[CmdVel](), dict[str, float]()
        self.most = math.inf  # [rad] or [m], beyond which safety lets no joint go
        self._published = asyncio.Event()
        self.bus.time.boot, self.bus.time.tick = 7, 180_000
        for joint in BODY_NOW.description.joints:
            self.joints[joint.name] = max(joint.lower, min(joint.upper, 0.0))
        command = command_topic(BODY_NOW.description)
        self.bus.subscribe(command, lambda _, message: self.commands.append(message))
        self.bus.subscribe(JOINT_CMD, self._move)
        self.bus.serve(ENABLE, self._enable)
        self.bus.serve(RELEASE, self._release)

    def _move(self, _key: str, command: JointCommand) -> None:
        if self.gate.mode == "enabled" and command.position:
            wanted = zip(command.name, command.position, strict=True)
            self.joints |= {name: min(place, self.most) for name, place in wanted}

    async def _enable(self, request: EnableRequest) -> GateReply:
        enables = self.gate.enables + 1
        self.gate = GateStatus(mode="enabled", commander=request.source, enables=enables)
        return GateReply(ok=True, text="", robot_type="m", gate=self.gate)

    async def _release(self, _: ReleaseRequest) -> GateReply:
        self.gate = replace(self.gate, mode="idle")
        return GateReply(ok=True, text="", robot_type="m", gate=self.gate)

    async def ticks(self, count: int) -> None:
        """Wait for `count` states."""
        for _ in range(count):
            self._published.clear()
            await self._published.wait()

    async def run(self) -> None:
        """Publish states for ever."""
        while True:
            self.bus.time.tick += 1
            await self.clock.advance(TICK_NS)
            state = replace(
                example(RobotState),
                gate=self.gate,
                velocity=Velocity(),
                joints=tuple(Joint(name=n, position=p, velocity=0) for n, p in self.joints.items()),
                joints_sent=tuple(self.joints.values()),
                limp=False,
            )
            self.bus.publish(BODY, BODY_NOW)
            self.bus.publish(STATE, state)
            self._published.set()
            await asyncio.sleep(0)


@pytest.fixture
async def net() -> Net:
    return Net()


@pytest.fixture
async def driver(net: Net) -> AsyncIterator[Driver]:
    made = Driver(net)
    running = asyncio.ensure_future(made.run())
    yield made
    running.cancel()


@pytest.mark.parametrize("mode", ["latched", "idle"])
async def test_a_base_does_not_drive_on_after_the_driver_has_started_anew(
    net: Net, driver: Driver, mode: str
) -> None:
    robot = Robot(net.two)
    await robot.set_base_velocity(0.1)
    await robot._wait_ticks(5)
    assert driver.commands[-1].linear_x == 0.1
    driver.bus.time.boot, driver.bus.time.tick = 8, 0
    driver.gate = GateStatus(mode=mode)  # type: ignore[arg-type]
    await robot._wait_ticks(5)
    await robot.release()
    await robot.enable()
    driver.commands.clear()
    await robot._wait_ticks(20)
    assert [one for one in driver.commands if one.linear_x] == []


@pytest.mark.parametrize(
    "begin",
    [
        lambda robot: robot.set_joint_positions({JOINT.name: GOAL}),
        lambda robot: robot.set_joint_trajectory([(2.0, {JOINT.name: GOAL})]),
        lambda robot: robot.move(1.0),
        lambda robot: robot.drive(0.1, seconds=5.0),
    ],
    ids=["positions", "trajectory", "move", "drive"],
)
@pytest.mark.parametrize("mode", ["latched", "idle", "enabled"])
async def test_a_motion_ends_when_the_driver_has_started_anew(
    net: Net, driver: Driver, mode: GateMode, begin: Callable[[Robot], Coroutine[Any, Any, object]]
) -> None:
    robot = Robot(net.two)
    moving = asyncio.ensure_future(begin(robot))
    await robot._wait_ticks(25)
    driver.bus.time.boot, driver.bus.time.tick = 8, 0
    source = net.two.process if mode == "enabled" else ""
    driver.gate = GateStatus(mode=mode, commander=source)
    await robot._wait_ticks(3)
    driver.commands.clear()
    stopped = driver.joints[JOINT.name]
    with pytest.raises(Refused, match=r"the driver was restarted; ask again with enable"):
        await asyncio.wait_for(moving, PATIENCE_S)
    await robot._wait_ticks(25)
    assert [one for one in driver.commands if one.linear_x] == []
    assert driver.joints[JOINT.name] == stopped
    assert driver.gate.enables == 0


async def test_an_arm_does_not_go_on_after_an_e_stop_by_somebody_else(
    net: Net, driver: Driver
) -> None:
    robot = Robot(net.two)
    moving = asyncio.ensure_future(robot.set_joint_positions({JOINT.name: GOAL}))
    await robot._wait_ticks(25)
    driver.gate = GateStatus(mode="latched", enables=1, estop_generation=1)
    with pytest.raises(Refused, match="the gate has stopped the robot"):
        await moving
    stopped = driver.joints[JOINT.name]
    await robot.release()
    await robot.enable()
    await robot._wait_ticks(50)
    assert 0.0 < driver.joints[JOINT.name] == stopped < 0.9 * GOAL
    await robot.set_joint_positions({JOINT.name: GOAL})
    assert driver.joints[JOINT.name] == pytest.approx(GOAL, abs=0.01)


@pytest.mark.parametrize("path", [False, True])
async def test_joints_that_safety_holds_back_are_not_waited_for_and_stay_there(
    net: Net, driver: Driver, path: bool
) -> None:
    robot = Robot(net.two)
    driver.most = 0.5 * GOAL
    points = [(1.0, {JOINT.name: GOAL})]
    moving = robot.set_joint_trajectory(points) if path else robot.set_joint_positions(points[0][1])
    found = await asyncio.wait_for(moving, PATIENCE_S)
    assert found[JOINT.name] == pytest.approx(0.5 * GOAL)
    driver.most = math.inf
    await robot._wait_ticks(50)
    assert driver.joints[JOINT.name] == pytest.approx(0.5 * GOAL, abs=0.05 * GOAL)


@pytest.mark.parametrize("speed", [0.0, -0.1, math.nan])
async def test_a_speed_that_is_none_moves_no_joint(net: Net, driver: Driver, speed: float) -> None:
    robot = Robot(net.two)
    with pytest.raises(ConfigError, match=r"^speed: expected more than 0, got "):
        await robot.track_joint_positions({JOINT.name: GOAL}, speed=speed)
    await robot._wait_ticks(25)
    assert driver.joints[JOINT.name] == 0.0


@pytest.mark.parametrize(
    "motion",
    [
        lambda robot: robot.move(1.0),
        lambda robot: robot.turn(3.0),
        lambda robot: robot.drive(0.1, 0.1, seconds=9.0),
    ],
)
async def test_a_motion_of_the_base_that_is_cut_short_stops_it(
    net: Net, driver: Driver, motion: Callable[[Robot], Coroutine[Any, Any, object]]
) -> None:
    robot = Robot(net.two)
    moving = asyncio.create_task(motion(robot))
    await driver.ticks(10)
    last = driver.commands[-1]
    assert last.linear_x or last.angular_z
    moving.cancel()
    await driver.ticks(5)
    driver.commands.clear()
    await driver.ticks(10)
    assert driver.commands
    assert [one for one in driver.commands if one.linear_x or one.angular_z] == []
    assert moving.cancelled()


@pytest.mark.parametrize(
    "motion",
    [
        lambda robot: robot.set_joint_positions({JOINT.name: GOAL}, speed=0.2),
        lambda robot: robot.set_joint_trajectory([(9.0, {JOINT.name: GOAL})]),
    ],
)
async def test_a_motion_of_the_arm_that_is_cut_short_stops_it(
    net: Net, driver: Driver, motion: Callable[[Robot], Coroutine[Any, Any, object]]
) -> None:
    robot = Robot(net.two)
    moving = asyncio.create_task(motion(robot))
    await driver.ticks(50)
    assert driver.joints[JOINT.name] > 0.0
    moving.cancel()
    await driver.ticks(25)
    stopped = driver.joints[JOINT.name]
    await driver.ticks(25)
    assert driver.joints[JOINT.name] == stopped < 0.9 * GOAL


async def test_a_motion_of_the_arm_without_waiting_goes_on(net: Net, driver: Driver) -> None:
    robot = Robot(net.two)
    await robot.set_joint_positions({JOINT.name: GOAL}, wait=False)
    await driver.ticks(200)
    assert driver.joints[JOINT.name] == pytest.approx(GOAL, abs=0.01)
