"""Converts ROS messages to ours (scans, IMU, battery, joints), and our commands to ROS. Pure.

All functions raise only Unusable.
"""

import math
from typing import Any

import numpy as np

from gigabrain_drivers.bodies.ros2.frames import Transform, rotation
from gigabrain_drivers.bodies.ros2.options import (
    TWIST_STAMPED,
    BatteryTopic,
    CommandTopic,
    JointsTopic,
    ScanTopic,
)
from gigabrain_drivers.lidars.base import bin_scan
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Battery, Joint, Lidar
from gigabrain_schemas.sensors import ImuData, LaserScan
from gigabrain_zenoh.ros2.types import Types

MAX_BEAMS = 20_000
MAX_JOINTS = 64
MAX_IMU_VALUE = 1000.0  # [m/s2] and [rad/s]; larger values are impossible
CHARGE_TOLERANCE = 0.1  # share of the full charge by which a gauge may exceed 0 % or 100 %
NANO = 1_000_000_000
NO_ORIENTATION = (0.0, 0.0, 0.0, 0.0)  # means that the tilt is unknown
ROUNDING_MARGIN = 1e-6  # added to a speed, so that truncation does not lose a step


class Unusable(Exception):
    """Raised for a message with impossible values; the text is the reason."""


def stamp_ns(stamp: Any) -> int:
    """Return a ROS time in nanoseconds."""
    return int(stamp.sec) * NANO + int(stamp.nanosec)


def yaw_of(orientation: Any) -> float:
    """Return the yaw of a quaternion [rad]. Raises Unusable."""
    turn = rotation(orientation.x, orientation.y, orientation.z, orientation.w)
    if turn is None:
        raise Unusable("its orientation is no quaternion of length 1")
    return math.atan2(turn[1, 0], turn[0, 0])


def scan_of(
    message: Any, options: ScanTopic, lidar: Lidar, place: Transform | None = None
) -> LaserScan:
    """Return the scan in the bins of `lidar`. Raises Unusable.

    `place` is the mounting of the message's sensor, from which each beam is transformed; None: the
    mounting of `lidar`.
    """
    ranges = np.asarray(message.ranges, np.float64)
    if not 1 <= len(ranges) <= MAX_BEAMS:
        raise Unusable(f"{len(ranges)} beams; expected 1 to {MAX_BEAMS}")
    step, start = float(message.angle_increment), float(message.angle_min)
    if not (math.isfinite(start) and math.isfinite(step)) or (step == 0.0 and len(ranges) > 1):
        raise Unusable(f"angle_min {start} and angle_increment {step}; expected numbers, not 0")
    angles = start + step * np.arange(len(ranges))
    angles = (-angles if options.clockwise else angles) + options.angle
    known = _distances(ranges, float(message.range_max), options)
    keep = ~np.isnan(known)
    angles, known = angles[keep], known[keep]
    if place is not None:
        angles, known = _in_mounting(angles, known, place, lidar)
    return bin_scan(lidar, angles, known)


def _distances(ranges: np.ndarray, range_max: float, options: ScanTopic) -> np.ndarray:
    """Return distances [m]: inf means no return, nan unknown."""
    found = ranges.copy()
    meanings = {"no_return": np.inf, "unknown": np.nan}
    found[np.isnan(ranges)] = meanings[options.nan]
    found[ranges == 0.0] = meanings[options.zero]
    found[np.isneginf(ranges)] = 0.0  # REP 117: too near to measure
    found[found < 0.0] = np.nan
    if range_max > 0.0:  # also false for NaN
        found[found > range_max] = np.inf
    return found


def _in_mounting(
    angles: np.ndarray, ranges: np.ndarray, place: Transform, lidar: Lidar
) -> tuple[np.ndarray, np.ndarray]:
    """Return the beams as the lidar would see them at its mounting in the robot's file."""
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1)
    directions = directions @ place.turn.T
    no_return = np.isinf(ranges)
    points = np.where(no_return, 0.0, ranges)[:, None] * directions
    points = points + place.shift - (lidar.x, lidar.y, 0.0)
    points[no_return] = directions[no_return]
    moved = np.arctan2(points[:, 1], points[:, 0]) - lidar.yaw
    return moved, np.where(no_return, np.inf, np.hypot(points[:, 0], points[:, 1]))


def has_orientation(message: Any) -> bool:
    """Return whether a sensor_msgs/Imu has an orientation; a covariance of -1 means none."""
    return bool(message.orientation_covariance[0] != -1.0)


def imu_of(message: Any, turn: np.ndarray | None = None) -> ImuData:
    """Return the measurement in the body's frame; `turn` (3, 3) is the IMU's rotation in it.

    The orientation is NO_ORIENTATION if the message has none. Raises Unusable.
    """
    rate, acceleration = message.angular_velocity, message.linear_acceleration
    rates = np.array([rate.x, rate.y, rate.z])
    accels = np.array([acceleration.x, acceleration.y, acceleration.z])
    if not (np.abs(np.concatenate([rates, accels])) < MAX_IMU_VALUE).all():
        raise Unusable("its rates or accelerations are no possible numbers")
    turn = np.eye(3) if turn is None else turn
    rates, accels = turn @ rates, turn @ accels
    orientation = NO_ORIENTATION
    if has_orientation(message):
        at = message.orientation
        matrix = rotation(at.x, at.y, at.z, at.w)
        if matrix is None:
            raise Unusable("its orientation is no quaternion of length 1")
        orientation = _quaternion(matrix @ turn.T)
    return ImuData(
        orientation=orientation,
        angular_velocity=(float(rates[0]), float(rates[1]), float(rates[2])),
        linear_acceleration=(float(accels[0]), float(accels[1]), float(accels[2])),
    )


def _quaternion(turn: np.ndarray) -> tuple[float, float, float, float]:
    """Return x, y, z, w of a rotation matrix, computed from its largest component."""
    (xx, _, _), (_, yy, _), (_, _, zz) = turn.tolist()
    squares = [1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz]
    largest = squares.index(max(squares))
    double = 2 * math.sqrt(squares[largest])
    crossed = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    if largest == 3:
        parts = [*(part / double for part in crossed), double / 4]
    else:
        parts = [float(turn[largest, i] + turn[i, largest]) / double for i in range(3)]
        parts[largest] = double / 4
        parts.append(crossed[largest] / double)
    x, y, z, w = map(float, parts)
    return x, y, z, w


def battery_of(message: Any, options: BatteryTopic) -> Battery:
    """Return the battery. Raises Unusable if its charge is unknown or impossible."""
    volts, share = float(message.voltage), float(message.percentage)
    if not math.isfinite(volts) or not math.isfinite(share):
        raise Unusable("it has no voltage or no percentage")
    if abs(share / options.full - 0.5) > 0.5 + CHARGE_TOLERANCE:
        percent = share > 0 and options.full == 1
        hint = ", or write battery: {full: 100}" if percent else ""
        raise Unusable(f"its percentage is {share:g}; expected 0 to {options.full}{hint}")
    current = float(message.current)
    return Battery(
        voltage=max(volts, 0.0),
        percentage=min(max(100.0 * share / options.full, 0.0), 100.0),
        current=-current if math.isfinite(current) else 0.0,  # negative in ROS while discharging
    )


def joints_of(message: Any, options: JointsTopic) -> tuple[Joint, ...]:
    """Return the joints. Raises Unusable."""
    names = list(message.name)
    if len(names) > MAX_JOINTS or len(message.position) != len(names):
        raise Unusable(
            f"{len(names)} names and {len(message.position)} positions; expected a position each, "
            f"of {MAX_JOINTS} joints at most"
        )
    speeds = list(message.velocity) or [0.0] * len(names)
    values = [*map(float, message.position), *map(float, speeds)]
    if len(speeds) != len(names) or not all(map(math.isfinite, values)):
        raise Unusable("its positions or velocities are no numbers")
    return tuple(
        Joint(
            name=options.names.get(name, name)[:64],
            position=float(position),
            velocity=float(speed) * options.velocity_factor,
        )
        for name, position, speed in zip(names, message.position, speeds, strict=True)
    )


def cut(velocity: Velocity, step: float) -> Velocity:
    """Return the velocity that a robot executes: truncated to multiples of `step`; 0: all."""
    if not step:
        return velocity
    parts = (velocity.linear_x, velocity.linear_y, velocity.angular_z)
    x, y, z = (
        math.copysign(math.floor(abs(part) / step + ROUNDING_MARGIN) * step, part) + 0.0
        for part in parts
    )
    return Velocity(linear_x=x, linear_y=y, angular_z=z)


def command_message(types: Types, to: Velocity, options: CommandTopic, unix_ns: int) -> Any:
    """Return the ROS message of a command, stamped with `unix_ns` if its type has a header."""
    margin = ROUNDING_MARGIN if options.step else 0.0
    x, y, z = (
        part + math.copysign(margin, part) if part else 0.0
        for part in (to.linear_x, to.linear_y, to.angular_z)
    )
    twist = {"linear": {"x": x, "y": y}, "angular": {"z": z}}
    if options.type != TWIST_STAMPED:
        return types.make(options.type, **twist)
    stamp = {"sec": unix_ns // NANO, "nanosec": unix_ns % NANO}
    return types.make(options.type, header={"stamp": stamp, "frame_id": options.frame}, twist=twist)
