"""Options of `driver: ros2` in a robot's file: how to join ROS 2, and the robot's topics.

Each check raises ValueError with the text `FIELD: fault; expected …`.
"""

import math
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from gigabrain_drivers.driver.robot import LinkOptions, RobotFile
from gigabrain_schemas.base import Name
from gigabrain_zenoh.config.settings import DRIVER_NODE, Ros2Link, RosName, RosNamespace
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import read_bounded

TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
ODOMETRY, SCAN, IMU = "nav_msgs/msg/Odometry", "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/Imu"
BATTERY, JOINTS = "sensor_msgs/msg/BatteryState", "sensor_msgs/msg/JointState"
TF, TF_TOPIC, TF_STATIC_TOPIC = "tf2_msgs/msg/TFMessage", "/tf", "/tf_static"

Topic = Annotated[str, Meta(pattern=r"^/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$")]
Frame = Annotated[str, Meta(max_length=128)]
Rate = Annotated[float, Meta(ge=10, le=200)]
Angle = Annotated[float, Meta(ge=-math.tau, le=math.tau)]
Offset = Annotated[float, Meta(ge=-10.0, le=10.0)]
Step = Annotated[float, Meta(ge=0.0, le=0.1)]
Factor = Annotated[float, Meta(ge=-1e6, le=1e6)]
Seconds = Annotated[float, Meta(ge=0.05, le=60.0)]
Reliability = Literal["best_effort", "reliable"]

MAX_WATCHDOG_S = 0.2  # a robot with a longer watchdog needs a guard
MAX_ADDRESS_BYTES = 512  # size of a file with an emulator's address


class _Part(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A topic of the robot. Relative names are in the link's namespace."""


class CommandTopic(_Part, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The topic that the robot obeys."""

    name: Topic = "cmd_vel"
    type: Literal["geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"]
    frame: Frame = "base_link"  # in the header of TwistStamped
    hz: Rate = 20.0  # repetition of an unchanged command; a new one is sent at once
    step: Step = 0.0  # [m/s] and [rad/s], the robot truncates speeds to multiples of it; 0: none
    qos: Reliability = "reliable"  # offered; a reliable publisher matches every subscriber


class OdometryTopic(_Part, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The topic with pose and velocity, a nav_msgs/msg/Odometry."""

    name: Topic = "odom"
    hz: Rate = 20.0  # promised by the robot; the link is lost after 2.5 periods without a message
    child_frame: Frame = ""  # required in each message; empty: any
    x: Offset = 0.0  # [m], pose of the child frame in the body's frame
    y: Offset = 0.0  # [m]
    yaw: Angle = 0.0  # [rad]
    qos: Reliability = "best_effort"


class ScanTopic(_Part, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The topic of the lidar, a sensor_msgs/msg/LaserScan."""

    name: Topic = "scan"
    clockwise: bool = False  # true: the beams run clockwise, although the message says otherwise
    angle: Angle = 0.0  # [rad], added to all angles, to correct a wrong start angle
    zero: Literal["no_return", "unknown"] = "no_return"  # meaning of a range of 0
    nan: Literal["no_return", "unknown"] = "unknown"  # meaning of a range of NaN
    qos: Reliability = "best_effort"


class ImuTopic(_Part, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The topic of the inertial measurement unit, a sensor_msgs/msg/Imu."""

    name: Topic = "imu"
    yaw: Angle = 0.0  # [rad], yaw of its mounting; unused with `mounting: tf_static`
    qos: Reliability = "best_effort"


class BatteryTopic(_Part, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The topic of the battery, a sensor_msgs/msg/BatteryState."""

    name: Topic = "battery_state"
    full: Literal[1, 100] = 1  # its percentage at full charge; 1 by ROS convention
    qos: Reliability = "best_effort"


class JointsTopic(_Part, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The topic of the joints, a sensor_msgs/msg/JointState."""

    name: Topic = "joint_states"
    velocity_factor: Factor = 1.0  # converts its velocities to rad/s
    names: dict[str, Name] = {}  # from the robot's names of joints to ours
    qos: Reliability = "best_effort"


class Topics(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The robot's topics. An omitted topic does not exist."""

    command: CommandTopic
    odometry: OdometryTopic = OdometryTopic()
    scan: ScanTopic | None = None
    imu: ImuTopic | None = None
    battery: BatteryTopic | None = None
    joints: JointsTopic | None = None


class Ros2Options(LinkOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A robot with a ROS 2 interface."""

    transport: Literal["rmw_zenoh", "dds"]
    domain: Annotated[int, Meta(ge=0, le=232)] = 0  # ROS_DOMAIN_ID of the robot
    namespace: RosNamespace = "/"
    node: RosName = DRIVER_NODE  # name of the driver's node
    router: str = ""  # Zenoh endpoint of the robot's ROS router, for rmw_zenoh
    distro: Literal["humble", "iron", "jazzy", "kilted", "rolling"] = "jazzy"  # of the robot
    localhost: bool = False  # true: DDS connects only to nodes of this host
    port: str = ""  # file with an emulator's address, which replaces domain and router
    topics: Topics
    watchdog: Seconds | Literal["none"]  # [s], time without commands until the robot stops
    mounting: Literal["file", "tf_static"] = "file"  # source of sensor mountings: this file, or ROS
    base_frame: Frame = "base_footprint"  # the body's frame in ROS

    def __post_init__(self) -> None:
        if self.transport == "rmw_zenoh" and not self.router and not self.port:
            raise ValueError(
                "router: it is needed for rmw_zenoh; expected the endpoint of the robot's router, "
                "such as tcp/192.168.1.20:7447"
            )
        if self.transport == "dds" and self.router:
            raise ValueError("router: DDS has none; expected it for transport: rmw_zenoh only")
        if self.localhost and self.transport != "dds":
            raise ValueError("localhost: it is of DDS; a router's endpoint says where rmw_zenoh is")
        _check_names(self.topics)

    @property
    def needs_guard(self) -> bool:
        """True if the robot would drive on for too long after this driver died."""
        return self.watchdog == "none" or self.watchdog > MAX_WATCHDOG_S

    @property
    def bound(self) -> bool:
        """True if the node stays on the network interface on which it joined."""
        return self.transport == "dds" and not (self.localhost or self.port)

    def link(self, node: str = "") -> Ros2Link:
        """Return the settings to join ROS 2. Raises ConfigError without an emulator's file."""
        link = Ros2Link(
            transport=self.transport,
            domain=self.domain,
            namespace=self.namespace,
            node=node or self.node,
            router=self.router,
            distro=self.distro,
            localhost=self.localhost,
        )
        return at_address(link, Path(self.port)) if self.port else link


class Address(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An emulator's address, as in the file `port`."""

    domain: Annotated[int, Meta(ge=0, le=232)] = 0
    router: str = ""


def at_address(link: Ros2Link, path: Path) -> Ros2Link:
    """Return `link` with the emulator's address in a file. Raises ConfigError."""
    try:
        found = msgspec.json.decode(read_bounded(path, MAX_ADDRESS_BYTES), type=Address)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; is its emulator running?") from None
    except msgspec.MsgspecError as error:
        raise ConfigError(f"{path}: {error}; expected the file of an emulator's port") from None
    router, local = found.router, link.transport == "dds"
    return msgspec.structs.replace(link, domain=found.domain, router=router, localhost=local)


def check_options(options: Ros2Options, robot: RobotFile) -> None:
    """Raise ValueError if the topics do not fit the body."""
    topics = options.topics
    if topics.scan and options.scan:
        raise ValueError(
            "scan: the lidar is on a topic (topics.scan) and on a line of its own; expected one"
        )
    if topics.scan and not (options.lidar or robot.lidar):
        raise ValueError(
            "topics: there is a scan, but no `lidar:` at the top of this file; expected its beams, "
            "rate_hz, range_min and range_max"
        )
    slower_limit = min(robot.max_linear_speed, robot.max_angular_speed)
    if topics.command.step > 0.25 * slower_limit:
        raise ValueError(
            f"topics: command: a step of {topics.command.step:g} is too coarse for a body that "
            f"does {slower_limit:g} at most; expected a quarter of that or less"
        )
    if robot.drive_type == "quadruped":
        raise ValueError("driver: ros2 drives bodies by velocity; expected another drive_type")


def _check_names(topics: Topics) -> None:
    parts = (name for name in topics.__struct_fields__ if getattr(topics, name))
    seen: dict[str, str] = {}
    for part in parts:
        name = getattr(topics, part).name
        if name in seen:
            raise ValueError(f"topics: {part} and {seen[name]} have the same name {name}")
        seen[name] = part
