"""A ROS 2 robot in YAML: a wrong value is rejected with its field and line."""

from pathlib import Path

import pytest

from gigabrain_drivers.bodies.ros2.options import Address, Ros2Options, at_address
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import Run
from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.errors import ConfigError

ROBOT = """\
summary: a robot that speaks ROS 2
robot_type: rosbot
drive_type: differential
wheel_separation: 0.2
wheel_radius: 0.05
max_linear_speed: 0.5
max_angular_speed: 2.0
footprint: [[0.1, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.1, -0.1]]
lidar: {beams: 360, rate_hz: 10, range_min: 0.1, range_max: 8.0}
real:
  driver: ros2
  transport: dds
  domain: 5
  topics:
    command: {type: geometry_msgs/msg/TwistStamped, hz: 20}
    odometry: {name: odom, hz: 30}
    scan: {name: scan}
    imu: {name: imu}
  watchdog: 0.5
"""


def options_of(path: Path, text: str) -> Ros2Options:
    file = path / "robot.yaml"
    file.write_text(text)
    _, _, options, _ = catalog.load_link(str(file), Run(folder=path, link="real"))
    assert isinstance(options, Ros2Options)
    return options


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        ("transport: dds", "transport: udp", r":12: real\.transport: expected one of"),
        ("  transport: dds\n", "", r":10: real: missing field 'transport'"),
        (
            "transport: dds",
            "transport: rmw_zenoh",
            r":10: real: router: it is needed for rmw_zenoh",
        ),
        ("domain: 5", "router: tcp/h:1", r":13: real\.router: DDS has none"),
        ("domain: 5", "domain: 233", r":13: real\.domain: expected"),
        ("domain: 5", "domian: 5", r":13: .*did you mean 'domain'"),
        ("domain: 5", "node: a/b", r":13: real\.node: "),
        ("/TwistStamped", "/Pose", r":15: real\.topics\.command\.type: expected one of"),
        ("type: geometry_msgs/msg/TwistStamped, ", "", r":15: .*missing field 'type'"),
        ("hz: 20", "hz: 2", r":15: real\.topics\.command\.hz: expected"),
        ("hz: 20", "step: 0.4", r":15: real\.topics\.command\.step: expected"),
        ("hz: 20", "frmae: x", r":15: .*did you mean 'frame'"),
        ("name: odom", "name: my odom", r":16: real\.topics\.odometry\.name: "),
        ("hz: 30", "hz: 5", r":16: real\.topics\.odometry\.hz: expected"),
        ("name: scan}", "name: odom}", r":14: real\.topics: scan and odometry have the same name"),
        ("name: scan}", "nan: free}", r":17: real\.topics\.scan\.nan: expected one of"),
        ("name: scan}", "qos: best}", r":17: real\.topics\.scan\.qos: expected one of"),
        ("watchdog: 0.5", "watchdog: never", r":19: real\.watchdog: expected"),
        ("  watchdog: 0.5\n", "", r":10: real: missing field 'watchdog'"),
        ("watchdog: 0.5", "watchdog: 0.5\n  mounting: tf", r":20: real\.mounting: expected one of"),
        (
            "lidar: {beams: 360, rate_hz: 10, range_min: 0.1, range_max: 8.0}\n",
            "",
            r":13: real\.topics: there is a scan, but no `lidar:`",
        ),
        (
            "watchdog: 0.5",
            "watchdog: 0.5\n  scan: {driver: ld19}",
            r":20: real\.scan: the lidar is on a topic",
        ),
    ],
)
def test_a_wrong_value_is_rejected_with_its_line(
    right: str, wrong: str, complaint: str, tmp_path: Path
) -> None:
    assert right in ROBOT
    with pytest.raises(ConfigError, match=complaint):
        options_of(tmp_path, ROBOT.replace(right, wrong))


def test_a_step_that_is_too_coarse_for_the_body_is_rejected(tmp_path: Path) -> None:
    text = ROBOT.replace("hz: 20", "step: 0.1").replace("speed: 0.5", "speed: 0.3")
    with pytest.raises(ConfigError, match=r"step of 0\.1 is too coarse for a body that does 0\.3"):
        options_of(tmp_path, text)


@pytest.mark.parametrize(("watchdog", "guarded"), [("none", True), ("0.5", True), ("0.2", False)])
def test_a_robot_with_a_long_watchdog_or_none_gets_a_guard(
    watchdog: str, guarded: bool, tmp_path: Path
) -> None:
    text = ROBOT.replace("watchdog: 0.5", f"watchdog: {watchdog}")
    assert options_of(tmp_path, text).needs_guard is guarded


def test_the_link_has_the_settings_to_join(tmp_path: Path) -> None:
    link = options_of(tmp_path, ROBOT).link()
    assert (link.transport, link.domain, link.node) == ("dds", 5, "gigabrain_driver")


def test_an_emulators_address_replaces_domain_and_router(tmp_path: Path) -> None:
    file = tmp_path / "base"
    with pytest.raises(ConfigError, match="is its emulator running"):
        at_address(Ros2Link(transport="dds"), file)
    file.write_text("{}]")
    with pytest.raises(ConfigError, match="expected the file of an emulator's port"):
        at_address(Ros2Link(transport="dds"), file)
    file.write_text('{"domain": 150}')
    found = at_address(Ros2Link(transport="dds", domain=5), file)
    assert (found.domain, found.localhost) == (150, True)
    assert Address(router="tcp/127.0.0.1:1").domain == 0


def test_the_shipped_turtlebot3_has_the_topics_of_its_nodes() -> None:
    run = Run(folder=Path(), link="real")
    robot, _, options, _ = catalog.load_link("turtlebot3_ros2", run)
    assert isinstance(options, Ros2Options)
    command = options.topics.command
    assert (command.name, command.type, command.step) == (
        "cmd_vel",
        "geometry_msgs/msg/TwistStamped",
        0.01,
    )
    assert (options.watchdog, options.needs_guard) == ("none", True)
    assert options.topics.battery
    assert options.topics.battery.full == 100
    assert (robot.max_linear_speed, robot.max_angular_speed) == (0.21, 2.63)
    assert robot.lidar
    assert robot.lidar.x == -0.032
