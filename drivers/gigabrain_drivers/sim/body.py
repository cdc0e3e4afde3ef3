"""What the simulation has to know of a body: its model and the figures of its parts."""

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class SimLidar:
    """A planar lidar at the model's site `lidar`; the first beam looks along the site's x axis."""

    beams: int = 360
    rate_hz: float = 10.0
    range_min: float = 0.12  # [m]
    range_max: float = 3.5  # [m]
    noise_m: float = 0.01  # standard deviation of a range


@dataclass(frozen=True, kw_only=True)
class SimBattery:
    """A battery; the defaults are TurtleBot3's three lithium cells."""

    capacity_ah: float = 1.8
    full_voltage: float = 12.6
    nominal_voltage: float = 11.1  # at half charge
    empty_voltage: float = 9.9
    internal_resistance_ohm: float = 0.1
    idle_current_a: float = 0.6  # computer, lidar and board
    drive_current_a: float = 0.8  # on top of that, all wheels at full speed without load
    percentage: float = 100.0  # at the start, 0-100


@dataclass(frozen=True, kw_only=True)
class SimMotor:
    """One wheel's gear motor as seen at the wheel; the defaults are a Dynamixel XL430-W250."""

    torque_per_ampere: float = 1.07  # [N m/A], stall: 1.5 N m at 1.4 A
    resistance_ohm: float = 8.6  # 12 V at 1.4 A
    heat_capacity: float = 50.0  # [J/K]
    thermal_resistance: float = 12.0  # [K/W], to the air
    ambient_celsius: float = 25.0


@dataclass(frozen=True, kw_only=True)
class SimBody:
    """A differential-drive body for the simulation.

    The model's base body is `base` with its origin between the wheels and the free joint `free`;
    geoms called `hull_...` make up its outline. Each name of `wheels` (left, right) is a body,
    an actuator and, with `_joint` after it, a joint. `wheel_radius` and `wheel_separation` are
    what the base's own kinematics believes; the truth is in the model.
    """

    model: str  # MJCF
    wheel_radius: float  # [m], turns commands into wheel speeds
    wheel_separation: float  # [m]
    odometry_wheel_radius: float | None = None  # [m], turns encoder ticks into metres
    wheel_scale: float = 1.0  # true wheel radius / radius in the model: worn or swollen tyres
    max_wheel_speed: float = 9.0  # [rad/s]
    max_wheel_acceleration: float = 60.0  # [rad/s2]
    wheels: tuple[str, str] = ("wheel_left", "wheel_right")
    encoder_ticks: int = 4096  # per turn
    lidar: SimLidar | None = field(default_factory=SimLidar)
    battery: SimBattery = field(default_factory=SimBattery)
    motor: SimMotor = field(default_factory=SimMotor)
