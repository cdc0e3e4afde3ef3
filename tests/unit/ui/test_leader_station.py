"""An arm that follows another one: slowly to its posture, then as fast as it moves."""

import asyncio
import math
from typing import cast

import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.body import BodyDescription, GateStatus, RobotState
from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import GateReply
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import ConfigError, Refused, Unsupported
from gigabrain_zenoh.testing.waiting import until
from gigabrain_zenoh.ui.leader_station import APPROACH_SPEED, LeaderStation, follower_posture

ARM = load_robot("so101").description()
LEKIWI = load_robot("lekiwi").description()
NAMES = [joint.name for joint in ARM.joints]
LOST = "the leader at /dev/ttyACM1: unplugged?"
DEGREE = math.radians(1.0)


class Follower:
    """A robot whose joints move by 1° per call with a speed, and at once without one."""

    def __init__(self, mode: str = "idle", body: BodyDescription = ARM) -> None:
        self.body, self.mode = body, mode
        self.at = dict.fromkeys((joint.name for joint in body.joints), 0.0)
        self.speeds: list[float | None] = []
        self.requests: list[str] = []

    async def read_body(self) -> BodyDescription:
        return self.body

    async def read_state(self) -> RobotState:
        gate = GateStatus(mode=self.mode, commander="control")  # type: ignore[arg-type]
        return replace(example(RobotState), gate=gate)

    async def enable(self, *, take: bool) -> GateReply:
        self.requests.append(f"enable take={take}")
        return example(GateReply)

    async def stop(self) -> None:
        self.requests.append("stop")

    async def estop(self, reason: str) -> GateReply:
        self.requests.append(f"estop {reason}")
        return replace(example(GateReply), robot_type="so101", text="stopped")

    async def track_joint_positions(
        self, positions: dict[str, float], *, speed: float | None
    ) -> dict[str, float]:
        await asyncio.sleep(0)
        self.speeds.append(speed)
        for name, position in positions.items():
            max_step = DEGREE if speed else math.inf
            self.at[name] += max(-max_step, min(max_step, position - self.at[name]))
        return dict(self.at)


class ScriptedLeader:
    """A leader with one posture for each reading; after the last one it is unplugged."""

    def __init__(self, *postures: dict[str, float]) -> None:
        self.postures = [dict.fromkeys(NAMES, 0.0) | one for one in postures]

    async def read(self) -> dict[str, float]:
        if not self.postures:
            raise ConfigError(LOST)
        return self.postures.pop(0)


def pan(*degrees: float) -> ScriptedLeader:
    return ScriptedLeader(*({"shoulder_pan": math.radians(one)} for one in degrees))


async def lead(robot: Follower, leader: ScriptedLeader, *, take: bool = False) -> list[str]:
    """Lead until the leader is lost; return the lines that were shown."""
    lines: list[str] = []
    with pytest.raises(ConfigError, match=LOST):
        await LeaderStation(cast(Robot, robot), leader, lines.append).drive(take)
    return lines[1:]  # without the help


async def test_it_approaches_the_leader_slowly_and_then_follows() -> None:
    robot = Follower()
    lines = await lead(robot, pan(*[60.4] * 60, 65.0, 75.0, 85.0))
    assert lines == [
        "slowly to the leader's posture: shoulder_pan has 59 deg to go",
        "slowly to the leader's posture: shoulder_pan has 9 deg to go",
        "following",
    ]
    assert robot.speeds == [APPROACH_SPEED] * 58 + [None] * 5
    assert robot.at["shoulder_pan"] == pytest.approx(math.radians(85))
    assert robot.requests == ["enable take=False"]


async def test_a_follower_that_falls_behind_approaches_slowly_again() -> None:
    robot, leader = Follower(), pan(0.0, 1.0, 70.0, 70.0, 70.0)
    held = robot.track_joint_positions

    async def stuck(positions: dict[str, float], *, speed: float | None) -> dict[str, float]:
        return await held({} if len(robot.speeds) < 4 else positions, speed=speed)

    robot.track_joint_positions = stuck  # type: ignore[method-assign]
    lines = await lead(robot, leader)
    assert lines == ["following", "slowly to the leader's posture: shoulder_pan has 70 deg to go"]
    assert robot.speeds == [APPROACH_SPEED, None, None, APPROACH_SPEED, APPROACH_SPEED]


async def test_positions_outside_a_joint_s_range_are_clamped() -> None:
    robot = Follower()
    await lead(robot, pan(*[115.0] * 150))
    assert robot.at["shoulder_pan"] == ARM.joints[0].upper


async def test_an_arm_on_a_base_follows_joints_of_the_same_names() -> None:
    robot = Follower(body=LEKIWI)
    await lead(robot, pan(*[5.0] * 10))
    assert robot.at["arm_shoulder_pan"] == pytest.approx(math.radians(5))


def test_a_leader_with_other_joints_is_refused() -> None:
    posture = dict.fromkeys(NAMES, 0.0)
    with pytest.raises(
        ConfigError, match=r"piper cannot follow a leader of shoulder_pan, .*joint1"
    ):
        follower_posture(load_robot("piper").description(), posture)
    with pytest.raises(Unsupported, match="turtlebot3_waffle has no arm"):
        follower_posture(load_robot("turtlebot3_waffle").description(), posture)


async def test_a_robot_with_another_commander_is_taken_only_with_take() -> None:
    robot = Follower("enabled")
    station = LeaderStation(cast(Robot, robot), pan(0.0), print)
    with pytest.raises(Refused, match="control drives; take it over with --take"):
        await station.drive(take=False)
    assert not robot.requests
    assert not robot.speeds
    await lead(robot, pan(0.0), take=True)
    assert robot.requests == ["enable take=True"]


async def still() -> dict[str, float]:
    return dict.fromkeys(NAMES, 0.0)


@pytest.mark.parametrize(
    ("key", "last_request", "line"),
    [
        ("x", "stop", "so101 holds where it is"),
        (" ", "estop teleop", "CONFIRMED by so101: stopped"),
    ],
)
async def test_keys_end_following(key: str, last_request: str, line: str) -> None:
    robot, lines = Follower(), list[str]()
    leader = ScriptedLeader()
    leader.read = still  # type: ignore[method-assign]
    station = LeaderStation(cast(Robot, robot), leader, lines.append)
    driving = asyncio.ensure_future(station.drive(take=False))
    await until(lambda: robot.speeds)
    station._on_typed(key)
    await driving
    assert robot.requests == ["enable take=False", last_request]
    assert lines[-1] == line
