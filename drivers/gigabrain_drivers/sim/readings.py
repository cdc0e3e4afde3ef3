"""What a simulated body says of itself, as messages."""

import math

import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.sim.physics import Simulation
from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import Battery, Joint, Lidar, RobotState
from gigabrain_schemas.sensors import ImuData, LaserScan


def state_of(simulation: Simulation, robot_type: str) -> RobotState:
    """By the body's own sensors, as it is now."""
    odometry, charge, imu = simulation.odometry(), simulation.battery(), simulation.imu()
    return RobotState(
        robot_type=robot_type,
        pose=Pose(x=odometry.x, y=odometry.y, yaw=math.remainder(odometry.yaw, math.tau)),
        velocity=Velocity(**simulation.velocity()._asdict()),
        joints=tuple(Joint(**motor._asdict()) for motor in simulation.motors()),
        battery=Battery(
            voltage=charge.voltage, percentage=charge.percentage, current=charge.current
        ),
        imu=ImuData(
            orientation=imu.orientation,
            angular_velocity=imu.angular_velocity,
            linear_acceleration=imu.linear_acceleration,
        ),
        bumpers=(simulation.bumper(),),
    )


def scan_of(lidar: Lidar, ranges: NDArray[np.float32]) -> LaserScan:
    """One turn of `lidar` with these `ranges` (beams,) [m]."""
    return LaserScan(
        angle_min=0.0,
        angle_increment=math.tau / lidar.beams,
        range_min=lidar.range_min,
        range_max=lidar.range_max,
        ranges=ranges_bytes(ranges),
    )
