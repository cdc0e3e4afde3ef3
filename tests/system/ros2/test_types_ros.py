"""Our types compared with real ROS 2: hashes, and values in both directions."""

import random
from typing import Any

import pytest

from gigabrain_zenoh.ros2.type_files import DUMMY
from gigabrain_zenoh.ros2.types import Types
from tests.ros2.judge import Judge, Program
from tests.unit.ros2.random_messages import random_fields

INTERNAL = ("_Event",)  # types of service introspection, which rclpy does not import by name


@pytest.fixture(scope="module")
def types() -> Types:
    return Types()


@pytest.fixture
def codec(shared_judge: Judge) -> Program:
    return shared_judge.start("codec")


def test_hashes_of_all_types_are_those_of_ros(codec: Program, types: Types) -> None:
    theirs = codec.ask("hashes")["hashes"]
    assert len(theirs) > 300
    assert "nav2_msgs/action/NavigateToPose" in theirs
    assert {name: types.hash(name) for name in theirs} == theirs


def test_values_of_all_types_are_the_same_in_both_directions(codec: Program, types: Types) -> None:
    source = random.Random(7)
    theirs = codec.ask("hashes")["hashes"].keys() & set(types.messages())
    names = sorted(name for name in theirs if not name.endswith(INTERNAL))
    assert len(names) > 200
    wrong = []
    for name in names:
        fields = random_fields(types, name, source)
        message = types.from_dict(name, fields)
        payload = types.encode(name, message).hex()
        read = codec.ask("deserialize", type=name, payload=payload)["value"]
        written = bytes.fromhex(codec.ask("serialize", type=name, value=fields)["payload"])
        ours = types.to_dict(types.decode(name, written))
        if _without_additions(read) != _without_additions(fields) or ours != types.to_dict(message):
            wrong.append(name)
    assert wrong == []


def _without_additions(value: Any) -> Any:
    """Return the value without the additions of rclpy: lists around bytes, and a dummy field."""
    if isinstance(value, dict):
        return {name: _without_additions(each) for name, each in value.items() if name != DUMMY}
    if isinstance(value, list):
        return (
            _without_additions(value[0])
            if len(value) == 1
            else [_without_additions(each) for each in value]
        )
    return value
