"""A whole robot in memory gets a fixed set of extreme messages, one after the other."""

from pathlib import Path

import msgspec
import pytest

from gigabrain_schemas.topics import BUTTON, ESTOP_TOPIC, SAFETY, TELEOP
from gigabrain_zenoh.qa.faults.hostile import ExtremeMessage, chosen_extremes
from gigabrain_zenoh.testing.in_memory import RobotInMemory

STOPPING_TOPICS = (ESTOP_TOPIC, BUTTON, TELEOP, SAFETY)  # topics whose purpose is to stop the robot
# extreme values in these fields mean an accident, which latches the gate
LATCHING_FIELDS = ("linear_acceleration", "orientation")
TICKS_PER_S = 50


@pytest.fixture
def harmless() -> list[ExtremeMessage]:
    return [
        case
        for case in chosen_extremes()
        if case.kind == "topic"
        and case.to not in STOPPING_TOPICS
        and not any(word in case.what for word in LATCHING_FIELDS)
    ]


async def test_it_drives_again_within_3_s_of_any_extreme_message(
    tmp_path: Path, harmless: list[ExtremeMessage]
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        newest: dict[str, bytes] = {}
        end_tap = robot.operator.tap(
            "robot/**", lambda key, _, payload: newest.update({key: payload})
        )
        await robot.go(3 * TICKS_PER_S)
        own_messages, boot = dict(newest), robot.bus("driver").time.boot
        end_tap()
        for case in harmless:
            assert robot.state
            header = {"boot": boot, "tick": robot.state.tick, "basis": robot.state.tick}
            base = (
                msgspec.msgpack.decode(own_messages[case.key]) if case.key in own_messages else None
            )
            robot.network.deliver(case.key, case.payload(base, header))
            speeds = await robot.go(10)
            if max(speeds) < 0.02 or robot.mode != "enabled":
                speeds = await robot.go(3 * TICKS_PER_S)
            assert max(speeds[-TICKS_PER_S:]) > 0.02, case
            assert robot.mode == "enabled", case
        processes = ("driver", "perception", "decision", "control", "safety")
        assert not any(robot.bus(name).failed.done() for name in processes)
