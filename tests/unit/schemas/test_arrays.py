import base64
import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from gigabrain_schemas import arrays
from gigabrain_schemas.body import Thresholds
from gigabrain_schemas.brain import (
    JointCommand,
    JointSpeeds,
    JointTrajectory,
    Obstacle,
    OccupancyGrid,
    TrajectoryPoint,
    WorldModel,
)
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.sensors import Image, LaserScan


def grid(width: int, height: int, cells: bytes) -> OccupancyGrid:
    return OccupancyGrid(
        resolution=0.05, width=width, height=height, origin_x=0.0, origin_y=0.0, cells=cells
    )


def scan(ranges: bytes, **change: float) -> LaserScan:
    geometry = {"angle_min": 0.0, "angle_increment": 0.1, "range_min": 0.1, "range_max": 3.5}
    return LaserScan(**(geometry | change), ranges=ranges)  # type: ignore[arg-type]


def image(encoding: Any, height: int, width: int, data: bytes) -> Image:
    return Image(frame_id="camera", encoding=encoding, height=height, width=width, data=data)


def trajectory(name: tuple[str, ...], positions: bytes) -> JointTrajectory:
    return JointTrajectory(name=name, start=1, period=0.02, positions=positions)


@pytest.mark.parametrize(
    ("build", "complaint"),
    [
        (lambda: scan(b"12345"), "float32"),
        (lambda: scan(b""), "float32"),
        (lambda: scan(bytes(4), angle_increment=0.0), "angle_increment"),
        (lambda: scan(bytes(4), range_max=0.1), "range_max"),
        (lambda: grid(3, 2, bytes(5)), "3 x 2 cells but 5 bytes"),
        (lambda: grid(2, 1, bytes((0, 101))), "0 to 100, or -1"),
        (lambda: grid(2, 1, bytes((0, 254))), "0 to 100, or -1"),
        (lambda: image("depth16", 2, 3, bytes(11)), "needs 12 bytes, got 11"),
        (lambda: image("rgb8", 2, 3, bytes(6)), "needs 18 bytes, got 6"),
        (lambda: image("jpeg", 2, 3, b""), "at least one pixel"),
        (lambda: image("mono8", 0, 0, b""), "at least one pixel"),
        (lambda: Obstacle(id=1, x=0.0, y=0.0, radius=0.1, covariance=(0.0,) * 9), "16 values"),
        (lambda: JointCommand(name=("a", "b"), position=(0.0,)), "2 names"),
        (lambda: JointCommand(name=("a", "b"), position=(0.0,) * 2, velocity=(0.0,)), "2 names"),
        (lambda: JointCommand(name=("a", "a"), position=(0.0, 1.0)), "at most once"),
        (lambda: JointCommand(name=("a",)), "1 names"),
        (lambda: JointSpeeds(name=("a", "b"), velocity=(0.0,)), "2 names and 1 velocities"),
        (lambda: JointSpeeds(name=("a", "a"), velocity=(0.0, 1.0)), "at most once"),
        (lambda: trajectory(("a",), b""), "rows of 1 float32"),
        (lambda: trajectory(("a", "b"), bytes(12)), "rows of 2 float32"),
        (lambda: trajectory(("a",), bytes(4 * 152)), "may last 3 s"),
        (lambda: trajectory(("a", "a"), bytes(8)), "at most once"),
        (lambda: trajectory(("a",), b"\0\0\xc0\x7f"), "finite"),
        (
            lambda: Thresholds(battery_warn=4.0),
            "battery_stop, battery_return and battery_warn must ascend",
        ),
        (lambda: Thresholds(motor_warn=71.0), "motor_stop must not be below motor_warn"),
    ],
)
def test_contradicting_lengths_and_limits_are_refused(
    build: Callable[[], Any], complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        build()


def test_a_scan_may_contain_inf_and_nan_and_is_read_without_a_copy() -> None:
    message = EXAMPLES["LaserScan"]
    assert isinstance(message, LaserScan)
    view = message.ranges_m
    assert not view.flags.writeable
    assert not view.flags.owndata
    expected = [0.83, 1.25, 3.49, math.inf, math.inf, math.nan, 2.5, 0.9]
    np.testing.assert_array_equal(view, np.array(expected, "<f4"))
    assert arrays.ranges_bytes(view.astype(np.float64)) == message.ranges


def test_a_map_and_a_picture_are_read_row_by_row() -> None:
    cells = grid(4, 2, bytes((0, 0, 100, 255, 0, 37, 100, 255))).array()
    assert cells.tolist() == [[0, 0, 100, -1], [0, 37, 100, -1]]
    depth = image("depth16", 1, 2, b"\x01\x00\x00\x01").array()
    assert depth.tolist() == [[1, 256]]
    colours = image("rgb8", 1, 2, bytes(range(6))).array()
    assert colours.tolist() == [[[0, 1, 2], [3, 4, 5]]]
    with pytest.raises(ValueError, match="decoded first"):
        image("jpeg", 1, 2, b"\xff\xd8").array()


def test_json_carries_arrays_in_base64() -> None:
    plain = msgspec.json.decode(msgspec.json.encode(scan(bytes(4))))
    assert base64.b64decode(plain["ranges"]) == b"\0\0\0\0"


def test_a_trajectory_point_is_a_short_array_on_the_wire() -> None:
    point = TrajectoryPoint(t=0.5, x=1.0, y=0.0, yaw=0.0, linear_x=0.25)
    assert msgspec.json.encode(point) == b"[0.5,1.0,0.0,0.0,0.25,0.0,0.0]"
    assert msgspec.json.decode(b"[0.5,1.0,0.0,0.0]", type=TrajectoryPoint).linear_x == 0.0


def test_hits_are_encoded_as_pairs() -> None:
    x, y = np.array([0.5, -1.25]), np.array([2.0, 0.25])
    world = WorldModel(scan_ok=True, obstacle_ahead=False, hits=arrays.hits_bytes(x, y))
    assert world.points().tolist() == [[0.5, 2.0], [-1.25, 0.25]]
    with pytest.raises(ValueError, match="pairs of float32"):
        WorldModel(scan_ok=True, obstacle_ahead=False, hits=bytes(4))


def test_hits_beyond_the_limit_or_not_finite_are_left_out() -> None:
    x, y = np.array([0.5, np.nan, np.inf, 1e30, 2.0]), np.array([1.0, 0.0, 0.0, 0.0, np.nan])
    world = WorldModel(scan_ok=True, obstacle_ahead=False, hits=arrays.hits_bytes(x, y))
    assert world.points().tolist() == [[0.5, 1.0]]


def test_a_scan_returns_its_hits_in_the_sensors_frame() -> None:
    values = np.array((1.0, np.inf, np.nan, 0.05, 2.0))
    one = scan(arrays.ranges_bytes(values), angle_increment=math.pi / 2)
    assert one.angles.tolist() == pytest.approx([0, math.pi / 2, math.pi, 1.5 * math.pi, math.tau])
    assert one.points().round(6).tolist() == [[1.0, 0.0], [2.0, 0.0]]
