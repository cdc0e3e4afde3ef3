"""Scans, pictures and depth."""

from typing import Any

import numpy as np

from gigabrain_schemas.body import Body, Camera
from gigabrain_schemas.sensors import Image, LaserScan
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh.gateway.conversions.frames import Make, header, optical_frame

NO_INTENSITIES = np.empty(0, np.float32)
PLUMB_BOB, RATIONAL = 5, 8  # coefficients of ROS's two models
STRAIGHT = np.eye(3).ravel()
STRAIGHT.flags.writeable = False


def laser_scan(make: Make, scan: LaserScan, body: Body | None = None) -> Any:
    """Return sensor_msgs/LaserScan.

    REP-117: infinite is free as far as the sensor reaches, NaN is unknown. So infinite ranges of a
    lidar that cannot tell them apart become NaN.
    """
    ranges, lidar = scan.ranges_m, body.description.lidar if body else None
    if lidar and lidar.no_return == "unknown":
        ranges = np.where(np.isinf(ranges), np.float32(np.nan), ranges)
    return make(
        "sensor_msgs/msg/LaserScan",
        header=header(make, scan.stamp_ns, scan.frame_id),
        angle_min=scan.angle_min,
        angle_max=scan.angle_min + scan.angle_increment * (len(ranges) - 1),
        angle_increment=scan.angle_increment,
        time_increment=0.0,
        scan_time=1.0 / lidar.rate_hz if lidar else 0.0,
        range_min=scan.range_min,
        range_max=scan.range_max,
        ranges=ranges,
        intensities=NO_INTENSITIES,
    )


def compressed_image(make: Make, picture: Image, camera: str) -> Any:
    """Return sensor_msgs/CompressedImage of a JPEG. Raises ValueError for other pictures."""
    if picture.encoding != "jpeg":
        raise ValueError(
            f"pictures of {camera} are {picture.encoding}, not JPEG; "
            "set `encoding: jpeg` for it in the body's file"
        )
    return make(
        "sensor_msgs/msg/CompressedImage",
        header=header(make, picture.stamp_ns, optical_frame(camera)),
        format="jpeg",
        data=np.frombuffer(picture.data, np.uint8),
    )


def depth_image(make: Make, depth: DepthImage, camera: str) -> Any:
    """Return sensor_msgs/Image in millimetres; 0 is unknown (REP-118).

    Raises ValueError for depth that cannot be unpacked.
    """
    pixels = np.ascontiguousarray(depth.array(), "<u2")
    return make(
        "sensor_msgs/msg/Image",
        header=header(make, depth.stamp_ns, optical_frame(camera)),
        height=depth.height,
        width=depth.width,
        encoding="16UC1",
        is_bigendian=0,
        step=2 * depth.width,
        data=pixels.view(np.uint8).ravel(),
    )


def camera_info(make: Make, stamp_ns: int, camera: Camera) -> Any:
    """Return sensor_msgs/CameraInfo with the stamp of its picture, by which ROS joins the two."""
    fx, fy, cx, cy = camera.pinhole
    given = camera.distortion
    size = RATIONAL if len(given) > PLUMB_BOB else PLUMB_BOB
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=header(make, stamp_ns, optical_frame(camera.name)),
        height=camera.height,
        width=camera.width,
        distortion_model="rational_polynomial" if size == RATIONAL else "plumb_bob",
        d=np.array([*given, *[0.0] * (size - len(given))]),
        k=np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        r=STRAIGHT,
        p=np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
    )
