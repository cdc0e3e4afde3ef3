"""A recording as a LeRobot dataset. Loading it with lerobot, a heavy package, was tried by hand."""

import importlib.util
import json
import math
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.body import Body, GateStatus, Joint, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_zenoh import codec
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.drives import file_of
from gigabrain_zenoh.recording.bag_writer import ReceivedMessage
from gigabrain_zenoh.recording.lerobot import (
    columns,
    convert,
    episodes,
    features,
    frames,
    layout_of,
)
from tests.node.test_record_replay import RECORDINGS
from tests.unit.recording import bags


def enabled(states: range) -> Iterator[ReceivedMessage]:
    """States with the gate open, each after a command of a thousandth of its number."""
    for seq in states:
        at_ns = seq * 20_000_000
        command = codec.encode(CmdVel(linear_x=seq / 1000, source="control"))
        yield bags.arrival(at_ns - 2, "robot/cmd_vel", command)
        state = msgspec.msgpack.decode(bags.state(seq), type=RobotState)
        gate = GateStatus(mode="enabled", commander="control")
        state = msgspec.structs.replace(state, gate=gate)
        yield bags.arrival(at_ns, "robot/state", codec.encode(state))


def test_a_frame_is_every_fifth_state_with_the_command_of_then(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    bags.write(path, enabled(range(1, 22)))
    found = list(frames(path))
    assert [frame.tick for frame in found] == [5, 10, 15, 20]
    assert found[1].state == pytest.approx([0.1, 0.0, 0.0, 0.1, 0.0, 0.0])
    assert found[1].action == pytest.approx([0.010, 0.0, 0.0])


@pytest.mark.parametrize("key", ["robot/cmd_vel", "robot/base/cmd"])
def test_the_action_is_the_command_of_the_commander_by_whatever_key(
    tmp_path: Path, key: str
) -> None:
    def driven_in_turn() -> Iterator[ReceivedMessage]:
        for seq in range(1, 21):
            commander = "script" if seq > 10 else "control"
            gate = GateStatus(mode="enabled", commander=commander)
            state = msgspec.msgpack.decode(bags.state(seq), type=RobotState)
            state = msgspec.structs.replace(state, gate=gate)
            yield bags.arrival(seq * 20_000_000, "robot/state", codec.encode(state))
            for place, (source, speed) in enumerate((("script", 0.2), ("control", 0.1))):
                command = codec.encode(CmdVel(linear_x=speed, source=source))
                sent = bags.arrival(seq * 20_000_000 + 1 + place, key, command)
                yield sent._replace(encoding=codec.encoding_of(CmdVel))

    path = tmp_path / "a.mcap"
    bags.write(path, driven_in_turn())
    actions = [frame.action[0] for frame in frames(path)]
    assert actions == pytest.approx([0.1, 0.1, 0.2, 0.2])


def test_a_new_commander_begins_without_a_command(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    state = msgspec.msgpack.decode(bags.state(25), type=RobotState)
    gate = GateStatus(mode="enabled", commander="script")
    state = msgspec.structs.replace(state, gate=gate)
    begun = bags.arrival(25 * 20_000_000, "robot/state", codec.encode(state))
    bags.write(path, iter([*enabled(range(1, 21)), begun]))
    assert [frame.action[0] for frame in frames(path)][-2:] == pytest.approx([0.02, 0.0])


def arm(states: range) -> Iterator[ReceivedMessage]:
    """States of an SO-101 whose pan goes from -90 degrees on, 1 degree before where it was sent."""
    body = load_robot("so101").description()
    yield bags.arrival(0, "robot/body", codec.encode(Body(description=body, link="sim")))
    for seq in states:
        pan = math.radians(seq - 90)
        places = (pan, -1.0, 0.5, 0.0, 0.0, body.joints[-1].upper)
        joints = zip(body.joints, places, strict=True)
        state = msgspec.structs.replace(
            msgspec.msgpack.decode(bags.state(seq), type=RobotState),
            gate=GateStatus(mode="enabled"),
            joints=tuple(Joint(name=joint.name, position=place) for joint, place in joints),
            joints_sent=(pan + math.radians(1.0), *places[1:]),
        )
        yield bags.arrival(seq * 20_000_000, "robot/state", codec.encode(state))


def test_joints_are_in_degrees_and_the_gripper_in_per_cent(tmp_path: Path) -> None:
    path = tmp_path / "arm.mcap"
    bags.write(path, arm(range(1, 12)))
    layout = layout_of(path)
    found = list(frames(path, layout))
    assert (layout.hz, [frame.tick for frame in found]) == (25, [2, 4, 6, 8, 10])
    right = [-88.0, math.degrees(-1.0), math.degrees(0.5), 0.0, 0.0, 100.0]
    assert found[0].state == pytest.approx(right, abs=1e-3)
    assert found[0].action == pytest.approx([-87.0, *right[1:]], abs=1e-3)
    names = features(layout, 0)["observation.state"]["names"]
    assert (names[0], names[-1]) == ("shoulder_pan.pos", "gripper.pos")
    assert features(layout, 0)["action"]["names"] == names


def test_an_episode_ends_where_the_states_break_off_or_the_gate_shuts(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    shut = (a for a in bags.drive(80) if a.header.seq > 60)
    told = [*enabled(range(1, 22)), *enabled(range(31, 61)), *shut, *enabled(range(81, 86))]
    bags.write(path, iter(told))
    assert [[frame.tick for frame in row] for row in episodes(path)] == [
        [5, 10, 15, 20],
        [35, 40, 45, 50, 55, 60],
    ]


def test_a_column_has_a_row_per_frame() -> None:
    (row,) = episodes(file_of(RECORDINGS, "arena"))
    table = columns(row, episode=2, first=7, hz=10)
    assert table["observation.environment_state"].shape == (len(row), 360)
    assert np.isfinite(table["observation.environment_state"]).all()
    assert table["index"][:3].tolist() == [7, 8, 9]
    assert table["timestamp"][:3] == pytest.approx([0.0, 0.1, 0.2])
    assert set(table["episode_index"].tolist()) == {2}


@pytest.mark.skipif(not importlib.util.find_spec("pyarrow"), reason="pyarrow is not installed")
def test_the_dataset_has_the_folders_of_the_format(tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    assert convert(file_of(RECORDINGS, "house"), folder).startswith(f"{folder}: 1 episodes, ")
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"]) == ("v3.0", 10)
    from pyarrow import parquet

    table = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    assert table.num_rows == info["total_frames"]
    assert set(table.column_names) == set(info["features"])
    (episode,) = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert (episode["dataset_to_index"], episode["tasks"]) == (info["total_frames"], ["drive"])


def test_a_recording_without_a_drive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    bags.write(path, bags.drive(20))
    with pytest.raises(ConfigError, match="the gate was never enabled"):
        episodes(path)
