"""Simulated bodies: a MuJoCo model and its parameters, from a robot's file."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from gigabrain_drivers.driver.robot import LinkOptions, RobotFile, Run
from gigabrain_drivers.kinematics.legs import JOINT_NAMES, LEGS, WALKER, LegGeometry, Walker
from gigabrain_drivers.kinematics.wheels import (
    Ackermann,
    AckermannAxles,
    Base,
    Differential,
    Mecanum,
    Omni,
    SkidSteer,
    Twist,
    missing_measures,
    wheels_of,
)
from gigabrain_schemas.base import NonNegative, Percentage, Positive
from gigabrain_schemas.body import JointDescription
from gigabrain_zenoh.errors import ConfigError, unknown
from gigabrain_zenoh.host.files import file_problem, read_bounded

WHEELS = {  # the driven parts of a model, by drive type
    "differential": ("wheel_left", "wheel_right"),
    "skid_steer": tuple(f"wheel_{name}" for name in SkidSteer.wheels),
    "mecanum": tuple(f"wheel_{name}" for name in Mecanum.wheels),
    "omni": tuple(f"wheel_{name}" for name in Omni.wheels),
    "ackermann": ("wheel_rear_left", "wheel_rear_right", "steer_left", "steer_right"),
}
ROLLERS = ("mecanum", "omni")  # drive types whose wheels have rollers
SPARE_WHEEL_SPEED = 1.25  # factor on the wheel speed at the body's largest speeds together
MAX_MODEL_BYTES = 10_000_000
ARM_SUBSTEPS = 5  # of 2 ms: fingers must not let go of what they hold


@dataclass(frozen=True, kw_only=True)
class SimLidar:
    """A planar lidar at the model's site `lidar`; the first beam looks along the site's x axis."""

    beams: int = 360
    rate_hz: float = 10.0
    range_min: float = 0.12  # [m]
    range_max: float = 3.5  # [m]
    noise_m: float = 0.01  # standard deviation of a range
    mount: tuple[float, float, float] | None = None  # x, y [m], yaw [rad], from the robot's file
    height: float | None = None  # [m] above the floor, for a model without the site


@dataclass(frozen=True, kw_only=True)
class SimBattery:
    """A battery; the defaults are TurtleBot3's three lithium cells."""

    capacity_ah: float = 1.8
    full_voltage: float = 12.6
    nominal_voltage: float = 11.1  # at half charge
    empty_voltage: float = 9.9
    internal_resistance_ohm: float = 0.1
    idle_current_a: float = 0.6  # computer, lidar and board
    drive_current_a: float = 0.8  # additional, with all wheels at full speed without load
    percentage: float = 100.0  # at the start, 0-100


class SimMotor(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A wheel's gear motor, measured at the wheel; default: a Dynamixel XL430-W250."""

    torque_per_ampere: Positive = 1.07  # [N m/A], stall: 1.5 N m at 1.4 A
    resistance_ohm: Positive = 8.6  # 12 V at 1.4 A
    heat_capacity: Positive = 50.0  # [J/K]
    thermal_resistance: Positive = 12.0  # [K/W], to the air
    ambient_celsius: float = 25.0


class SimServo(SimMotor, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A joint's servo; default: a Feetech STS3215 of 7.4 V."""

    torque_per_ampere: Positive = 0.8  # [N m/A] or [N/A], stall: 1.9 N m at 2.4 A
    resistance_ohm: Positive = 3.1
    heat_capacity: Positive = 30.0  # [J/K]
    encoder_ticks: Annotated[int, Meta(ge=1)] = 4096  # per turn
    smoothing: NonNegative = 0.0  # [s], time constant of its motion to a new goal
    backlash: NonNegative = 0.0  # [rad] or [m], free play of the gears


class JointServos(SimServo, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Equal servos of some joints."""

    joints: tuple[str, ...]


class PartNames(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The names of a moving part in a model. Empty ones are found through its joint."""

    joint: str
    actuator: str = ""
    geom: str = ""  # that touches the floor, of a wheel


@dataclass(frozen=True, kw_only=True)
class SimModel:
    """Parameters of any body. Its model's base body is `base`, with the free joint `free`.

    Geoms of the base with names `hull_...` form the body's outline.
    """

    model: str  # MJCF
    path: str = "the model"  # of its file, for messages
    named_by: str = ""  # the model's name in the robot's file
    names: Mapping[str, str | PartNames] = field(default_factory=dict)  # of parts in the model
    footprint: tuple[tuple[float, float], ...] = ()  # [m], from the robot's file
    lidar: SimLidar | None = field(default_factory=SimLidar)
    battery: SimBattery = field(default_factory=SimBattery)
    motor: SimMotor = field(default_factory=SimMotor)
    substeps: int = 2  # per step of 10 ms; for wheels, 5 ms are as good as 1 ms
    joints: tuple[JointDescription, ...] = ()  # of its arm; each has a position servo
    posture: tuple[float, ...] = ()  # of the arm at the start [rad] or [m]
    servos: Mapping[str, SimServo] = field(default_factory=dict)  # by joint; default: SimServo()
    fixed: bool = False  # the base is screwed to the floor

    def parts(self) -> tuple[tuple[str, str], ...]:
        """(kind, name) of required parts of the model besides base, sensors and lidar."""
        return tuple(
            part for one in self.joints for part in (("joint", one.name), ("actuator", one.name))
        )


@dataclass(frozen=True, kw_only=True)
class SimBody(SimModel):
    """A simulated body on wheels.

    The base's origin is that of its kinematics. Each name in `wheels` is a body and an actuator,
    with `_joint` appended a joint, and for a wheel also a geom. `wheel_radius` and
    `wheel_separation` are those of the base's own kinematics; the true ones are in the model.
    """

    wheel_radius: float  # [m], turns commands into wheel speeds
    wheel_separation: float  # [m]
    wheel_base: float = 0.0  # [m], from the robot's file
    base: Base | None = None  # None: differential
    odometry_wheel_radius: float | None = None  # [m], turns encoder ticks into metres
    wheel_scale: float = 1.0  # true wheel radius / radius in the model: worn or swollen tyres
    max_wheel_speed: float = 9.0  # [rad/s]
    needed_wheel_speed: float = 0.0  # [rad/s], at the largest of its speeds, one at a time
    max_wheel_acceleration: float = 60.0  # [rad/s2]
    wheels: tuple[str, ...] = WHEELS["differential"]
    gyro_heading: bool = False  # odometry takes its heading from the gyroscope: wheels scrub
    encoder_ticks: int = 4096  # per turn

    @property
    def kinematics(self) -> Base:
        """The base's own kinematics."""
        return self.base or Differential(self.wheel_radius, self.wheel_separation)

    @property
    def rolling(self) -> tuple[str, ...]:
        """The names in `wheels` of parts that roll, not steer."""
        return tuple(name for name in self.wheels if name.startswith("wheel"))

    def parts(self) -> tuple[tuple[str, str], ...]:
        """(kind, name) of wheels and steering."""
        wheels = tuple(
            part
            for name in self.wheels
            for part in (
                ("body", name),
                *((("geom", name),) if name in self.rolling else ()),
                ("joint", f"{name}_joint"),
                ("actuator", name),
            )
        )
        return (*wheels, *super().parts())


LEG_BATTERY = SimBattery(
    capacity_ah=8.0,
    full_voltage=29.4,  # seven lithium cells
    nominal_voltage=25.2,
    empty_voltage=21.0,
    internal_resistance_ohm=0.05,
    idle_current_a=1.2,
    drive_current_a=0.0,  # legs draw current by the torque that bears the weight
)
LEG_MOTOR = SimMotor(
    torque_per_ampere=1.4,
    resistance_ohm=0.25,
    heat_capacity=180.0,
    thermal_resistance=2.5,
)


@dataclass(frozen=True, kw_only=True)
class SimQuadruped(SimModel):
    """A simulated body on four legs of three joints.

    The base's origin lies on the hips' axes. Each name in JOINT_NAMES is a joint and its position
    servo; each leg has a touch sensor `..._contact` on its foot.
    """

    substeps: int = 3  # feet that hit the ground need finer steps than wheels
    geometry: LegGeometry = field(default_factory=LegGeometry)
    walker: Walker = WALKER  # turns velocities into gaits
    encoder_ticks: int = 65536  # per turn of a joint
    contact_n: float = 8.0  # [N], minimal force of a foot that bears weight
    battery: SimBattery = LEG_BATTERY
    motor: SimMotor = LEG_MOTOR

    def parts(self) -> tuple[tuple[str, str], ...]:
        """(kind, name) of legs."""
        joints = [part for name in JOINT_NAMES for part in (("joint", name), ("actuator", name))]
        return (*joints, *(("sensor", f"{leg}_contact") for leg in LEGS))


class MujocoOptions(LinkOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The simulator's fields in a robot's file."""

    model: str = "model.xml"  # MJCF, beside the robot's file
    names: Mapping[str, str | PartNames] = msgspec.field(
        default_factory=dict
    )  # of parts that have other names in the model
    lidar_height: Positive | None = None  # [m] above the floor, for a model without a lidar's site
    battery_capacity: Positive = 1.8  # [Ah]
    battery_percentage: Percentage = 100.0  # [%], at the start
    lidar_noise: NonNegative = 0.01  # [m], standard deviation
    wheel_scale: Annotated[float, Meta(ge=0.5, le=2.0)] = 1.0  # true wheel radius / wheel_radius
    odometry_wheel_radius: Positive | None = None  # [m], if odometry has its own calibration
    servos: tuple[JointServos, ...] = ()  # of an arm, if they differ from SimServo's defaults


def sim_body(robot: RobotFile, options: MujocoOptions, run: Run) -> SimModel:
    """Return the simulated body of a robot. Raises ConfigError without a model."""
    path = run.folder / options.model
    try:
        model = read_bounded(path, MAX_MODEL_BYTES).decode()
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: expected UTF-8 text") from None
    except OSError as error:
        remedy = (
            "the robot's MJCF model belongs there, its own or that of a body like it; "
            "`model` names it"
        )
        raise ConfigError(f"{path}: {file_problem(error, remedy)}") from None
    lidar = _sim_lidar(robot, options)
    found: dict[str, Any] = {
        "model": model,
        "path": str(path),
        "named_by": options.model if options.model != "model.xml" else options.driver,
        "names": options.names,
        "footprint": robot.footprint,
        "joints": robot.joints,
        "servos": _servos(robot, options),
        "posture": robot.arm.home if robot.arm else (),
    }
    if robot.joints:
        found["substeps"] = ARM_SUBSTEPS
    if robot.drive_type == "arm":
        return SimModel(lidar=lidar, fixed=True, **found)
    if robot.drive_type == "quadruped":
        battery = replace(
            LEG_BATTERY,
            capacity_ah=options.battery_capacity,
            percentage=options.battery_percentage,
        )
        return SimQuadruped(lidar=lidar, battery=battery, **found)
    battery = SimBattery(
        capacity_ah=options.battery_capacity, percentage=options.battery_percentage
    )
    return SimBody(
        wheel_radius=robot.wheel_radius,
        wheel_base=robot.wheel_base,
        wheel_separation=robot.wheel_separation,
        odometry_wheel_radius=options.odometry_wheel_radius,
        wheel_scale=options.wheel_scale,
        lidar=lidar,
        battery=battery,
        **found,
        **(_two_wheels(robot) if robot.drive_type == "differential" else _wheels(robot, options)),
    )


def _servos(robot: RobotFile, options: MujocoOptions) -> dict[str, SimServo]:
    """Return the servos by joint. Raises UnknownName for an unknown joint."""
    known = [joint.name for joint in robot.joints]
    found = {name: servo for servo in options.servos for name in servo.joints}
    for name in found:
        if name not in known:
            raise unknown("joint", name, known)
    return dict(found)


def _two_wheels(robot: RobotFile) -> dict[str, Any]:
    """Return the wheel speeds of a differential base. Raises ConfigError."""
    missing = [name for name in ("wheel_radius", "wheel_separation") if not getattr(robot, name)]
    if missing:
        raise ConfigError(f"{robot.robot_type}: {' and '.join(missing)}: missing, in metres")
    turning = robot.max_angular_speed * robot.wheel_separation / 2
    needed = max(robot.max_linear_speed, turning) / robot.wheel_radius
    fastest = needed * SPARE_WHEEL_SPEED if needed > SimBody.max_wheel_speed else 0.0
    return {
        "needed_wheel_speed": needed,
        "max_wheel_speed": max(SimBody.max_wheel_speed, fastest),
    }


def _wheels(robot: RobotFile, options: MujocoOptions) -> dict[str, Any]:
    """Return the fields of a base on more than two wheels. Raises ConfigError."""
    who, drive = robot.robot_type, robot.drive_type
    missing = missing_measures(robot)
    if not robot.wheel_separation and "wheel_separation" not in missing:
        missing.append("wheel_separation")
    if missing:
        raise ConfigError(
            f"{who}: drive_type {drive!r} needs its {' and '.join(missing)}, in metres"
        )
    if drive in ROLLERS and options.wheel_scale != 1.0:
        raise ConfigError(f"{who}: wheel_scale: wheels with rollers cannot be scaled; remove it")
    base = wheels_of(robot)
    assert base
    fastest = Twist(robot.max_linear_speed, robot.max_lateral_speed, robot.max_angular_speed)
    if isinstance(base, Ackermann):
        steering = math.atan(robot.wheel_base / robot.turning_radius)
        car = replace(base, max_steering=steering)
        base = AckermannAxles(car, robot.wheel_separation)
    fastest_wheel = SPARE_WHEEL_SPEED * max(map(abs, base.to_wheels(fastest)))
    if drive == "omni" and robot.max_rim_speed:
        fastest_wheel = robot.max_rim_speed / robot.wheel_radius
    return {
        "base": base,
        "wheels": WHEELS[drive],
        "needed_wheel_speed": robot.max_linear_speed / robot.wheel_radius,
        "max_wheel_speed": fastest_wheel,
        "gyro_heading": drive == "skid_steer",
    }


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
        mount=(lidar.x, lidar.y, lidar.yaw),
        height=options.lidar_height,
    )
