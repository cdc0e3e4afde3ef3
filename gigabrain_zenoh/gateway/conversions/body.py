"""Conversions of the body's own measurements: odometry, joints, battery, attitude."""

import math
from typing import Any

import numpy as np

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Battery, Body, RobotState
from gigabrain_schemas.sensors import Imu, ImuData
from gigabrain_zenoh.gateway.conversions.description import wheels
from gigabrain_zenoh.gateway.conversions.frames import (
    BASE,
    FOOTPRINT,
    IMU_LINK,
    ODOM,
    Make,
    Placed,
    header,
    on_floor,
    pose,
    quaternion,
    time,
    vector,
)

UNKNOWN_3, UNKNOWN_6 = np.zeros(9), np.zeros(36)  # covariances; ROS: all zero is "unknown"
NO_ORIENTATION = np.array([-1.0] + [0.0] * 8)  # by sensor_msgs/Imu
for _each in (UNKNOWN_3, UNKNOWN_6, NO_ORIENTATION):
    _each.flags.writeable = False
NO_FLOATS, NO_FLOATS32 = np.empty(0), np.empty(0, np.float32)
STATUS_UNKNOWN, CHARGING, DISCHARGING = 0, 1, 2  # of sensor_msgs/BatteryState


def twist(make: Make, velocity: Velocity) -> Any:
    """Return geometry_msgs/Twist of a velocity on the floor."""
    return make(
        "geometry_msgs/msg/Twist",
        linear=vector(make, velocity.linear_x, velocity.linear_y, 0.0),
        angular=vector(make, 0.0, 0.0, velocity.angular_z),
    )


def odometry(make: Make, state: RobotState) -> Any:
    """Return nav_msgs/Odometry with unknown covariances."""
    return make(
        "nav_msgs/msg/Odometry",
        header=header(make, state.stamp_ns, ODOM),
        child_frame_id=FOOTPRINT,
        pose=make(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=pose(make, state.pose),
            covariance=UNKNOWN_6,
        ),
        twist=make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=twist(make, state.velocity),
            covariance=UNKNOWN_6,
        ),
    )


def moving_frames(body: Body | None, state: RobotState) -> list[Placed]:
    """Return the base's frame in the odometry, and those of known wheels on the base."""
    frames = [on_floor(ODOM, FOOTPRINT, state.pose)]
    if body:
        angles = {joint.name: joint.position for joint in state.joints}
        for wheel in wheels(body.description):
            angle = angles.get(wheel.joint)
            if angle is not None:
                rotation = 0.0, math.sin(angle / 2), 0.0, math.cos(angle / 2)
                frames.append(Placed(BASE, wheel.link, 0.0, wheel.y, wheel.radius, rotation))
    return frames


def joint_states(make: Make, state: RobotState) -> Any | None:
    """Return sensor_msgs/JointState; None without joints. NaN: effort not measured."""
    joints = state.joints
    if not joints:
        return None
    efforts = [math.nan if joint.effort is None else joint.effort for joint in joints]
    measured = any(joint.effort is not None for joint in joints)
    return make(
        "sensor_msgs/msg/JointState",
        header=header(make, state.stamp_ns, ""),
        name=[joint.name for joint in joints],
        position=np.array([joint.position for joint in joints]),
        velocity=np.array([joint.velocity for joint in joints]),
        effort=np.array(efforts) if measured else NO_FLOATS,
    )


def battery_state(make: Make, state: RobotState) -> Any | None:
    """Return sensor_msgs/BatteryState; None for a body without a battery."""
    battery = state.battery
    if battery is None:
        return None
    return make(
        "sensor_msgs/msg/BatteryState",
        header=header(make, state.stamp_ns, ""),
        voltage=battery.voltage,
        temperature=math.nan,
        current=-battery.current if battery.current else math.nan,  # in ROS it falls below 0
        charge=math.nan,
        capacity=math.nan,
        design_capacity=math.nan,
        percentage=battery.percentage / 100.0,
        power_supply_status=_supply(battery),
        present=True,
        cell_voltage=NO_FLOATS32,
        cell_temperature=NO_FLOATS32,
    )


def _supply(battery: Battery) -> int:
    if battery.current == 0.0:  # the default: not measured
        return STATUS_UNKNOWN
    return DISCHARGING if battery.current > 0 else CHARGING


def imu(make: Make, reading: Imu) -> Any:
    """Return sensor_msgs/Imu of a reading."""
    return _imu(make, reading.stamp_ns, reading)


def imu_of_state(make: Make, state: RobotState) -> Any | None:
    """Return sensor_msgs/Imu from a state; None for a state without one."""
    return _imu(make, state.stamp_ns, state.imu) if state.imu else None


def _imu(make: Make, at_ns: int, reading: Imu | ImuData) -> Any:
    return make(
        "sensor_msgs/msg/Imu",
        header=header(make, at_ns, IMU_LINK),
        orientation=quaternion(make, reading.orientation),
        orientation_covariance=UNKNOWN_3 if any(reading.orientation) else NO_ORIENTATION,
        angular_velocity=vector(make, *reading.angular_velocity),
        angular_velocity_covariance=UNKNOWN_3,
        linear_acceleration=vector(make, *reading.linear_acceleration),
        linear_acceleration_covariance=UNKNOWN_3,
    )


def clock(make: Make, state: RobotState) -> Any:
    """Return rosgraph_msgs/Clock, the time of a simulation's stamps."""
    return make("rosgraph_msgs/msg/Clock", clock=time(make, state.stamp_ns))
