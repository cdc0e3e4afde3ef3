"""Settings of the processes. This module needs no numpy, so deployment files are read fast."""

import re
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct, field

from gigabrain_schemas.base import NonNegative, Positive

LinkName = Literal["sim", "emulated", "real"]
Resume = Literal["auto", "manual"]
Seed = Annotated[int, Meta(ge=0, le=2**32)]
Speed = Annotated[float, Meta(ge=0.1, le=100)]  # factor of real time; other than 1 means lock-step
LockstepTimeout = Annotated[float, Meta(ge=0.15, le=60)]  # [s] of wall time


class Endpoint(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Addresses and identity with which a process connects to the others."""

    connect: tuple[str, ...] = ()  # Zenoh endpoints, such as tcp/127.0.0.1:7447
    listen: tuple[str, ...] = ()  # Zenoh endpoints that a router listens on
    namespace: str = ""  # the robot's prefix in the key space
    keys: str = ""  # folder of an identity; without it there is no authentication
    fleet: tuple[str, ...] = ()  # namespaces of other robots that a router serves
    names: dict[str, tuple[str, ...]] = {}  # processes by role, for the rights that a router grants
    grants: dict[str, tuple[str, ...]] = {}  # keys that the user's own processes write, by name
    nap_s: float = 0.0  # [s], longest delay of tapped messages, which arrive in batches
    stamps: bool = False  # samples carry Zenoh's time, by which ROS nodes order them


class RouterConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the router process."""

    state_dir: str = ""  # folder of its log of rejected clients
    knows: tuple[str, ...] = ()  # common names with rights; empty without keys: no check
    watches: tuple[str, ...] = ()  # the user's own processes; it reports silent ones


class RelayConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the relay process."""

    router: str  # the robot's router, for log messages
    keys: str = ""  # folder of the host's identity


MappingMode = Literal["off", "slam", "localize"]


class PerceptionConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings in the `perception` part of a deployment file."""

    sector_deg: Annotated[float, Meta(gt=0, le=360)] = 30.0  # [deg], angle of the cone ahead
    ahead: Positive = 1.0  # [m], length of that cone
    ignore_below: NonNegative = 0.1  # [m], nearer hits are the lidar's own housing
    corridor: NonNegative = 0.45  # [m], length of the strip ahead that must be free for a turn
    turning_room: NonNegative = 0.04  # [m], clearance around the circle that a turning body sweeps
    sectors: Annotated[int, Meta(ge=4, le=360)] = 12  # of the full circle; the first is ahead
    mapping: MappingMode = "off"  # build a map, or localize in a saved one
    map: str = ""  # YAML file of a saved map to localize in; `slam` extends it
    state_dir: str = ""  # folder where `slam` saves the map every few seconds; empty: no saves
    compile_first: bool = False  # wait for compiled kernels; always at speeds other than 1

    def __post_init__(self) -> None:
        if self.map and self.mapping == "off":
            raise ValueError("map: needs mapping; set `mapping` to slam or localize")


class DecisionConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings in the `decision` part of a deployment file."""

    behaviour: str = "avoid"  # shipped, or offered by an installed package
    settings: dict[str, Any] = {}  # of the behaviour; see its Config
    state_dir: str = ""  # folder where it saves its tasks; empty: not saved
    compile_first: bool = False  # wait for compiled kernels; always at speeds other than 1


class DriverConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the driver process."""

    body: str
    link: LinkName = "sim"
    world: str = "arena"
    seed: Seed = 0
    speed: Speed = 1.0
    lockstep_timeout_s: LockstepTimeout = 0.15  # a tick waits this long for the brain (speed not 1)
    seconds: Positive | None = None  # [s] of simulated time; then the body stays at rest
    resume: Resume = "manual"
    state_dir: str  # folder where it saves the causes that latched it
    emulator: str = ""  # folder of the emulator's ports, if the link is `emulated`
    checkpoint: str = ""  # path of a simulation's checkpoints in this run; empty: none
    button: bool = False  # an e-stop button must be present
    cameras: bool = False  # use the body's cameras
    robot: dict[str, Any] = {}  # replaces fields of the body's file


class ButtonConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings in the `button` part of a deployment file."""

    port: str  # port of the USB-serial adapter: a path, or usb:VID:PID[:SERIAL]

    def __post_init__(self) -> None:
        if not re.fullmatch(r"usb:[0-9a-fA-F]+:[0-9a-fA-F]+(:.*)?|(?!usb:).*\S.*", self.port):
            raise ValueError(f"port: expected a path, or usb:VID:PID[:SERIAL], got {self.port!r}")


class PageConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings in the `page` part of a deployment file."""

    listen: str = "127.0.0.1"  # address of this host; TLS and login are required beyond loopback
    port: Annotated[int, Meta(ge=0, le=65535)] = 8080
    names: tuple[str, ...] = ()  # host names that browsers may use, besides `listen`
    certificate: str = ""  # a PEM file
    certificate_key: str = ""
    login: bool = False  # require a token on loopback as well
    tokens: str = ""  # file of the tokens; empty: one in the user's state folder
    tell_tokens: bool = False  # print new tokens, for a person at a terminal


class FoxgloveConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings in the `foxglove` part of a deployment file."""

    port: Annotated[int, Meta(ge=0, le=65535)] = 8765  # on loopback
    origins: tuple[str, ...] = ()  # web viewers that may connect, besides the built-in ones
    secret: str = ""  # file of the secret for steering; empty: one in the user's state folder


class EmulatorConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the emulator process."""

    body: str
    world: str = "arena"
    seed: Seed = 0
    folder: str  # folder where its ports appear
    checkpoint: str = ""  # path of its checkpoints in this run; empty: none
    cameras: bool = False  # send the emulated world as often as the cameras need it
    robot: dict[str, Any] = {}  # replaces fields of the body's file


class CameraConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the camera process."""

    body: str
    link: LinkName = "sim"
    seed: Seed = 0  # of the cameras' errors in the simulation
    errors: bool = True  # rendered pictures have noise, holes and mounting errors of a sensor
    robot: dict[str, Any] = {}  # replaces fields of the body's file


class RecognizerConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings in the `recognizer` part of a deployment file: the net that recognises things."""

    onnx: str = ""  # file of the user's own net; empty: the shipped one
    labels: str = ""  # file with one class per line, in the order of the net's outputs
    layout: Literal["things", "yolo", "detr"] = "things"  # format of the net's outputs
    min_confidence: Annotated[float, Meta(ge=0.01, le=0.99)] = 0.4
    rate_hz: Annotated[float, Meta(ge=0.1, le=60)] = 5.0  # maximum for each camera


TagSize = Annotated[float, Meta(ge=0.005, le=10.0)]  # [m], side of the black square
TagNumber = Annotated[str, Meta(pattern=r"^\d{1,6}$")]


class TagConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings in the `tags` part of a deployment file: AprilTags to detect."""

    family: Literal["36h11", "36h10", "25h9", "16h5"] = "36h11"
    size: TagSize = 0.16  # [m]
    sizes: dict[TagNumber, TagSize] = {}  # [m], of tags with another size, by number


class RecognitionConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the recognition process."""

    recognizer: RecognizerConfig = RecognizerConfig()
    tags: TagConfig = TagConfig()


class RecorderConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings in the `recorder` part of a deployment file."""

    folder: str = ""  # folder of the recordings; empty: the user's state folder
    file: str = ""  # name of a single file, instead of `folder`
    topics: tuple[str, ...] = ()  # names or key expressions; empty: all
    pictures: Annotated[float, Meta(ge=0, le=120)] | None = None
    # [Hz], rate of pictures and depth of each camera; 0: none; null: all
    viewers: bool = True  # also record the messages that Foxglove, Lichtblick and Rerun draw
    split_mb: Annotated[float, Meta(gt=0)] | None = None  # start a new file after this size [MB]
    split_s: Annotated[float, Meta(gt=0)] | None = None  # or after this time [s]
    flush_s: Annotated[float, Meta(gt=0, le=10)] = 0.25  # [s], maximum loss in a crash
    queue_mb: Annotated[float, Meta(gt=0)] = 32  # [MB], queue for a slow disk; then messages drop
    keep_free_mb: Annotated[float, Meta(ge=0)] = 200  # disk space left for other uses [MB]
    notes: dict[str, str] = {}  # stored in the file, for replay


RosName = Annotated[str, Meta(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}$")]
RosNamespace = Annotated[
    str, Meta(pattern=r"^/([A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*)?$")
]


class Ros2Link(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings with which a process joins ROS 2 as a node."""

    transport: Literal["rmw_zenoh", "dds"] = "rmw_zenoh"
    domain: Annotated[int, Meta(ge=0, le=232)] = 0  # ROS_DOMAIN_ID of the other nodes
    namespace: RosNamespace = "/"  # of the node, and of topics without a leading slash
    node: RosName = "gigabrain"  # name of the node
    router: str = ""  # Zenoh endpoint of a ROS router; empty: the deployment's own router
    distro: Literal["humble", "iron", "jazzy", "kilted", "rolling"] = "jazzy"  # of the other nodes
    localhost: bool = False  # DDS connects only to nodes on this host
    types: tuple[str, ...] = ()  # further .msg, .srv and .action files, or folders of them


DRIVER_NODE = "gigabrain_driver"  # name of the node of a driver whose body is a ROS 2 robot
FREE_FLEET = ("tf", "battery_state", "navigate_to_pose")  # topics and actions that it uses


class Ros2Config(Ros2Link, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings in the `ros2` part of a deployment file: the gateway to ROS 2."""

    take: bool = False  # take the body from another commander with the first command
    cmd_vel_timeout: Annotated[float, Meta(gt=0, le=0.2)] = 0.2  # [s], a command stays valid
    leave_out: tuple[str, ...] = ()  # ROS topics and services not to offer
    free_fleet: bool = False  # also offer topics and actions for Open-RMF's free_fleet adapter

    def __post_init__(self) -> None:
        for name in self.leave_out:
            if self.free_fleet and name.strip("/") in FREE_FLEET:
                raise ValueError(f"leave_out: free_fleet needs {name}; remove it from this list")


OwnName = Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]{0,31}$")]
ModuleName = Annotated[str, Meta(pattern=r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*(:[A-Za-z_]\w*)?$")]


class OwnProcess(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One entry of `processes` in a deployment file: one of the user's own processes."""

    module: ModuleName  # with a coroutine `run(config, bus, ready)`, or MODULE:COROUTINE
    settings: dict[str, Any] = {}  # of the module; see its Config
    writes: tuple[str, ...] = ()  # keys that it may publish, ask or serve at a router with keys


class OwnPerceptor(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One entry of `perceptors` in a deployment file: a perception step in its own process."""

    perceptor: str = ""  # offered by an installed package; empty: the name of the entry
    settings: dict[str, Any] = {}  # of the perceptor; see its Config


class ProcessConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Complete configuration of one process."""

    name: str
    endpoint: Endpoint
    settings: dict[str, Any] = field(default_factory=dict)
    run_dir: str | None = None  # folder of its log file; without it there is no log file
    json_console: bool = False  # JSON log lines on the console, for a supervisor to read
    level: str = "info"
    module: str = ""  # of one of the user's own processes; empty: a row of the process table
    perceptor: str = ""  # name of one of the user's own perceptors
    file: str = ""  # deployment file with the settings of either, for errors
