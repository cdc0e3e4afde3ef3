"""A skid-steered base with an integer, rpm and tick protocol, by its robot.yaml alone."""

import asyncio
from pathlib import Path

import pytest

from gigabrain_drivers.driver.catalog import load_link, robot_path
from gigabrain_drivers.driver.robot import Run
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.conformance import kit
from tests.places import ROOT

LINES = """\
real:
  driver: line
  port: usb:1a86:7523
  command: "<M,{wheel_left|rpm:d},{wheel_right|rpm:d}>\\r\\n"
  state: ["<E,{wheel_left_position|tick},{wheel_right_position|tick},{battery_voltage|mV}>\\r\\n"]
  state_hz: 20
  ticks_per_turn: 1440
  battery_empty: 20
  battery_full: 25.2
  scan: {driver: ld19, port: usb:10c4:ea60}
"""
TWO_WHEELS = """\
summary: a skid-steered base as a differential one, on a Waffle's body
robot_type: skidder
drive_type: differential
wheel_separation: 0.287
wheel_radius: 0.033
max_linear_speed: 0.26
max_angular_speed: 1.82
footprint: [[0.075, 0.155], [-0.2, 0.155], [-0.2, -0.155], [0.075, -0.155]]
lidar: {beams: 360, rate_hz: 10, range_min: 0.05, range_max: 12.0, x: -0.064}
sim: {driver: mujoco}
"""
FOUR_WHEELS = """\
summary: a skid-steered base on four wheels, with one motor for each side
robot_type: skidder
drive_type: skid_steer
wheel_separation: 0.32
effective_track: 0.66
wheel_radius: 0.07
max_linear_speed: 0.4
max_angular_speed: 1.2
footprint: [[0.195, 0.185], [-0.195, 0.185], [-0.195, -0.185], [0.195, -0.185]]
lidar: {beams: 360, rate_hz: 10, range_min: 0.05, range_max: 12.0, x: 0.05}
sim: {driver: mujoco}
"""


def robot_file(folder: Path, head: str, model_of: str, lines: str = LINES) -> str:
    folder.mkdir()
    model = robot_path(model_of).with_name("model.xml")
    (folder / "model.xml").write_text(model.read_text())
    (folder / "robot.yaml").write_text(head + lines)
    return str(folder / "robot.yaml")


def test_the_example_in_the_docs_equals_this_file() -> None:
    page = (ROOT / "docs" / "reference" / "firmware_line.md").read_text()
    assert FOUR_WHEELS + LINES in page


@pytest.mark.slow
async def test_a_base_with_integer_rpm_and_ticks_passes_the_conformance_kit(tmp_path: Path) -> None:
    two = robot_file(tmp_path / "two", TWO_WHEELS, "turtlebot3_waffle")
    four = robot_file(tmp_path / "four", FOUR_WHEELS, "skid_rover")
    checked = await asyncio.gather(
        *(
            kit.check(name, "emulated", tmp_path / f"kit{i}", lambda result: None)
            for i, name in enumerate((two, four))
        )
    )
    for results in checked:
        assert len(results) == 16
        assert [result for result in results if result.verdict == "FAILED"] == []
        skipped = [result.measured for result in results if result.verdict == "skipped"]
        assert [why for why in skipped if "too busy to judge" not in why] == []


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("{wheel_right|rpm:d}", "{wheel_back|rpm:d}", "no wheel_back on a skid_steer base"),
        (",{wheel_right|rpm:d}", "", "no {wheel_right}"),
        ("|rpm:d},{wheel_right|rpm:d}", "|turns:d},{wheel_right|rpm:d}", "turns"),
        ("  ticks_per_turn: 1440\n", "", "ticks_per_turn"),
        ("  battery_full: 25.2\n", "", "battery_full"),
        (",{wheel_right_position|tick}", "", "must stand in one line"),
    ],
)
def test_invalid_line_templates_are_refused_with_their_line(
    tmp_path: Path, old: str, new: str, problem: str
) -> None:
    assert old in LINES
    file = robot_file(tmp_path / "four", FOUR_WHEELS, "skid_rover", LINES.replace(old, new))
    with pytest.raises(ConfigError) as refused:
        load_link(file, Run(folder=Path(), link="emulated"))
    assert problem in str(refused.value)
    assert str(refused.value).startswith(f"{file}:1")
