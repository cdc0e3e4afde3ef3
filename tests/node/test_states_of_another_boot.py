"""A stranger publishes and serves states of another robot on a driving robot's key."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.topics import STATE
from gigabrain_zenoh import codec
from gigabrain_zenoh.testing.in_memory import BRAIN, RobotInMemory

OTHER_BOOT = 4711
FULL_SPEED_M_S = 0.26
BURST_STATES = 2  # states between two of the robot; three in agreement would be accepted


class Stranger:
    """Publishes states with another boot and pose, and answers queries for the kept state."""

    def __init__(self, robot: RobotInMemory) -> None:
        assert robot.state
        self._robot, self._state, self.queries = robot, robot.state, 0
        self._state = self._next()

    def publish(self) -> None:
        for _ in range(BURST_STATES):
            self._state = self._next()
            self._robot.network.deliver(STATE.key, codec.encode(self._state))

    def _next(self) -> RobotState:
        at = Pose(x=50.0, y=50.0, yaw=3.0)
        seq, tick = self._state.seq + 1, self._state.tick + 1
        return msgspec.structs.replace(
            self._state, seq=seq, tick=tick, boot=OTHER_BOOT, basis=tick, pose=at
        )

    async def answer(self, _: bytes) -> tuple[bytes, str]:
        self.queries += 1
        return codec.encode(self._state), ""


@contextmanager
def stranger(robot: RobotInMemory) -> Iterator[Stranger]:
    stranger_states = Stranger(robot)
    end_serving = robot.network.serve(STATE.key, stranger_states.answer)
    yield stranger_states
    end_serving()


async def driving(robot: RobotInMemory) -> None:
    await robot.go(100)
    assert robot.mode == "enabled"
    assert robot.body.speeds[-1] == pytest.approx(FULL_SPEED_M_S)


async def test_a_driving_robot_is_not_confused_by_states_of_another_boot(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        with stranger(robot) as other:
            for _ in range(100):
                other.publish()
                (speed,) = await robot.go(1)
                assert speed == pytest.approx(FULL_SPEED_M_S)
                assert robot.mode == "enabled"
        own = robot.bus("driver").time
        for name in BRAIN:
            time = robot.bus(name).time
            assert time.boot == own.boot, name
            assert own.tick - 2 <= time.tick <= own.tick, name
        for name in ("control", "safety"):  # perception without a map needs no state
            assert robot.bus(name).counters["refused_ticks"] >= 200, name
        assert robot.counters["stale_commands_executed"] == 0


@pytest.mark.parametrize("name", ["perception", "control"])
async def test_a_process_that_starts_beside_a_stranger_follows_its_own_robot(
    name: str, tmp_path: Path
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        with stranger(robot) as other:
            await robot.kill(name)
            await robot.go(50)
            assert robot.body.speeds[-1] == 0.0
            robot.start(name)
            for _ in range(30):  # two states of the stranger per five of the robot
                other.publish()
                await robot.go(5)
            if name == "control":  # perception without a map needs no state
                assert other.queries > 0
            assert robot.body.speeds[-1] == pytest.approx(FULL_SPEED_M_S)
            assert robot.bus(name).time.boot == robot.bus("driver").time.boot
