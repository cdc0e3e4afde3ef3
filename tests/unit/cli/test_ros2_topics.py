"""`gigabrain ros2 topics` on a computer without a robot, and wrong options of ROS."""

import importlib
from collections.abc import Callable
from functools import partial

import pytest

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.errors import ConfigError

ros2 = importlib.import_module("gigabrain_zenoh.cli.ros2")


@pytest.mark.parametrize(
    "given", [{"router": "tcp/127.0.0.1:7447"}, {"transport": "dds", "domain": 7}]
)
def test_a_network_of_ros_that_is_named_needs_no_robot(
    given: dict[str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: str
) -> None:
    joined: list[Ros2Link] = []

    async def listed(link: Ros2Link, _types: object, *, all_topics: bool) -> list[object]:
        joined.append(link)
        return []

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # no robot runs here
    monkeypatch.setattr(ros2, "_listed", listed)
    ros2.topics(options=ros2.RosLinkOptions(**given))
    assert joined == [Ros2Link(**given)]


@pytest.mark.parametrize(
    ("command", "made"),
    [
        (ros2.ros2, ros2.RosOptions),
        (ros2.topics, ros2.RosLinkOptions),
        (partial(ros2.pass_, "/a", "b", "c"), ros2.RosLinkOptions),
    ],
)
def test_a_wrong_namespace_of_ros_is_refused_by_its_own_option(
    command: Callable[..., object], made: Callable[..., object]
) -> None:
    robot = ros2.RobotAddress(connect="tcp/127.0.0.1:7447")
    with pytest.raises(ConfigError, match=r"^--ros-namespace: expected a string such as /"):
        command(options=made(ros_namespace="red"), at=robot)
