"""Robots and drivers by name, and the robots' files themselves."""

from pathlib import Path

import pytest

from gigabrain_drivers import DRIVERS
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_zenoh.errors import ConfigError, UnknownName


def test_these_robots_come_with_the_package() -> None:
    ours = {"mock", "mycustombot", "turtlebot3_burger", "turtlebot3_waffle"}
    assert ours <= set(catalog.robot_files())


@pytest.mark.parametrize("name", sorted(catalog.robot_files()))
def test_every_robot_file_is_valid_and_named_like_its_folder(name: str) -> None:
    assert catalog.load_robot(name).robot_type == name


@pytest.mark.parametrize(
    ("name", "separation", "speed"),
    [("turtlebot3_waffle", 0.287, 0.26), ("turtlebot3_burger", 0.160, 0.21)],
)
def test_the_turtlebots_have_their_makers_figures(
    name: str, separation: float, speed: float
) -> None:
    robot = catalog.load_robot(name)
    assert (robot.wheel_separation, robot.wheel_radius) == (separation, 0.033)
    assert robot.max_linear_speed == speed
    assert robot.lidar is not None
    assert (robot.lidar.beams, robot.lidar.rate_hz, robot.lidar.range_max) == (360, 10, 3.5)


@pytest.mark.parametrize("name", sorted(DRIVERS))
def test_every_driver_of_the_table_is_a_driver(name: str) -> None:
    assert issubclass(catalog.driver_class(name), Driver)


def test_a_mistyped_robot_suggests_the_right_one() -> None:
    with pytest.raises(UnknownName, match="no robot 'tutlebot3_waffle'; did you mean"):
        catalog.load_robot("tutlebot3_waffle")


def test_the_folder_of_a_robot_suggests_its_file(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("")
    with pytest.raises(UnknownName, match=r"did you mean '.*/robot\.yaml'"):
        catalog.load_robot(str(tmp_path))


@pytest.mark.parametrize(
    ("line", "wrong", "field"),
    [
        ("wheel_radius: 0.033", "wheel_radius: 33", "wheel_radius"),  # millimetres
        ("range_max: 3.5, x: -0.064", "range_max: 3.5, yaw: 90", "yaw"),  # degrees, of the lidar
        ("range_max: 8.0, x: -0.064", "range_max: 8.0, yaw: 90", "yaw"),  # and of a link's lidar
    ],
)
def test_other_units_are_refused(line: str, wrong: str, field: str, tmp_path: Path) -> None:
    text = catalog.robot_path("turtlebot3_waffle").read_text()
    assert line in text
    mine = tmp_path / "robot.yaml"
    mine.write_text(text.replace(line, wrong))
    with pytest.raises(ConfigError, match=f"{field}: expected"):
        catalog.make_driver(str(mine), Run(folder=Path(), link="real"))


async def test_a_body_in_memory_moves_sideways_where_its_file_says_so(tmp_path: Path) -> None:
    text = catalog.robot_path("mock").read_text()
    mine = tmp_path / "robot.yaml"
    mine.write_text(text + "max_lateral_speed: 0.2\n")
    _, driver = catalog.make_driver(str(mine), Run(folder=Path()))
    async with driver as body:
        sent = await body.set_base_velocity(0.0, 0.1, 0.0)
        assert (sent.linear_y, (await body.read_state()).velocity.linear_y) == (0.1, 0.1)


def test_a_mistyped_driver_suggests_the_right_one(tmp_path: Path) -> None:
    mine = tmp_path / "robot.yaml"
    mine.write_text(
        catalog.robot_path("mock").read_text().replace("{driver: mock}", "{driver: mok}")
    )
    with pytest.raises(UnknownName, match="no driver 'mok'; did you mean 'mock'"):
        catalog.make_driver(str(mine), Run(folder=Path()))


@pytest.mark.parametrize(
    ("line", "wrong", "complaint"),
    [
        ("max_linear_speed: 0.26", "max_linear_speed: -1", r":6: max_linear_speed: expected"),
        ("max_linear_speed: 0.26", "max_linear_speed: .nan", r":6: "),
        ("wheel_radius: 0.033", "wheel_radius: big", r":5: wheel_radius: expected a number"),
        ("drive_type: differential", "drive_type: flying", r":3: drive_type: expected"),
        ("robot_type: mock", "robot_tpye: mock", r":2: .*did you mean 'robot_type'"),
        ("robot_type: mock", "robot_type: mock\nrobot_type: mock", r":3: .*robot_type"),
    ],
)
def test_a_wrong_value_is_refused_with_file_and_line(
    tmp_path: Path, line: str, wrong: str, complaint: str
) -> None:
    text = catalog.robot_path("mock").read_text()
    assert line in text
    mine = tmp_path / "robot.yaml"
    mine.write_text(text.replace(line, wrong))
    with pytest.raises(ConfigError, match=r"robot\.yaml" + complaint):
        catalog.make_driver(str(mine), Run(folder=Path()))


def test_a_package_that_is_written_but_not_installed_says_how(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gigabrain-my-bot").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        UnknownName, match=r"no robot 'my_bot' yet.*pip install -e gigabrain-my-bot"
    ):
        catalog.robot_path("my_bot")
