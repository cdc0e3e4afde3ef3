"""The mission with which `gigabrain demo` begins, and what does not fit its body."""

from pathlib import Path
from typing import Any

import pytest

from gigabrain_drivers.driver.catalog import robot_path
from gigabrain_zenoh.cli.config import merged_values, rows_of
from gigabrain_zenoh.cli.demo import RobotOptions
from gigabrain_zenoh.decision.tasks.mission_files import loads
from gigabrain_zenoh.errors import ConfigError, UnknownName


def mission_of(**options: Any) -> str:
    values: Any = RobotOptions(**options).values()
    return str(values["decision"]["settings"].get("mission", ""))


def test_both_arms_move_the_blocks_of_the_table_by_one_mission() -> None:
    path = mission_of(body="so101")
    assert mission_of(body="piper") == path
    assert set(loads(Path(path).read_text(), path).things) == {"red", "green", "blue"}
    assert RobotOptions(body="piper").values()["world"] == "table"


@pytest.mark.long
def test_a_mission_is_for_the_world_of_its_demo_and_for_no_real_arm() -> None:
    assert mission_of(body="piper", world="arena") == ""
    assert mission_of(body="piper", link="real") == ""
    assert mission_of(body="piper", behaviour="avoid") == ""


def robot_with(folder: Path, mission: str) -> str:
    text = robot_path("so101").read_text().replace("mission: blocks", f"mission: {mission}")
    (folder / "robot.yaml").write_text(text)
    return str(folder / "robot.yaml")


def test_a_mission_beside_the_robots_file_is_taken(tmp_path: Path) -> None:
    assert mission_of(body=robot_with(tmp_path, "mine.yaml")) == str(tmp_path / "mine.yaml")


def test_an_unknown_mission_names_the_shipped_ones(tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match="no mission 'block'; did you mean 'blocks'"):
        mission_of(body=robot_with(tmp_path, "block"))


MAP_LINE = "perception.map: so101 has no base, so it cannot localize in a map; leave the map out"
AVOID_LINE = (
    "behaviour avoid turns on the spot, and ackermann_car cannot: its tightest turn has a radius "
    "of 0.45 m; use the behaviour navigate"
)


@pytest.mark.parametrize(
    ("body", "name", "settings", "fault"),
    [
        ("so101", "perception", {"mapping": "localize", "map": "mymap"}, MAP_LINE),
        ("ackermann_car", "decision", {"behaviour": "avoid"}, AVOID_LINE),
    ],
)
def test_a_body_that_cannot_do_as_it_is_told_is_refused(
    body: str, name: str, settings: dict[str, str], fault: str
) -> None:
    values: dict[str, Any] = {"body": body, name: settings}
    with pytest.raises(ConfigError) as error:
        rows_of(merged_values(values, (), ()))
    assert str(error.value) == fault
    assert rows_of(merged_values(values | {"body": "skid_rover"}, (), ()))


def test_a_car_that_others_drive_needs_no_behaviour() -> None:
    assert rows_of(merged_values({"body": "ackermann_car"}, (), ()))


def test_a_host_without_decision_has_no_behaviour() -> None:
    hosts = {"robot": ["router", "driver"]}
    values = {"body": "ackermann_car", "decision": {"behaviour": "avoid"}, "hosts": hosts}
    assert rows_of(merged_values(values, (), ()))
