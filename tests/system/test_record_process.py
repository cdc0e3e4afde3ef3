"""The recorder beside a real robot: as a command, as a process of a deployment, and killed."""

import os
import signal
from pathlib import Path

import pytest

from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.recording.bag_reader import faults, read_info
from gigabrain_zenoh.testing.processes import Home, endpoint_of
from gigabrain_zenoh.testing.waiting import until

ALL_PROCESSES = ["router", "driver", "perception", "decision", "control", "safety", "recorder"]


def sizes(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_size for path in folder.glob("*.mcap")}


@pytest.mark.slow
async def test_a_killed_recorder_does_not_affect_the_robot_and_its_file_is_recovered(
    home: Home,
) -> None:
    folder = home.folder / "bags"
    file = home.deployment(
        resume="auto",
        hosts={"robot": ALL_PROCESSES},
        recorder={"folder": str(folder), "keep_free_mb": 0},
    )
    up = home.start("up", str(file))
    async with probing(endpoint_of(file)) as robot:
        await robot.driving_straight(speed=0.15)
        await until(lambda: max(sizes(folder).values(), default=0) > 50_000, "a recording grows")
        (first,) = sizes(folder)
        before = robot.state
        os.kill(await robot.pid("recorder"), signal.SIGKILL)
        await until(lambda: len(sizes(folder)) == 2, "a second recording")
        await until(lambda: read_info(folder / first).finished, "the first is mended")
        assert robot.state.boot == before.boot
        assert "recorder ended with signal 9" in up.out

        by_hand = home.start(
            "record", "-o", str(home.folder / "hand.mcap"), "--connect",
            endpoint_of(file).connect[0], "--topics", "state", "scan",
        )  # fmt: skip
        await until(lambda: sizes(home.folder).get("hand.mcap", 0) > 20_000, "one by hand as well")
        by_hand.send(signal.SIGINT)
        assert await by_hand.ended() == 0
        assert "missing 0  dropped 0" in by_hand.out
        up.send(signal.SIGINT)
        assert await up.ended() == 0
    assert {key.key for key in read_info(home.folder / "hand.mcap").keys} == {
        "robot/scan",
        "robot/state",
    }
    for name in sizes(folder):
        assert faults(read_info(folder / name)) == [], name
    assert read_info(folder / first).notes["gigabrain"]["world"] == "arena"


async def test_a_recording_that_cannot_start_is_refused_in_one_line(home: Home) -> None:
    there = home.folder / "there.mcap"
    there.write_text("mine")
    lost = await home.run("record", "--connect", "tcp/127.0.0.1:9")
    assert lost.err.startswith("gigabrain: no router answers at tcp/127.0.0.1:9; is the robot")
    assert await lost.ended() == 1
    none = await home.run("record", "--split-time", "-1")
    assert none.err.startswith("gigabrain: --split-time: expected a number above 0, got -1")
    assert await none.ended() == 2
    demo = await home.run("demo", "--record", str(there))
    assert demo.err == f"gigabrain: {there} exists; choose another file\n"
    assert await demo.ended() == 2
