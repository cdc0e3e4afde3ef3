"""The body: what it is, and what it is doing."""

from typing import Annotated, Literal

from msgspec import Meta

from gigabrain_schemas.base import (
    Cause,
    Count,
    Finite,
    Message,
    Name,
    NonNegative,
    Percentage,
    Pose,
    Positive,
    Record,
    Velocity,
)
from gigabrain_schemas.sensors import ImuData

GateMode = Literal["latched", "idle", "enabled", "stopping"]
DriveType = Literal["differential", "omni", "mecanum", "ackermann", "quadruped", "arm"]
SafeState = Literal["stop", "hold", "park", "limp"]
Key = Annotated[str, Meta(pattern=r"^\w+(/\w+)*$", max_length=128)]


class Joint(Record, frozen=True, kw_only=True):
    """One joint as measured."""

    name: Name
    position: Finite  # [rad], or [m] for a sliding joint
    velocity: Finite = 0.0  # [rad/s] or [m/s]
    effort: Finite | None = None  # [N m] or [N]; None where it is not measured
    temperature: Finite | None = None  # [deg C] of its motor


class Battery(Record, frozen=True, kw_only=True):
    """The main battery."""

    voltage: NonNegative  # [V]
    percentage: Percentage  # [%]
    current: Finite = 0.0  # [A], positive while it drains


class LinkHealth(Record, frozen=True, kw_only=True):
    """How the driver's line to the body is doing."""

    connected: bool = True
    age_ms: NonNegative = 0.0  # since the body was last heard
    errors: Count = 0  # frames that were thrown away
    reconnects: Count = 0


class GateStatus(Record, frozen=True, kw_only=True):
    """What the gate lets through, and why not more."""

    mode: GateMode = "latched"
    causes: tuple[Cause, ...] = ()
    estop_generation: Count = 0  # how often an e-stop was pressed; a release must name it
    commander: Name = ""  # whose commands pass; empty for nobody's
    enables: Count = 0  # how often it was enabled since this boot


class RobotState(Message, frozen=True, kw_only=True):
    """What the body measures of itself. Its tick is the robot's clock."""

    robot_type: Name
    pose: Pose  # odometry, since the driver's start
    velocity: Velocity  # as measured
    joints: tuple[Joint, ...] = ()
    battery: Battery | None = None
    imu: ImuData | None = None
    bumpers: tuple[bool, ...] = ()
    link: LinkHealth = LinkHealth()
    gate: GateStatus = GateStatus()


class Lidar(Record, frozen=True, kw_only=True):
    """A planar lidar and where it sits."""

    beams: Annotated[int, Meta(ge=1, le=100_000)]
    rate_hz: Positive
    range_min: NonNegative  # [m]
    range_max: Positive  # [m]
    x: Finite = 0.0  # [m], mounting in the body's frame
    y: Finite = 0.0  # [m]
    yaw: Finite = 0.0  # [rad]
    no_return: Literal["free", "unknown"] = "free"  # what an infinite range of this sensor means


class ControlGains(Record, frozen=True, kw_only=True):
    """How often control commands, and how it corrects the measured velocity."""

    linear_integral: NonNegative = 1.5  # [1/s]
    angular_integral: NonNegative = 1.5  # [1/s]
    max_correction: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.25  # of the commanded speed
    rate_hz: Annotated[float, Meta(ge=12.5, le=50.0)] = 50.0  # of commands; whole ticks apart

    @property
    def period_ticks(self) -> int:
        """Ticks from one command to the next."""
        return round(50.0 / self.rate_hz)


class Thresholds(Record, frozen=True, kw_only=True):
    """When safety speaks up."""

    battery_warn: Percentage = 15.0  # [%]
    battery_stop: Percentage = 5.0  # [%]
    motor_warn: Finite = 60.0  # [deg C]
    motor_stop: Finite = 70.0  # [deg C]
    reaction_time: Positive = 0.22  # [s], scan period + bus + gate + drive
    stop_margin: NonNegative = 0.08  # [m], kept free in front of a stopped robot

    def __post_init__(self) -> None:
        if self.battery_stop > self.battery_warn:
            raise ValueError("battery_stop must not be above battery_warn")
        if self.motor_stop < self.motor_warn:
            raise ValueError("motor_stop must not be below motor_warn")


class BodyDescription(Record, frozen=True, kw_only=True):
    """Everything that the brain has to know of a body. The common part of a robot's YAML file."""

    robot_type: Name
    drive_type: DriveType
    footprint: Annotated[tuple[tuple[Finite, Finite], ...], Meta(min_length=3, max_length=64)]
    # [m], corners in the body's frame, in order
    max_linear_speed: Positive  # [m/s]
    max_lateral_speed: NonNegative = 0.0  # [m/s]
    max_angular_speed: Positive  # [rad/s]
    max_linear_acceleration: Positive = 1.0  # [m/s2]
    max_linear_deceleration: Positive = 1.0  # [m/s2]
    max_angular_acceleration: Positive = 3.0  # [rad/s2]
    lidar: Lidar | None = None
    thresholds: Thresholds = Thresholds()
    control: ControlGains = ControlGains()
    safe_state: SafeState = "stop"
    control_topic: Key = "robot/cmd_vel"  # the key that its driver obeys


class Body(Message, frozen=True, kw_only=True):
    """The body that the driver serves. The last value is kept for those who join late."""

    description: BodyDescription
    link: Literal["sim", "emulated", "real"]
