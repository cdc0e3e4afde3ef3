"""The description and the state of the body."""

import math
from typing import Annotated, Literal

from msgspec import Meta

from gigabrain_schemas.base import (
    AccelerationLimit,
    Causes,
    Count,
    JointName,
    Message,
    Milliseconds,
    Name,
    Offset,
    Percentage,
    Pose,
    Range,
    Record,
    SpeedCap,
    SpeedLimit,
    Velocity,
)
from gigabrain_schemas.sensors import ImuData, RangeMax

GateMode = Literal["latched", "idle", "enabled", "stopping"]
DriveType = Literal[
    "differential", "skid_steer", "omni", "mecanum", "ackermann", "quadruped", "arm"
]
SafeState = Literal["stop", "hold", "park", "limp"]
# The bounds of thresholds refuse values that disable a monitor, or are in a wrong unit.
PerCent = Annotated[float, Meta(ge=1.0, le=100.0)]
Celsius = Annotated[float, Meta(ge=20.0, le=120.0)]
Sustain = Annotated[float, Meta(ge=0.02, le=10.0)]  # [s]
Age = Annotated[float, Meta(ge=0.02, le=2.0)]  # [s]
MountingAngle = Annotated[float, Meta(ge=-6.2832, le=6.2832)]  # [rad], within one turn
Shock = Annotated[float, Meta(ge=1.0, le=200.0)]  # [m/s2]
Margin = Annotated[float, Meta(ge=0.01, le=10.0)]  # [m]
Gain = Annotated[float, Meta(ge=0.0, le=1000.0)]  # [1/s]
Rate = Annotated[float, Meta(ge=0.1, le=1000.0)]  # [Hz]
OffBy = Annotated[float, Meta(gt=0.0, le=100.0)]  # [m/s] or [rad/s]
Megabytes = Annotated[float, Meta(gt=0.0, le=1e9)]
Volts = Annotated[float, Meta(ge=0.0, le=1000.0)]
Amperes = Annotated[float, Meta(ge=-10_000.0, le=10_000.0)]
JointPosition = Annotated[float, Meta(ge=-1e9, le=1e9)]  # [rad] or [m]; a wheel's position grows
JointSpeed = Annotated[float, Meta(ge=-10_000.0, le=10_000.0)]  # [rad/s] or [m/s]
Effort = Annotated[float, Meta(ge=-1e5, le=1e5)]  # [N m] or [N]
Temperature = Annotated[float, Meta(ge=-273.15, le=1000.0)]  # [deg C]
BoxSide = Annotated[float, Meta(ge=0.001, le=20.0)]  # [m]
Clearance = Annotated[float, Meta(ge=0.002, le=0.5)]  # [m]
Key = Annotated[str, Meta(pattern=r"^\w+(/\w+)*$", max_length=128)]


MAX_JOINTS = 128
MAX_ARM_JOINTS = 32
MAX_MODEL_CHARACTERS = 262_144
MAX_KEEP_OUT = 16
FOLLOW_SHARE = 0.06  # allowed distance of a joint from its setpoint, as a share of its range
MIN_AREA = 1e-4  # [m2]
MIN_SPEED = 0.001  # [m/s], [rad/s]


class Joint(Record, frozen=True, kw_only=True):
    """The measured state of one joint."""

    name: JointName
    position: JointPosition  # [rad], or [m] for a sliding joint
    velocity: JointSpeed = 0.0  # [rad/s] or [m/s]
    effort: Effort | None = None  # [N m] or [N]; None if not measured
    temperature: Temperature | None = None  # [deg C] of its motor
    current: Amperes | None = None  # [A] of its motor


class JointGains(Record, frozen=True, kw_only=True):
    """The gains of control's corrections for a joint whose servo holds positions.

    The setpoint is the desired position plus five terms: `p` times the error, `i` times its
    integral while the joint should rest, `d` times the error of speed, `feed_forward` times the
    desired speed, and `inertia` times the desired acceleration.
    """

    p: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.0
    i: Annotated[float, Meta(ge=0.0, le=20.0)] = 1.0  # [1/s]
    d: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0  # [s]
    feed_forward: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0  # [s], delay of the joint
    inertia: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.0  # [s2], inertia / stiffness of its servo
    max_correction: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.05  # [rad] or [m], of their sum


Tolerance = Annotated[float, Meta(ge=0.0, le=100.0)]  # [rad] or [m]


class JointDescription(Record, frozen=True, kw_only=True):
    """A joint that can be commanded, with its limits."""

    name: JointName
    part: Literal["arm", "gripper"] = "arm"
    unit: Literal["rad", "m"] = "rad"  # m for a sliding joint
    lower: JointPosition  # [rad], or [m] for a sliding joint
    upper: JointPosition  # [rad] or [m]
    max_speed: SpeedLimit  # [rad/s] or [m/s]
    max_acceleration: AccelerationLimit = 10.0  # [rad/s2] or [m/s2]
    max_jerk: Annotated[float, Meta(ge=0.01, le=1e5)] = 200.0  # [rad/s3] or [m/s3]
    max_effort: Annotated[float, Meta(ge=0.0, le=1e5)] = 0.0  # [N m] or [N]; 0 if unknown
    gains: JointGains = JointGains()
    path_tolerance: Tolerance = 0.3  # [rad] or [m], on a trajectory; 0: not checked
    goal_tolerance: Tolerance = 0.05  # [rad] or [m], at a trajectory's end; 0: not checked
    max_current: Annotated[float, Meta(ge=0.0, le=10_000.0)] = 0.0  # [A]; 0 if unknown
    follow: Annotated[float, Meta(gt=0.0, le=10.0)] | None = None
    # [rad] or [m], allowed distance from its setpoint; None: FOLLOW_SHARE of its range

    def __post_init__(self) -> None:
        if self.upper <= self.lower:
            raise ValueError(f"{self.name}: upper must be larger than lower")
        if self.follow is not None and self.follow > (self.upper - self.lower) / 4:
            raise ValueError(f"{self.name}: follow must not be more than a quarter of its range")

    @property
    def follow_error(self) -> float:
        """Return the distance from the setpoint that safety tolerates [rad] or [m]."""
        return self.follow or FOLLOW_SHARE * (self.upper - self.lower)


class KeepOut(Record, frozen=True, kw_only=True):
    """A box that no part of the arm may enter, in the frame of the arm's model."""

    name: Name
    center: tuple[Offset, Offset, Offset]  # [m]
    size: tuple[BoxSide, BoxSide, BoxSide]  # [m], along the box's own x, y and z
    yaw: MountingAngle = 0.0  # [rad]


class Arm(Record, frozen=True, kw_only=True):
    """Data of an arm, besides its joints and its model."""

    tool: Name = "tool"  # site of the model that reaches for objects, along its x axis
    home: Annotated[tuple[JointPosition, ...], Meta(min_length=1, max_length=MAX_ARM_JOINTS)]
    # [rad] or [m], posture that keeps the arm out of the way; one number per joint
    carry: Annotated[tuple[JointPosition, ...], Meta(max_length=MAX_ARM_JOINTS)] = ()
    # [rad] or [m], posture to carry an object while the base drives; empty if there is none
    rate_hz: Annotated[float, Meta(ge=50.0, le=200.0)] = 50.0  # of control's joint commands
    goal_time: Sustain = 1.0  # [s] until joints must be at a trajectory's end
    floor: Annotated[float, Meta(ge=-10.0, le=10.0)] | None = None
    # [m], height of the floor or table in the model's frame; None: out of reach
    keep_out: Annotated[tuple[KeepOut, ...], Meta(max_length=MAX_KEEP_OUT)] = ()
    voltage: tuple[Volts, Volts] | None = None  # [V], minimum and maximum of its supply

    def __post_init__(self) -> None:
        if len({box.name for box in self.keep_out}) < len(self.keep_out):
            raise ValueError("keep_out: each box needs a name of its own")
        if self.voltage and self.voltage[1] <= self.voltage[0]:
            raise ValueError("voltage: expected the least and the greatest, in this order")


class Battery(Record, frozen=True, kw_only=True):
    """The main battery."""

    voltage: Volts  # [V]
    percentage: Percentage  # [%]
    current: Amperes = 0.0  # [A], positive while discharging


class LinkHealth(Record, frozen=True, kw_only=True):
    """State of the driver's connection to the body."""

    connected: bool = True
    age_ms: Milliseconds = 0.0  # since the body's last message
    late_ms: Milliseconds | None = None  # delay beyond the shortest one; None without device clock
    errors: Count = 0  # frames discarded
    reconnects: Count = 0


class GateStatus(Record, frozen=True, kw_only=True):
    """The gate's mode, its commander, and the causes of stops."""

    mode: GateMode = "latched"
    causes: Causes = ()
    estop_generation: Count = 0  # number of e-stops; a release must name it
    commander: Name = ""  # source of commands that the gate obeys; empty for none
    enables: Count = 0  # number of enables since this boot
    latches: Count = 0  # number of latches since this boot


class RobotState(Message, frozen=True, kw_only=True):
    """The body's own measurements. Its tick is the robot's clock."""

    robot_type: Name
    pose: Pose  # odometry since the driver's start
    velocity: Velocity  # measured
    sent: Velocity = Velocity()  # last command to the body, rounded as its protocol encodes it
    joints: Annotated[tuple[Joint, ...], Meta(max_length=MAX_JOINTS)] = ()
    joints_sent: Annotated[tuple[JointPosition, ...], Meta(max_length=MAX_ARM_JOINTS)] = ()
    # [rad] or [m], last setpoints of the body, in the order of its description
    limp: bool = False  # the joints' torque is off: a person can move them
    battery: Battery | None = None
    imu: ImuData | None = None
    bumpers: Annotated[tuple[bool, ...], Meta(max_length=64)] = ()
    link: LinkHealth = LinkHealth()
    gate: GateStatus = GateStatus()


class Lidar(Record, frozen=True, kw_only=True):
    """A planar lidar and its mounting."""

    beams: Annotated[int, Meta(ge=1, le=100_000)]
    rate_hz: Rate
    range_min: Range  # [m]
    range_max: RangeMax  # [m]
    x: Offset = 0.0  # [m], mounting in the body's frame
    y: Offset = 0.0  # [m]
    yaw: MountingAngle = 0.0  # [rad]
    no_return: Literal["free", "unknown"] = "free"  # meaning of an infinite range of this sensor


Side = Annotated[int, Meta(ge=16, le=4096, multiple_of=2)]  # [px] of a picture
PixelOffset = Annotated[float, Meta(ge=-1e5, le=1e5)]  # [px]
FocalLength = Annotated[float, Meta(ge=1.0, le=1e5)]  # [px]
FieldOfView = Annotated[float, Meta(ge=0.1, le=3.0)]  # [rad]
Coefficient = Annotated[float, Meta(ge=-100.0, le=100.0)]  # of distortion
CameraName = Annotated[str, Meta(pattern=r"^[A-Za-z][A-Za-z0-9_]*$(?!\n)", max_length=32)]
MAX_CAMERAS = 8


class Camera(Record, frozen=True, kw_only=True):
    """A camera: its optics, and its mounting (REP-103: it looks along its own x axis)."""

    name: CameraName
    width: Side = 320
    height: Side = 240
    rate_hz: Annotated[float, Meta(ge=0.5, le=120.0)] = 10.0
    field_of_view: FieldOfView = 1.047  # [rad], horizontal, if there are no `intrinsics`
    intrinsics: tuple[FocalLength, FocalLength, PixelOffset, PixelOffset] | None = None
    # [px]: fx, fy, cx, cy of the calibration
    # k1, k2, p1, p2, k3, and k4, k5, k6 of the rational model
    distortion: Annotated[tuple[Coefficient, ...], Meta(max_length=8)] = ()
    depth: bool = False  # the camera also measures the depth of each pixel
    depth_min: Range = 0.25  # [m]; nearer depths are unknown
    depth_max: RangeMax = 6.0  # [m]
    link: Name = ""  # body of the arm's model that carries it; empty: the robot's base
    x: Offset = 0.0  # [m], mounting in the link's frame; in the base's frame z is from the floor
    y: Offset = 0.0  # [m]
    z: Offset = 0.0  # [m]
    roll: MountingAngle = 0.0  # [rad]
    pitch: MountingAngle = 0.0  # [rad], positive is down
    yaw: MountingAngle = 0.0  # [rad]

    def __post_init__(self) -> None:
        if self.depth_max <= self.depth_min:
            raise ValueError("depth_max must be larger than depth_min")
        if self.link and self.depth:
            raise ValueError("link: a camera on an arm cannot measure depth; set depth: false")

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """The intrinsics fx, fy, cx, cy [px]; by the field of view if not calibrated."""
        if self.intrinsics:
            return self.intrinsics
        focal = self.width / 2 / math.tan(self.field_of_view / 2)
        return focal, focal, (self.width - 1) / 2, (self.height - 1) / 2


class ControlGains(Record, frozen=True, kw_only=True):
    """Control's rate of commands, and its gains for the measured velocity."""

    linear_integral: Gain = 1.5  # [1/s]
    angular_integral: Gain = 1.5  # [1/s]
    max_correction: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.25  # of the commanded speed
    rate_hz: Annotated[float, Meta(ge=12.5, le=50.0)] = 50.0  # of commands; periods are whole ticks

    @property
    def period_ticks(self) -> int:
        """Ticks from one command to the next."""
        return round(50.0 / self.rate_hz)


class Thresholds(Record, frozen=True, kw_only=True):
    """The thresholds of safety. None of them can be switched off."""

    battery_warn: PerCent = 15.0  # [%], charge it soon
    battery_return: PerCent = 7.0  # [%], decision stops the robot
    battery_stop: PerCent = 5.0  # [%], the robot stops and latches
    battery_sustain: Sustain = 2.0  # [s], a shorter sag does not count
    motor_warn: Celsius = 60.0  # [deg C]
    motor_stop: Celsius = 70.0  # [deg C], the robot stops and latches
    motor_sustain: Sustain = 0.5  # [s]
    missing_after: Sustain = 2.0  # [s] without a value that the body measured before
    scan_age: Age = 0.25  # [s], or 1.5 scan periods if that is longer
    heartbeat: Age = 0.15  # [s] without an answer of perception, decision or control
    round_trip: Age = 0.1  # [s], 99 of 100 commands must echo a younger tick
    round_trip_sustain: Sustain = 1.0  # [s]
    follow_linear: OffBy = 0.05  # [m/s], tolerance between measured and commanded speed
    follow_angular: OffBy = 0.3  # [rad/s]
    follow_sustain: Sustain = 0.3  # [s]
    stuck_sustain: Sustain = 2.0  # [s] without motion
    response: Age = 0.1  # [s], normal delay of the measured speed
    late: Age = 0.07  # [s], allowed delay beyond the shortest one, or beyond `response`
    late_sustain: Sustain = 0.2  # [s]
    frozen_sustain: Sustain = 0.4  # [s] of constant values during commanded motion
    tilt_stop: Annotated[float, Meta(ge=5.0, le=90.0)] = 30.0  # [deg], the robot stops and latches
    shock_stop: Annotated[float, Meta(ge=1.0, le=200.0)] = (
        40.0  # [m/s2], horizontal; the robot stops and latches
    )
    disk_warn: Megabytes = 500.0  # [MB] free on safety's host
    cpu_warn: PerCent = 95.0  # [%] of all cores, over ten seconds
    memory_warn: PerCent = 95.0  # [%] in use
    reaction_time: Age = 0.22  # [s], scan period + bus + gate + drive
    stop_margin: Margin = 0.08  # [m], kept free before a stopped robot
    resume_margin: Margin = 0.10  # [m], beyond the stop zone, that must be free to go on
    side_margin: Margin = 0.03  # [m], kept free beside the moving body
    joint_sustain: Sustain = 0.5  # [s] away from its setpoint; the robot stops and latches
    effort_sustain: Sustain = 1.0  # [s] at maximum effort or current; the robot stops and latches
    arm_clearance: Clearance = 0.005  # [m], kept free around the arm

    def __post_init__(self) -> None:
        if not self.battery_stop <= self.battery_return <= self.battery_warn:
            raise ValueError("battery_stop, battery_return and battery_warn must ascend")
        if self.motor_stop < self.motor_warn:
            raise ValueError("motor_stop must not be below motor_warn")


DEFAULT = Thresholds()


class BodyDescription(Record, frozen=True, kw_only=True, cache_hash=True):
    """The description of a body for the brain. The common part of a robot's YAML file."""

    robot_type: Name  # name of the model
    drive_type: DriveType
    footprint: Annotated[tuple[tuple[Offset, Offset], ...], Meta(min_length=3, max_length=64)]
    # [m], corners in the body's frame, in order
    max_linear_speed: SpeedCap = 0.0  # [m/s]; 0 only for an arm without a base
    max_lateral_speed: SpeedCap = 0.0  # [m/s]
    max_angular_speed: SpeedCap = 0.0  # [rad/s]
    max_linear_acceleration: AccelerationLimit = 1.0  # [m/s2]
    max_linear_deceleration: AccelerationLimit = 1.0  # [m/s2]
    max_angular_acceleration: AccelerationLimit = 3.0  # [rad/s2]
    wheel_separation: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.0
    # [m], between left and right wheels; for omni wheels, between neighbours
    wheel_radius: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.0  # [m]; 0: unknown, or no wheels
    max_rim_speed: SpeedLimit | None = None
    # [m/s], of a wheel of a differential or omni base; None: it reaches all maximum speeds at once
    min_turning_radius: Annotated[float, Meta(ge=0.0, le=100.0)] = 0.0
    # [m], of an Ackermann base; 0: max_linear_speed / max_angular_speed
    body_height: Annotated[float, Meta(ge=0.01, le=10.0)] = 0.5  # [m], height of its top
    # joints that can be commanded, from the base to the tool
    joints: Annotated[tuple[JointDescription, ...], Meta(max_length=MAX_ARM_JOINTS)] = ()
    arm: Arm | None = None
    lidar: Lidar | None = None
    cameras: Annotated[tuple[Camera, ...], Meta(max_length=MAX_CAMERAS)] = ()
    thresholds: Thresholds = DEFAULT
    control: ControlGains = ControlGains()
    safe_state: SafeState = "stop"  # state in which the driver leaves the body
    control_topic: Key = "robot/cmd_vel"  # key of the commands that the driver obeys

    def __post_init__(self) -> None:
        if _area(self.footprint) < MIN_AREA:
            raise ValueError("footprint: it must enclose an area, its corners in order")
        for name in ("max_linear_speed", "max_angular_speed"):
            if self.drive_type != "arm" and getattr(self, name) < MIN_SPEED:
                raise ValueError(f"{name}: expected at least {MIN_SPEED:g}")
        self._check_joints()
        for name, speed in (
            ("follow_linear", self.max_linear_speed),
            ("follow_angular", self.max_angular_speed),
        ):
            off = getattr(self.thresholds, name)
            if off > max(speed, getattr(DEFAULT, name)):
                raise ValueError(
                    f"thresholds: {name}: its error never reaches {off:g}, "
                    f"as its largest speed is {speed:g}; lower it"
                )
        if len({camera.name for camera in self.cameras}) < len(self.cameras):
            raise ValueError("cameras: each needs a name of its own")
        if self.arm is None and any(camera.link for camera in self.cameras):
            raise ValueError("cameras: link: the body has no arm; leave it out")
        if self.lidar is None:
            return
        needs = self.stopping_distance(self.max_linear_speed)
        if needs > self.lidar.range_max:
            raise ValueError(
                f"max_linear_speed: it takes {needs:.2f} m to stop from it, "
                f"and the lidar sees no farther than {self.lidar.range_max:g} m"
            )

    def _check_joints(self) -> None:
        if len({joint.name for joint in self.joints}) < len(self.joints):
            raise ValueError("joints: each needs a name of its own")
        if self.drive_type == "arm" and not self.joints:
            raise ValueError("joints: missing; a body that is an arm alone has some")
        if bool(self.joints) != (self.arm is not None):
            raise ValueError("arm: joints and arm belong together; one of them is missing")
        if self.arm is None:
            return
        self._check_posture("home", self.arm.home)
        if self.arm.carry:
            self._check_posture("carry", self.arm.carry)

    def _check_posture(self, name: str, positions: tuple[float, ...]) -> None:
        if len(positions) != len(self.joints):
            raise ValueError(
                f"arm: {name}: expected {len(self.joints)} positions, one for each joint"
            )
        for joint, position in zip(self.joints, positions, strict=True):
            if not joint.lower <= position <= joint.upper:
                raise ValueError(
                    f"arm: {name}: {joint.name} at {position:g} is outside "
                    f"{joint.lower:g} to {joint.upper:g}"
                )

    @property
    def has_base(self) -> bool:
        """Return whether the body can drive; a fixed arm cannot."""
        return self.drive_type != "arm"

    @property
    def fixed_cameras(self) -> tuple[Camera, ...]:
        """The cameras that do not move with an arm."""
        return tuple(camera for camera in self.cameras if not camera.link)

    @property
    def turning_radius(self) -> float:
        """The radius of the tightest turn [m]; 0 for bodies that turn on the spot."""
        if self.drive_type != "ackermann":
            return 0.0
        return self.min_turning_radius or self.max_linear_speed / self.max_angular_speed

    def stopping_distance(self, speed: float) -> float:
        """Return L(v) = v T + v² / 2a + margin [m], the free length needed at `speed` [m/s]."""
        t, a = self.thresholds.reaction_time, self.max_linear_deceleration
        return speed * t + speed * speed / (2 * a) + self.thresholds.stop_margin


def _area(corners: tuple[tuple[float, float], ...]) -> float:
    """Return the area that `corners` enclose [m2], by Gauss's formula."""
    return (
        abs(sum(x * corners[i - 1][1] - corners[i - 1][0] * y for i, (x, y) in enumerate(corners)))
        / 2
    )


class Body(Message, frozen=True, kw_only=True):
    """The body that the driver serves. The last value is kept for late joiners."""

    description: BodyDescription
    link: Literal["sim", "emulated", "real"]


class ArmModel(Message, frozen=True, kw_only=True):
    """The model of a body with an arm. The last value is kept for late joiners."""

    # MuJoCo XML with primitive shapes only; its joints have the names of the description
    mjcf: Annotated[str, Meta(max_length=MAX_MODEL_CHARACTERS)]
