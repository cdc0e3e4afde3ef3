"""Conversion of ROS messages to ours: angles, ranges, mountings, and invalid values."""

import math
from typing import Any, Literal

import numpy as np
import pytest

from gigabrain_drivers.bodies.ros2.conversion import (
    Unusable,
    battery_of,
    command_message,
    cut,
    imu_of,
    joints_of,
    scan_of,
    yaw_of,
)
from gigabrain_drivers.bodies.ros2.frames import FrameTree, Transform, planar
from gigabrain_drivers.bodies.ros2.options import (
    BatteryTopic,
    CommandTopic,
    JointsTopic,
    ScanTopic,
)
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.safety.health import tilt_deg

LIDAR = Lidar(beams=8, rate_hz=10, range_min=0.1, range_max=8.0)
NAN, INF = math.nan, math.inf
TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"


@pytest.fixture(scope="module")
def types() -> Types:
    return Types()


def scan(types: Types, ranges: list[float], **fields: Any) -> Any:
    step = math.tau / len(ranges)
    given = {"angle_increment": step, "range_max": 100.0} | fields
    array = np.array(ranges, np.float32)
    return types.make("sensor_msgs/msg/LaserScan", ranges=array, **given)


def ranges_of(found: Any) -> list[float]:
    return [round(float(each), 3) for each in np.frombuffer(found.ranges, "<f4")]


ONE_TO_8 = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]


@pytest.mark.parametrize(
    ("fields", "options", "expected"),
    [
        ({}, {}, ONE_TO_8),
        ({"angle_min": math.pi}, {}, [5, 6, 7, 8, 1, 2, 3, 4]),
        ({"angle_increment": -math.tau / 8}, {}, [1, 8, 7, 6, 5, 4, 3, 2]),
        ({}, {"clockwise": True}, [1, 8, 7, 6, 5, 4, 3, 2]),
        ({}, {"angle": math.pi / 2}, [7, 8, 1, 2, 3, 4, 5, 6]),
        ({"range_max": 4.5}, {}, [1, 2, 3, 4, INF, INF, INF, INF]),
    ],
)
def test_beams_run_counter_clockwise_from_ahead(
    types: Types, fields: dict[str, Any], options: dict[str, Any], expected: list[float]
) -> None:
    found = scan_of(scan(types, ONE_TO_8, **fields), ScanTopic(**options), LIDAR)
    assert ranges_of(found) == expected
    assert (found.angle_min, found.range_max) == (0.0, 8.0)


def test_ranges_that_are_no_distances_have_the_configured_meaning(types: Types) -> None:
    given = [NAN, 0.0, INF, -INF, -1.0, 0.05, 9.0, 1.0]
    found = ranges_of(scan_of(scan(types, given), ScanTopic(), LIDAR))
    np.testing.assert_equal(found, [NAN, INF, INF, 0.1, NAN, 0.1, INF, 1.0])
    other = ScanTopic(nan="no_return", zero="unknown")
    found = ranges_of(scan_of(scan(types, given), other, LIDAR))
    np.testing.assert_equal(found[:2], [INF, NAN])


def test_more_or_fewer_beams_are_put_into_our_bins(types: Types) -> None:
    many = ranges_of(scan_of(scan(types, [2.0] * 37 + [1.0] + [2.0] * 192), ScanTopic(), LIDAR))
    assert many == [2.0, 1.0, *[2.0] * 6]  # the nearest of all beams in a bin
    few = ranges_of(scan_of(scan(types, [2.0] * 4), ScanTopic(), LIDAR))
    np.testing.assert_equal(few, [2.0, NAN] * 4)


@pytest.mark.parametrize(
    "fields",
    [{"angle_increment": 0.0}, {"angle_increment": NAN}, {"angle_min": INF}],
)
def test_impossible_scans_are_rejected(types: Types, fields: dict[str, float]) -> None:
    with pytest.raises(Unusable):
        scan_of(scan(types, ONE_TO_8, **fields), ScanTopic(), LIDAR)
    empty = types.make("sensor_msgs/msg/LaserScan")
    with pytest.raises(Unusable):
        scan_of(empty, ScanTopic(), LIDAR)


def test_a_scan_is_transformed_to_the_mounting_of_our_lidar(types: Types) -> None:
    # 8 beams inside a round wall of 2 m; the sensor faces backwards, 0.5 m ahead of our lidar
    given = scan(types, [2.0, INF, 2.0, INF, 2.0, INF, 2.0, INF])
    found = ranges_of(scan_of(given, ScanTopic(), LIDAR, planar(0.5, 0.0, math.pi)))
    assert found[0] == 2.5
    assert found[4] == 1.5
    assert found[3] == INF


def test_the_beams_of_an_upside_down_lidar_are_reversed(types: Types) -> None:
    down = Transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    found = scan_of(scan(types, ONE_TO_8), ScanTopic(), LIDAR, down)
    assert ranges_of(found) == [1, 8, 7, 6, 5, 4, 3, 2]


def test_imu_values_are_rotated_into_the_bodys_frame(types: Types) -> None:
    half = math.sin(math.pi / 4)
    message = types.make(
        "sensor_msgs/msg/Imu",
        orientation={"z": half, "w": half},
        angular_velocity={"x": 1.0},
        linear_acceleration={"z": 9.81},
    )
    found = imu_of(message, planar(0.0, 0.0, math.pi / 2).turn)
    assert found.angular_velocity == pytest.approx((0.0, 1.0, 0.0))
    assert found.linear_acceleration == pytest.approx((0.0, 0.0, 9.81))
    assert found.orientation == pytest.approx((0.0, 0.0, 0.0, 1.0))
    for axis in "xyz":
        turned = types.make("sensor_msgs/msg/Imu", orientation={axis: 1.0, "w": 0.0})
        assert imu_of(turned).orientation["xyz".index(axis)] == pytest.approx(1.0)


@pytest.mark.parametrize("orientation", [{}, {"w": 0.0}, {"w": NAN}, {"x": 1.0, "w": 0.0}])
def test_an_imu_without_orientation_has_no_tilt(
    types: Types, orientation: dict[str, float]
) -> None:
    message = types.make(
        "sensor_msgs/msg/Imu",
        orientation=orientation,
        orientation_covariance=np.array([-1.0] + [0.0] * 8),
        angular_velocity={"x": 1.0},
        linear_acceleration={"x": 9.81},
    )
    found = imu_of(message, planar(0.0, 0.0, math.pi / 2).turn)
    assert tilt_deg(found.orientation) is None
    assert found.angular_velocity == pytest.approx((0.0, 1.0, 0.0))
    assert found.linear_acceleration == pytest.approx((0.0, 9.81, 0.0))


@pytest.mark.parametrize(
    "fields",
    [
        {"orientation": {"w": 0.0}},
        {"orientation": {"w": NAN}},
        {"angular_velocity": {"z": NAN}},
        {"linear_acceleration": {"x": 1e6}},
    ],
)
def test_impossible_imu_values_are_rejected(types: Types, fields: dict[str, Any]) -> None:
    message = types.make("sensor_msgs/msg/Imu", **fields)
    with pytest.raises(Unusable):
        imu_of(message)


def test_a_yaw_from_an_invalid_quaternion_is_rejected(types: Types) -> None:
    half = math.sin(math.pi / 4)
    right = types.make("geometry_msgs/msg/Quaternion", z=half, w=half)
    assert yaw_of(right) == pytest.approx(math.pi / 2)
    with pytest.raises(Unusable, match="quaternion"):
        yaw_of(types.make("geometry_msgs/msg/Quaternion", w=0.0))


def test_a_battery_has_percent_and_the_opposite_sign_of_current(types: Types) -> None:
    kind = "sensor_msgs/msg/BatteryState"
    message = types.make(kind, voltage=12.0, percentage=0.75, current=-1.5)
    found = battery_of(message, BatteryTopic())
    assert (found.voltage, found.percentage, found.current) == (12.0, 75.0, 1.5)
    robotis = types.make(kind, voltage=12.0, percentage=83.0, current=NAN)
    found = battery_of(robotis, BatteryTopic(full=100))
    assert (found.percentage, found.current) == (83.0, 0.0)
    with pytest.raises(Unusable):
        battery_of(types.make(kind, voltage=12.0, percentage=NAN), BatteryTopic())


@pytest.mark.parametrize(
    ("percentage", "full", "text"),
    [
        (83.0, 1, "its percentage is 83; expected 0 to 1, or write battery: {full: 100}"),
        (1.2, 1, "its percentage is 1.2; expected 0 to 1, or write battery: {full: 100}"),
        (130.0, 100, "its percentage is 130; expected 0 to 100"),
        (-1.0, 1, "its percentage is -1; expected 0 to 1"),
    ],
)
def test_an_impossible_charge_is_rejected(
    types: Types, percentage: float, full: Literal[1, 100], text: str
) -> None:
    message = types.make("sensor_msgs/msg/BatteryState", voltage=12.0, percentage=percentage)
    with pytest.raises(Unusable) as error:
        battery_of(message, BatteryTopic(full=full))
    assert str(error.value) == text


def test_a_charge_slightly_above_full_is_full(types: Types) -> None:
    message = types.make("sensor_msgs/msg/BatteryState", voltage=12.6, percentage=1.03)
    assert battery_of(message, BatteryTopic()).percentage == 100.0


def test_joints_have_names_positions_and_velocities(types: Types) -> None:
    kind = "sensor_msgs/msg/JointState"
    message = types.make(kind, name=["l", "r"], position=[1.0, 2.0], velocity=[0.033, 0.0])
    found = joints_of(message, JointsTopic(velocity_factor=1 / 0.033, names={"l": "left"}))
    assert [joint.name for joint in found] == ["left", "r"]
    assert found[0].velocity == pytest.approx(1.0)
    without = types.make(kind, name=["l"], position=[1.0])
    assert joints_of(without, JointsTopic())[0].velocity == 0.0
    for wrong in ([1.0], [NAN, 1.0]):
        with pytest.raises(Unusable):
            joints_of(types.make(kind, name=["l", "r"], position=wrong), JointsTopic())


def test_a_speed_is_cut_to_steps_and_keeps_them_in_the_robots_truncation(types: Types) -> None:
    sent = cut(Velocity(linear_x=0.2999, linear_y=-0.0, angular_z=-1.239), 0.01)
    assert (sent.linear_x, sent.angular_z) == pytest.approx((0.29, -1.23))
    topic = CommandTopic(type=TWIST, step=0.01)
    for hundredths in range(-300, 301):
        to = cut(Velocity(linear_x=hundredths / 100), 0.01)
        message = command_message(types, to, topic, 0)
        assert int(message.linear.x * 100) == hundredths  # as in turtlebot3_node


def test_a_stamped_command_has_frame_and_time(types: Types) -> None:
    topic = CommandTopic(type=STAMPED, frame="base")
    message = command_message(types, Velocity(linear_x=0.1), topic, 1_500_000_000_250_000_000)
    assert (message.header.frame_id, message.twist.linear.x) == ("base", 0.1)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_500_000_000, 250_000_000)


def link(types: Types, parent: str, child: str, x: float, yaw: float = 0.0) -> Any:
    half = yaw / 2
    return types.make(
        "geometry_msgs/msg/TransformStamped",
        header={"frame_id": parent},
        child_frame_id=child,
        transform={
            "translation": {"x": x},
            "rotation": {"z": math.sin(half), "w": math.cos(half)},
        },
    )


def test_frames_are_found_through_their_common_ancestor(types: Types) -> None:
    tree = FrameTree()
    tree.add(
        [
            link(types, "base_footprint", "base_link", 0.0),
            link(types, "/base_link", "scan", -0.1, math.pi),
            link(types, "base_link", "imu", 0.3),
            link(types, "other", "camera", 1.0),
        ]
    )
    place = tree.find("scan", "base_footprint")
    assert place
    assert place.planar == pytest.approx((-0.1, 0.0, math.pi))
    between = tree.find("imu", "scan")
    assert between
    assert between.planar == pytest.approx((-0.4, 0.0, -math.pi), abs=1e-9)
    assert tree.find("camera", "base_footprint") is None
    assert tree.find("base_link", "base_link")


def test_frames_in_a_cycle_or_with_invalid_numbers_are_not_connected(types: Types) -> None:
    tree = FrameTree()
    tree.add([link(types, "a", "b", 1.0), link(types, "b", "a", 1.0), link(types, "b", "c", NAN)])
    assert tree.find("a", "root") is None
    assert tree.names == ["a", "b"]
