"""Scans, pictures, depth, maps, paths and poses as ROS reads them."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import Camera
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.tasks import Goal, TaskStatus
from gigabrain_schemas.vision import DepthImage, pack_depth
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gateway.conversions import maps, sensors
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.testing import samples

TYPES = Types()
MAKE = TYPES.make
STAMP = 1_795_580_000_500_000_000
SCAN = replace(
    samples.scan(np.array([0.5, np.inf, np.nan, 3.4], "f4"), angle_min=-1.0, angle_increment=0.5),
    stamp_ns=STAMP,
)


def through_cdr(name, message):
    return TYPES.decode(name, TYPES.encode(name, message))


def scan_of(body):
    return TYPES.decode("sensor_msgs/msg/LaserScan", sensors.laser_scan(SCAN, body))


def test_a_scan_keeps_angles_limits_and_what_was_not_hit():
    got = scan_of(samples.body())
    assert got.header.frame_id == "base_scan"
    assert (got.header.stamp.sec, got.header.stamp.nanosec) == (1_795_580_000, 500_000_000)
    assert (got.angle_min, got.angle_max, got.angle_increment) == (-1.0, 0.5, 0.5)
    assert (got.range_min, got.range_max) == pytest.approx((0.12, 3.5))
    assert (got.scan_time, got.time_increment) == (pytest.approx(0.1), 0.0)
    assert got.ranges[:2].tolist() == [0.5, math.inf]
    assert math.isnan(got.ranges[2])
    assert len(got.intensities) == 0


def test_infinite_ranges_of_a_lidar_that_cannot_tell_are_unknown():
    lidar = replace(samples.LIDAR, no_return="unknown")
    body = samples.body(replace(samples.WAFFLE, lidar=lidar))
    got = scan_of(body)
    assert np.isnan(got.ranges).tolist() == [False, True, True, False]
    assert got.ranges.dtype == np.float32


def test_a_scan_of_a_body_that_is_not_known_yet_has_no_scan_time():
    assert scan_of(None).scan_time == 0.0


@pytest.mark.parametrize("frame", ["lid", "scan", "base_scan", "front_scanner"])
@pytest.mark.parametrize("beams", [1, 4, 360])
def test_a_scan_packed_by_hand_is_what_the_library_writes(frame, beams):
    ranges = np.linspace(0.2, 3.0, beams, dtype="f4")
    scan = replace(samples.scan(ranges), frame_id=frame, stamp_ns=STAMP)
    payload = sensors.laser_scan(scan, samples.body())
    got = TYPES.decode("sensor_msgs/msg/LaserScan", payload)
    assert (got.header.frame_id, got.ranges.tolist()) == (frame, ranges.tolist())
    assert TYPES.encode("sensor_msgs/msg/LaserScan", got) == payload


@pytest.mark.parametrize("stamp_ns", [2**31 * 10**9, 2**63 - 1])
def test_a_stamp_that_ros_cannot_hold_is_refused(stamp_ns):
    with pytest.raises(ValueError, match=f"its stamp is {stamp_ns} ns; ROS ends"):
        sensors.laser_scan(replace(SCAN, stamp_ns=stamp_ns))
    status = TaskStatus(path=((0.0, 0.0),), stamp_ns=stamp_ns)
    with pytest.raises(ValueError, match=f"its stamp is {stamp_ns} ns; ROS ends"):
        maps.plan(MAKE, status)


def test_a_jpeg_goes_unchanged_and_a_raw_picture_not_at_all():
    jpeg = Image(frame_id="front", encoding="jpeg", height=2, width=2, data=b"\xff\xd8\x01",
                 stamp_ns=STAMP)  # fmt: skip
    made = sensors.compressed_image(MAKE, jpeg, "front")
    got = through_cdr("sensor_msgs/msg/CompressedImage", made)
    assert (got.header.frame_id, got.format) == ("front_optical_frame", "jpeg")
    assert got.data.tobytes() == b"\xff\xd8\x01"
    raw = Image(frame_id="front", encoding="mono8", height=1, width=2, data=b"ab")
    with pytest.raises(ValueError, match="mono8, not JPEG"):
        sensors.compressed_image(MAKE, raw, "front")


def test_depth_is_16_bit_millimetres_by_row():
    pixels = np.arange(16 * 16, dtype=np.uint16).reshape(16, 16) * 10
    depth = DepthImage(frame_id="front", height=16, width=16, planes=pack_depth(pixels))
    got = through_cdr("sensor_msgs/msg/Image", sensors.depth_image(MAKE, depth, "front"))
    assert (got.encoding, got.is_bigendian, got.step) == ("16UC1", 0, 32)
    assert (got.height, got.width, len(got.data)) == (16, 16, 512)
    assert got.data[:6].tolist() == [0, 0, 10, 0, 20, 0]
    assert got.data[32:34].tolist() == [160, 0]
    broken = replace(depth, planes=(b"no", *depth.planes[1:]))
    with pytest.raises(ValueError, match="cannot be unpacked"):
        sensors.depth_image(MAKE, broken, "front")


@pytest.mark.parametrize(
    ("distortion", "model", "d"),
    [
        ((), "plumb_bob", [0, 0, 0, 0, 0]),
        ((0.1, -0.2), "plumb_bob", [0.1, -0.2, 0, 0, 0]),
        ((0.1, 0, 0, 0, 0, 0.3), "rational_polynomial", [0.1, 0, 0, 0, 0, 0.3, 0, 0]),
    ],
)
def test_camera_info_has_k_d_r_and_p(distortion, model, d):
    camera = Camera(name="front", intrinsics=(277.0, 278.0, 159.5, 119.5), distortion=distortion)
    got = through_cdr("sensor_msgs/msg/CameraInfo", sensors.camera_info(MAKE, STAMP, camera))
    assert (got.header.frame_id, got.header.stamp.nanosec) == ("front_optical_frame", 500_000_000)
    assert (got.width, got.height, got.distortion_model) == (320, 240, model)
    assert got.d.tolist() == d
    assert got.k.tolist() == [277.0, 0.0, 159.5, 0.0, 278.0, 119.5, 0.0, 0.0, 1.0]
    assert got.r.tolist() == [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    assert got.p.tolist() == [277.0, 0, 159.5, 0, 0, 278.0, 119.5, 0, 0, 0, 1.0, 0]


def test_a_map_keeps_rows_origin_and_unknown_cells():
    cells = np.array([[0, 100, -1], [50, 7, -1]], np.int8)
    grid = OccupancyGrid(resolution=0.05, width=3, height=2, origin_x=-1.0, origin_y=2.0,
                         cells=cells.tobytes(), stamp_ns=STAMP)  # fmt: skip
    got = through_cdr("nav_msgs/msg/OccupancyGrid", maps.occupancy_grid(MAKE, grid))
    assert got.header.frame_id == "map"
    assert (got.info.width, got.info.height) == (3, 2)
    assert got.info.resolution == pytest.approx(0.05)
    assert (got.info.origin.position.x, got.info.origin.position.y) == (-1.0, 2.0)
    assert got.info.origin.orientation.w == 1.0
    assert got.data.tolist() == [0, 100, -1, 50, 7, -1]


def test_a_path_heads_along_itself_and_ends_with_the_goal_heading():
    status = TaskStatus(path=((0.0, 0.0), (1.0, 0.0), (1.0, 2.0)), goal=Goal(x=1.0, y=2.0, yaw=0.0))
    got = through_cdr("nav_msgs/msg/Path", maps.plan(MAKE, status))
    assert [(p.pose.position.x, p.pose.position.y) for p in got.poses] == [(0, 0), (1, 0), (1, 2)]
    assert [p.pose.orientation.z for p in got.poses] == pytest.approx([0.0, 0.70710678, 0.0])
    assert {p.header.frame_id for p in got.poses} == {"map"}
    free = maps.plan(MAKE, replace(status, goal=Goal(x=1.0, y=2.0)))
    assert free.poses[-1].pose.orientation.z == pytest.approx(0.70710678)
    assert maps.plan(MAKE, TaskStatus()).poses == []


def ros_pose(x=1.0, y=2.0, z=0.0, w=1.0):
    return MAKE("geometry_msgs/msg/Pose", position={"x": x, "y": y},
                orientation={"z": z, "w": w})  # fmt: skip


def test_poses_of_ros_are_read_in_map_and_odom():
    at = maps.planar(ros_pose(z=0.70710678, w=0.70710678))
    assert (at.x, at.y, at.yaw) == (1.0, 2.0, pytest.approx(math.pi / 2))
    assert maps.in_map("map", at, None) == at
    found = maps.in_map("odom", at, Pose(x=10.0, y=0.0, yaw=math.pi / 2))
    assert (found.x, found.y) == pytest.approx((8.0, 1.0))
    assert abs(found.yaw) == pytest.approx(math.pi)


@pytest.mark.parametrize(
    ("ros", "frame", "text"),
    [
        (ros_pose(x=math.nan), "map", "position"),
        (ros_pose(y=math.inf), "map", "position"),
        (ros_pose(w=0.0), "map", "quaternion"),
        (ros_pose(), "base_link", "frame 'base_link'"),
        (ros_pose(), "", "frame ''"),
        (ros_pose(), "odom", "a goal in odom needs a localized robot"),
    ],
)
def test_poses_that_cannot_be_goals_are_refused_with_the_reason(ros, frame, text):
    with pytest.raises(Refused, match=text):
        maps.in_map(frame, maps.planar(ros), None)


def test_a_covariance_keeps_x_y_and_yaw():
    full = np.zeros((6, 6))
    full[0, 0], full[1, 1], full[5, 5] = 0.25, 0.36, 0.07
    full[0, 5] = full[5, 0] = 0.01
    full[2, 2] = 9.0
    assert maps.planar_covariance(full.ravel()) == (0.25, 0, 0.01, 0, 0.36, 0, 0.01, 0, 0.07)
    assert maps.planar_covariance(np.zeros(36)) == ()


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf, 1e308])
def test_what_is_no_covariance_is_refused(value):
    full = np.zeros(36)
    full[0] = value
    for values in (full, np.full(36, value)):
        with pytest.raises(Refused, match="covariance"):
            maps.planar_covariance(values)
