"""A whole robot in memory gets the fixed set of extremes, one message after the other."""

from pathlib import Path

import msgspec
import pytest

from gigabrain_schemas.topics import BUTTON, ESTOP_SAID, SAFETY, TELEOP
from gigabrain_zenoh.qa.faults.hostile import ExtremeMessage, chosen_extremes
from gigabrain_zenoh.testing.in_memory import RobotInMemory

STOPS = (ESTOP_SAID, BUTTON, TELEOP, SAFETY)  # by their purpose
MEASURED = ("linear_acceleration", "orientation")  # of an accident, which latches
SECONDS = 50  # ticks


@pytest.fixture
def harmless() -> list[ExtremeMessage]:
    return [
        case
        for case in chosen_extremes()
        if case.kind == "topic"
        and case.to not in STOPS
        and not any(word in case.what for word in MEASURED)
    ]


async def test_it_drives_again_within_three_seconds_of_any_message(
    tmp_path: Path, harmless: list[ExtremeMessage]
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        newest: dict[str, bytes] = {}
        ends = robot.operator.tap("robot/**", lambda key, _, payload: newest.update({key: payload}))
        await robot.go(3 * SECONDS)
        own, number = dict(newest), robot.bus("driver").time.boot
        ends()
        for case in harmless:
            assert robot.state
            header = {"boot": number, "tick": robot.state.tick, "basis": robot.state.tick}
            base = msgspec.msgpack.decode(own[case.key]) if case.key in own else None
            robot.network.deliver(case.key, case.payload(base, header))
            speeds = await robot.go(10)
            if max(speeds) < 0.02 or robot.mode != "enabled":
                speeds = await robot.go(3 * SECONDS)
            assert max(speeds[-SECONDS:]) > 0.02, case
            assert robot.mode == "enabled", case
        processes = ("driver", "perception", "decision", "control", "safety")
        assert not any(robot.bus(name).failed.done() for name in processes)
