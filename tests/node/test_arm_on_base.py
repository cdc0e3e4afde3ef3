"""A base that carries an arm, driven by all of the robot's processes in memory."""

import asyncio
import math
from collections.abc import Callable, Mapping
from pathlib import Path

from msgspec.structs import replace

from gigabrain_drivers.bodies.mock.driver import MockOptions
from gigabrain_drivers.driver.catalog import load_robot, robot_path
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Joint, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.requests import EstopRequest
from gigabrain_schemas.topics import CMD_VEL, ESTOP
from gigabrain_zenoh import codec
from gigabrain_zenoh.testing.in_memory import RecordedBody, RobotInMemory

LEKIWI = load_robot("lekiwi")
assert LEKIWI.arm
ARM = LEKIWI.arm


class Carrier(RecordedBody):
    """A body in memory with LeKiwi's arm, whose joints reach their targets at once."""

    def __init__(self, robot: RobotFile, options: MockOptions, run: Run) -> None:
        carrier = replace(robot, joints=LEKIWI.joints, arm=ARM)
        folder = robot_path("lekiwi").parent
        super().__init__(carrier, options, replace(run, folder=folder))
        names = (joint.name for joint in LEKIWI.joints)
        self.positions = dict(zip(names, ARM.home, strict=True))
        self.commanded: list[float] = []  # forward speeds [m/s]
        self.while_sending: Callable[[], None] = lambda: None
        self.stops = 0

    async def set_joint_positions(self, positions: Mapping[str, float]) -> Mapping[str, float]:
        self.positions |= positions
        self.while_sending()
        return dict(positions)

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        self.commanded.append(linear_x)
        return await super().set_base_velocity(linear_x, linear_y, angular_z)

    async def stop(self) -> None:
        self.stops += 1
        await super().stop()

    async def read_state(self) -> RobotState:
        joints = tuple(Joint(name=name, position=at) for name, at in self.positions.items())
        return replace(await super().read_state(), joints=joints)


async def test_a_nan_command_during_joint_writes_stops_the_wheels_at_once(
    tmp_path: Path,
) -> None:
    async with RobotInMemory(tmp_path, make_body=Carrier) as robot:
        await robot.go(200)
        body = robot.body
        assert isinstance(body, Carrier)
        assert body.commanded[-1] > 0.2
        assert tuple(body.positions.values()) == ARM.home

        def send_nan() -> None:
            assert robot.state
            body.while_sending = lambda: None
            body.commanded.clear()
            wrong = CmdVel(linear_x=math.nan, source="control", boot=robot.state.boot)
            robot.network.deliver(CMD_VEL.at(), codec.encode(wrong))

        body.while_sending = send_nan
        await robot.go(2)
        assert body.commanded[0] == 0.0


async def test_a_latched_gate_stops_the_wheels_and_holds_the_joint_targets(
    tmp_path: Path,
) -> None:
    async with RobotInMemory(tmp_path, make_body=Carrier) as robot:
        await robot.go(200)
        body = robot.body
        assert isinstance(body, Carrier)
        commanded = asyncio.ensure_future(robot.operator.ask(ESTOP, EstopRequest(source="test")))
        await robot.go(5)
        assert (await commanded)[0].ok
        assert robot.mode == "latched"
        body.positions[LEKIWI.joints[1].name] -= 0.05  # the joint sags
        body.stops = 0
        body.commanded.clear()
        await robot.go(5)
        assert body.stops == 0  # `stop` would hold the joints at their sagged positions
        assert set(body.commanded) == {0.0}
        assert tuple(body.positions.values()) == ARM.home
