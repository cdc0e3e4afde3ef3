"""Messages of a sample body as the brain receives them: states, scans, its description."""

import math

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats, ranges_bytes
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import (
    Arm,
    Battery,
    Body,
    BodyDescription,
    Camera,
    GateStatus,
    Joint,
    JointDescription,
    Lidar,
    RobotState,
)
from gigabrain_schemas.sensors import LaserScan

BOOT = 7
TICK_NS = 20_000_000
LIDAR = Lidar(beams=360, rate_hz=10, range_min=0.12, range_max=3.5)
WAFFLE = BodyDescription(
    robot_type="waffle",
    drive_type="differential",
    footprint=((0.075, 0.155), (-0.200, 0.155), (-0.200, -0.155), (0.075, -0.155)),
    max_linear_speed=0.26,
    max_angular_speed=1.82,
    max_linear_acceleration=1.0,
    max_linear_deceleration=1.0,
    max_angular_acceleration=3.0,
    lidar=LIDAR,
)
ARMED = replace(
    WAFFLE,
    joints=(JointDescription(name="lift", lower=-1.0, upper=1.0, max_speed=1.0),),
    arm=Arm(home=(0.0,)),
)
WRIST = Camera(name="wrist", link="hand")  # for ARMED
DRIVING = GateStatus(mode="enabled", commander="control", enables=1)


def body(description: BodyDescription = WAFFLE, *, real: bool = False, boot: int = BOOT) -> Body:
    """Return the body as its driver announces it."""
    return Body(description=description, link="real" if real else "sim", boot=boot)


def state(
    tick: int = 1,
    *,
    v: float = 0.0,
    w: float = 0.0,
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gate: GateStatus = DRIVING,
    battery: float = 100.0,
    motor: float | None = 30.0,
    boot: int = BOOT,
) -> RobotState:
    """Return the state of the body in `tick`."""
    x, y, yaw = pose
    return RobotState(
        robot_type="waffle",
        pose=Pose(x=x, y=y, yaw=yaw),
        velocity=Velocity(linear_x=v, angular_z=w),
        joints=(Joint(name="left_wheel", position=0.0, temperature=motor),),
        battery=Battery(voltage=12.0, percentage=battery),
        gate=gate,
        boot=boot,
        tick=tick,
        basis=tick,
    )


def scan(
    values: NDArray[np.floating],
    tick: int = 1,
    *,
    angle_min: float = 0.0,
    angle_increment: float | None = None,
    boot: int = BOOT,
) -> LaserScan:
    """Return a scan with the ranges `values` [m], over a full turn unless angles are given."""
    return LaserScan(
        angle_min=angle_min,
        angle_increment=2 * math.pi / len(values) if angle_increment is None else angle_increment,
        range_min=0.12,
        range_max=3.5,
        ranges=ranges_bytes(values),
        boot=boot,
        tick=tick,
        basis=tick,
    )


def open_space(**hits_at_degrees: float) -> NDArray[np.float32]:
    """Return 360 ranges [m], one per degree: infinite, except those given as `deg_15=0.8`."""
    values = np.full(360, np.inf, "f4")
    for name, distance in hits_at_degrees.items():
        values[int(name.removeprefix("deg_"))] = distance
    return values


def round_room(radius: float, x: float, y: float, yaw: float) -> Floats:
    """Return 360 ranges d [m] from p = (x, y), yaw in a round room: |p + d u| = radius."""
    angles = yaw + np.radians(np.arange(360.0))
    along: Floats = x * np.cos(angles) + y * np.sin(angles)
    return np.sqrt(along**2 + radius**2 - x**2 - y**2) - along
