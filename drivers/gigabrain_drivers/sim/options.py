"""The simulator's part of a robot's file, and the body that comes of it."""

from dataclasses import replace
from typing import Annotated

from msgspec import Meta

from gigabrain_drivers.driver.robot import LinkOptions, RobotFile, Run
from gigabrain_drivers.sim.body import (
    LEG_BATTERY,
    SimBattery,
    SimBody,
    SimLidar,
    SimModel,
    SimQuadruped,
)
from gigabrain_schemas.base import NonNegative, Percentage, Positive
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import read_bounded

SIMULATED = ("differential", "quadruped")  # drive types
MOST_MODEL_BYTES = 10_000_000


class MujocoOptions(LinkOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The simulator's part of a robot's file."""

    model: str = "model.xml"  # MJCF, beside the robot's file
    battery_capacity: Positive = 1.8  # [Ah]
    battery_percentage: Percentage = 100.0  # [%], at the start
    lidar_noise: NonNegative = 0.01  # [m], standard deviation
    wheel_scale: Annotated[float, Meta(ge=0.5, le=2.0)] = 1.0  # true wheel radius / wheel_radius
    odometry_wheel_radius: Positive | None = None  # [m], where odometry is calibrated by itself


def sim_body(robot: RobotFile, options: MujocoOptions, run: Run) -> SimModel:
    """The body as the simulation wants it. Raises ConfigError when there is no model."""
    path = run.folder / options.model
    try:
        model = read_bounded(path, MOST_MODEL_BYTES).decode()
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: expected UTF-8 text") from None
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}; the robot's MJCF model belongs there, "
            "its own or that of a body like it; `model` names it"
        ) from None
    lidar = _sim_lidar(robot, options)
    if robot.drive_type not in SIMULATED:
        raise ConfigError(
            f"{robot.robot_type}: drive_type {robot.drive_type!r} cannot be simulated in MuJoCo; "
            f"{' and '.join(SIMULATED)} can; a skid-steered base is differential"
        )
    if robot.drive_type == "quadruped":
        battery = replace(
            LEG_BATTERY,
            capacity_ah=options.battery_capacity,
            percentage=options.battery_percentage,
        )
        return SimQuadruped(model=model, path=str(path), lidar=lidar, battery=battery)
    return SimBody(
        model=model,
        path=str(path),
        wheel_radius=robot.wheel_radius,
        wheel_separation=robot.wheel_separation,
        odometry_wheel_radius=options.odometry_wheel_radius,
        wheel_scale=options.wheel_scale,
        lidar=lidar,
        battery=SimBattery(
            capacity_ah=options.battery_capacity, percentage=options.battery_percentage
        ),
    )


def _sim_lidar(robot: RobotFile, options: MujocoOptions) -> SimLidar | None:
    lidar = robot.lidar
    if lidar is None:
        return None
    return SimLidar(
        beams=lidar.beams,
        rate_hz=lidar.rate_hz,
        range_min=lidar.range_min,
        range_max=lidar.range_max,
        noise_m=options.lidar_noise,
    )
