"""Odometry, joints, battery, attitude, frames and URDF as ROS reads them."""

import math
from xml.etree import ElementTree as xml

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import Battery, Body, Camera, Joint
from gigabrain_schemas.sensors import Imu, ImuData
from gigabrain_zenoh.gateway.conversions import body, description, frames
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.testing import samples

TYPES = Types()
MAKE = TYPES.make
STAMP = 1_795_580_000_123_456_789
CAMERA = Camera(name="front", x=0.06, z=0.1, pitch=0.2)
BURGER = replace(
    samples.WAFFLE, wheel_separation=0.16, wheel_radius=0.033, body_height=0.192,
    lidar=replace(samples.LIDAR, x=-0.032, yaw=math.pi), cameras=(CAMERA,),
)  # fmt: skip
STATE = replace(
    samples.state(7, v=0.2, w=-0.5, pose=(1.5, -2.0, math.pi / 2)),
    stamp_ns=STAMP,
    velocity=Velocity(linear_x=0.2, linear_y=0.05, angular_z=-0.5),
)


def through_cdr(name, message):
    return TYPES.decode(name, TYPES.encode(name, message))


def test_odometry_is_in_odom_of_the_footprint_with_the_stamp_of_its_state():
    got = through_cdr("nav_msgs/msg/Odometry", body.odometry(MAKE, STATE))
    assert (got.header.frame_id, got.child_frame_id) == ("odom", "base_footprint")
    assert (got.header.stamp.sec, got.header.stamp.nanosec) == (1_795_580_000, 123_456_789)
    at, turn = got.pose.pose.position, got.pose.pose.orientation
    assert (at.x, at.y, at.z) == (1.5, -2.0, 0.0)
    assert (turn.x, turn.y) == (0.0, 0.0)
    assert (turn.z, turn.w) == pytest.approx((0.70710678, 0.70710678))
    twist = got.twist.twist
    assert (twist.linear.x, twist.linear.y, twist.angular.z) == (0.2, 0.05, -0.5)
    assert not got.pose.covariance.any()
    assert len(got.twist.covariance) == 36


def test_efforts_that_are_not_measured_are_nan_or_left_out():
    joints = (Joint(name="wheel_left_joint", position=1.0, velocity=2.0, effort=0.25),
              Joint(name="wheel_right_joint", position=-1.0, velocity=-2.0))  # fmt: skip
    name = "sensor_msgs/msg/JointState"
    got = through_cdr(name, body.joint_states(MAKE, replace(STATE, joints=joints)))
    assert got.name == ["wheel_left_joint", "wheel_right_joint"]
    assert got.position.tolist() == [1.0, -1.0]
    assert got.velocity.tolist() == [2.0, -2.0]
    assert got.effort[0] == 0.25
    assert math.isnan(got.effort[1])
    got = through_cdr(name, body.joint_states(MAKE, replace(STATE, joints=joints[1:])))
    assert len(got.effort) == 0
    assert body.joint_states(MAKE, replace(STATE, joints=())) is None


@pytest.mark.parametrize(
    ("current", "ros_current", "status"), [(1.5, -1.5, 2), (-2.0, 2.0, 1), (0.0, math.nan, 0)]
)
def test_a_battery_is_a_fraction_and_drains_below_zero(current, ros_current, status):
    state = replace(STATE, battery=Battery(voltage=12.0, percentage=80.0, current=current))
    got = through_cdr("sensor_msgs/msg/BatteryState", body.battery_state(MAKE, state))
    assert got.voltage == 12.0
    assert got.percentage == pytest.approx(0.8)
    assert got.current == pytest.approx(ros_current, nan_ok=True)
    assert (got.power_supply_status, got.present) == (status, True)
    for unmeasured in (got.temperature, got.charge, got.capacity, got.design_capacity):
        assert math.isnan(unmeasured)
    assert len(got.cell_voltage) == len(got.cell_temperature) == 0


def test_a_body_without_a_battery_publishes_none():
    assert body.battery_state(MAKE, replace(STATE, battery=None)) is None


def test_an_imu_comes_from_its_topic_or_from_the_state():
    about = {
        "orientation": (0.0, 0.0, 0.6, 0.8),
        "angular_velocity": (0.1, 0.2, 0.3),
        "linear_acceleration": (0.5, -0.5, 9.81),
    }
    of_topic = body.imu(MAKE, Imu(**about, stamp_ns=STAMP))
    of_state = body.imu_of_state(MAKE, replace(STATE, imu=ImuData(**about)))
    for made in (of_topic, of_state):
        got = through_cdr("sensor_msgs/msg/Imu", made)
        assert got.header.frame_id == "imu_link"
        assert got.header.stamp.nanosec == 123_456_789
        assert (got.orientation.z, got.orientation.w) == (0.6, 0.8)
        assert (got.angular_velocity.x, got.angular_velocity.z) == (0.1, 0.3)
        assert got.linear_acceleration.z == 9.81
        assert not got.orientation_covariance.any()
    assert body.imu_of_state(MAKE, replace(STATE, imu=None)) is None


def test_an_imu_without_orientation_says_so_as_ros_does():
    reading = ImuData(
        orientation=(0.0, 0.0, 0.0, 0.0),
        angular_velocity=(0.1, 0.2, 0.3),
        linear_acceleration=(0.0, 0.0, 9.81),
    )
    made = body.imu_of_state(MAKE, replace(STATE, imu=reading))
    got = through_cdr("sensor_msgs/msg/Imu", made)
    assert got.orientation_covariance[0] == -1.0
    assert not got.orientation_covariance[1:].any()
    assert got.angular_velocity.z == 0.3


def test_the_clock_is_the_stamp_of_a_state():
    got = through_cdr("rosgraph_msgs/msg/Clock", body.clock(MAKE, STATE)).clock
    assert (got.sec, got.nanosec) == (1_795_580_000, 123_456_789)


def static():
    made = frames.tf_static(MAKE, replace(samples.body(BURGER), stamp_ns=STAMP))
    found = through_cdr("tf2_msgs/msg/TFMessage", made).transforms
    return {(one.header.frame_id, one.child_frame_id): one.transform for one in found}


def test_static_frames_reach_from_the_footprint_to_each_sensor():
    found = static()
    assert list(found) == [
        ("base_footprint", "base_link"),
        ("base_link", "imu_link"),
        ("base_link", "base_scan"),
        ("base_link", "front_link"),
        ("front_link", "front_optical_frame"),
    ]
    scan = found["base_link", "base_scan"]
    assert (scan.translation.x, scan.translation.y, scan.translation.z) == (-0.032, 0.0, 0.192)
    assert (scan.rotation.z, scan.rotation.w) == pytest.approx((1.0, 0.0))


def rotate(q, v):
    u = np.array((q.x, q.y, q.z))
    return v + 2 * np.cross(u, np.cross(u, v) + q.w * np.array(v))


def test_a_lens_looks_along_z_with_x_to_the_right():
    found = static()
    link, lens = found["base_link", "front_link"], found["front_link", "front_optical_frame"]
    ahead = rotate(link.rotation, rotate(lens.rotation, (0.0, 0.0, 1.0)))
    right = rotate(link.rotation, rotate(lens.rotation, (1.0, 0.0, 0.0)))
    down = rotate(link.rotation, rotate(lens.rotation, (0.0, 1.0, 0.0)))
    assert ahead == pytest.approx((0.98006658, 0.0, -0.19866933))  # pitch 0.2 looks down
    assert right == pytest.approx((0.0, -1.0, 0.0), abs=1e-9)
    assert down == pytest.approx((-0.19866933, 0.0, -0.98006658), abs=1e-8)


def test_wheels_turn_about_their_axles():
    joints = (Joint(name="wheel_left_joint", position=math.pi / 2),)
    state = replace(STATE, joints=joints)
    odom, wheel = body.moving_frames(samples.body(BURGER), state)
    assert (odom.parent, odom.child, odom.x, odom.y) == ("odom", "base_footprint", 1.5, -2.0)
    assert (wheel.parent, wheel.child) == ("base_link", "wheel_left_link")
    assert (wheel.x, wheel.y, wheel.z) == (0.0, 0.08, 0.033)
    assert wheel.rotation == pytest.approx((0.0, 0.70710678, 0.0, 0.70710678))


def test_wheels_are_known_of_a_differential_base_with_sizes_only():
    assert [one.joint for one in description.wheels(BURGER)] == [
        "wheel_left_joint", "wheel_right_joint",
    ]  # fmt: skip
    assert description.wheels(replace(BURGER, wheel_radius=0.0)) == ()
    assert description.wheels(replace(BURGER, drive_type="mecanum")) == ()
    assert len(body.moving_frames(None, STATE)) == 1


def test_a_camera_that_is_called_like_a_part_of_the_body_has_a_frame_of_its_own():
    cameras = tuple(Camera(name=name) for name in ("base", "imu", "wheel_left"))
    body = samples.body(replace(BURGER, cameras=cameras))
    robot = xml.fromstring(description.urdf(body))
    links = [link.get("name") for link in robot.iter("link")]
    assert len(links) == len(set(links))
    assert "base_camera_link" in links
    assert [placed.parent for placed in frames.static_frames(body)][3::2] == ["base_link"] * 3


def test_a_urdf_has_the_hull_the_wheels_and_all_frames_of_tf():
    robot = xml.fromstring(description.urdf(samples.body(BURGER)))
    links = {link.get("name") for link in robot.findall("link")}
    assert links == {
        "base_footprint", "base_link", "imu_link", "base_scan", "front_link",
        "front_optical_frame", "wheel_left_link", "wheel_right_link",
    }  # fmt: skip
    joints = {joint.get("name"): joint for joint in robot.findall("joint")}
    parents = {one.find("child").get("link"): one.find("parent").get("link")
               for one in joints.values()}  # fmt: skip
    assert len(parents) == len(joints) == 7  # a tree
    assert set(links) - set(parents) == {"base_footprint"}
    left = joints["wheel_left_joint"]
    assert left.get("type") == "continuous"
    assert left.find("origin").get("xyz") == "0 0.08 0.033"
    assert left.find("axis").get("xyz") == "0 1 0"
    hull = robot.find("link[@name='base_link']/visual")
    assert hull.find("geometry/box").get("size") == "0.275 0.31 0.159"
    assert hull.find("origin").get("xyz") == "-0.0625 0 0.1125"
    lens = joints["front_optical_frame_joint"].find("origin")
    assert lens.get("rpy") == "-1.57079633 0 -1.57079633"


def test_a_round_footprint_is_a_cylinder():
    corners = tuple((0.2 * math.cos(a), 0.2 * math.sin(a)) for a in np.arange(12) * math.pi / 6)
    disc = replace(samples.WAFFLE, footprint=corners, drive_type="omni", body_height=0.3)
    robot = xml.fromstring(description.urdf(Body(description=disc, link="sim")))
    cylinder = robot.find("link[@name='base_link']/collision/geometry/cylinder")
    assert (cylinder.get("radius"), cylinder.get("length")) == ("0.2", "0.3")
    got = through_cdr("std_msgs/msg/String", description.robot_description(
        MAKE, Body(description=disc, link="sim")))  # fmt: skip
    assert got.data.startswith("<?xml")


def test_a_body_without_a_lidar_has_no_frame_of_one():
    bare = Body(description=replace(samples.WAFFLE, lidar=None), link="sim")
    children = [one.child for one in frames.static_frames(bare)]
    assert children == ["base_link", "imu_link"]


@pytest.mark.parametrize("yaw", [0.0, 1.0, -3.0, math.pi])
def test_a_heading_survives_the_quaternion(yaw):
    made = frames.pose(MAKE, Pose(x=0.0, y=0.0, yaw=yaw))
    assert math.remainder(frames.yaw_of(made.orientation) - yaw, math.tau) == pytest.approx(0.0)


@pytest.mark.parametrize("values", [(0, 0, 0, 0), (0, 0, 0, math.nan), (3, 0, 0, 1)])
def test_what_is_no_rotation_has_no_heading(values):
    assert frames.yaw_of(frames.quaternion(MAKE, values)) is None
