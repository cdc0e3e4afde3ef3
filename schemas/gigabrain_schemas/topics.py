"""The one table of topics and services: type, rate, limits, rights and drawing of each.

A new topic needs a line here, and an example of its message in the folder `golden`.
"""

from dataclasses import dataclass, replace
from typing import Any, Generic, Literal, TypeVar

from gigabrain_schemas import (
    body,
    brain,
    logs,
    objects,
    requests,
    safety,
    sensors,
    sim,
    tasks,
    vision,
    zones,
)
from gigabrain_schemas.base import Message

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)

KB = 1024
Priority = Literal["real_time", "interactive_high", "data_high", "data", "background"]
Role = Literal[  # of an identity
    "robot", "brain", "operator", "viewer", "dispatcher", "router", "process",
]  # fmt: skip
# How viewers show a topic; `recording/drawing.py` has a function for each.
Drawing = Literal[
    "scan", "map", "zones", "pose", "path", "obstacles", "task", "image", "log", "odometry",
    "lidar_frame", "arm_model", "depth", "camera", "detections", "objects", "solids", "perceived",
    "arm_plan",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Topic(Generic[M]):
    """A named stream of one message type at a promised rate."""

    key: str  # Zenoh key expression, below the robot's namespace
    type: type[M]
    hz: float  # promised rate, which decides how long a value is fresh
    missed: float = 5.0  # periods until the last message is stale
    echo_ns: int = 0  # maximum age of an echoed tick, if longer than `missed` allows
    priority: Priority = "data"
    congestion: Literal["drop", "block"] = "drop"
    express: bool = False  # not batched: for small messages that must not wait
    keep: bool = False  # the last value is kept for late joiners
    depth: int = 1  # messages per key that wait for a busy reader; then the oldest are dropped
    max_bytes: int = 4 * KB  # larger messages are not decoded
    many: bool = False  # one key per camera or process below this one
    publishers: tuple[Role, ...] = ()  # roles that may publish it, besides the robot itself
    drawing: Drawing | None = None
    plotted: bool = False  # viewers plot its numbers

    @property
    def stale_after_ns(self) -> int:
        """Return the age from which the newest message is stale [ns]."""
        return round(self.missed / self.hz * 1e9)

    def at(self, name: str = "") -> str:
        """Return the key of this topic; with `many`, for the camera or process `name`."""
        return f"{self.key}/{name}" if self.many else self.key


@dataclass(frozen=True, slots=True)
class Service(Generic[Q, R]):
    """A named request and its reply."""

    key: str
    request: type[Q]
    reply: type[R]
    priority: Priority = "interactive_high"
    max_bytes: int = 64 * KB  # of the request and of each reply; larger ones are not decoded
    many: bool = False  # one key per process below this one
    callers: tuple[Role, ...] = ()  # roles that may call it, besides the robot itself
    servers: tuple[Role, ...] = ()  # roles that may answer it, besides the robot itself

    def at(self, name: str = "") -> str:
        """Return the key of this service; with `many`, for the process `name`."""
        return f"{self.key}/{name}" if self.many else self.key


BRAIN: tuple[Role, ...] = ("brain",)
OPERATOR: tuple[Role, ...] = ("operator",)
BOTH: tuple[Role, ...] = ("brain", "operator")
ALL: tuple[Role, ...] = ("brain", "operator", "viewer")

SCAN = Topic(
    "robot/scan", sensors.LaserScan, 10, missed=2.5, max_bytes=64 * KB, drawing="scan",
)  # fmt: skip
IMU = Topic("robot/imu", sensors.Imu, 100, depth=8)  # none is lost: it may show a shock
STATE = Topic(
    "robot/state", body.RobotState, 50, missed=12.5, keep=True, max_bytes=32 * KB,
    drawing="odometry", plotted=True,
)  # fmt: skip
BODY = Topic("robot/body", body.Body, 1, keep=True, max_bytes=16 * KB, drawing="lidar_frame")
ARM_MODEL = Topic(
    "robot/arm_model", body.ArmModel, 1, keep=True, max_bytes=512 * KB, priority="background",
    drawing="arm_model",
)  # fmt: skip
IMAGE = Topic(
    "robot/image", sensors.Image, 10, max_bytes=1024 * KB, many=True, depth=8, drawing="image",
)  # fmt: skip
DEPTH = Topic(
    "robot/depth", vision.DepthImage, 10, missed=2.5, max_bytes=1024 * KB, many=True, depth=2,
    drawing="depth",
)  # fmt: skip
CAMERA = Topic(
    "robot/camera", vision.CameraInfo, 1, keep=True, max_bytes=4 * KB, many=True, drawing="camera",
)  # fmt: skip
WORLD = Topic(
    "robot/world", brain.WorldModel, 10, missed=2.5, max_bytes=64 * KB,
    publishers=BRAIN, drawing="obstacles", plotted=True,
)  # fmt: skip
PERCEIVED = Topic(
    "robot/perceived", brain.Objects, 10, missed=5.0, max_bytes=64 * KB, many=True,
    publishers=BRAIN, drawing="perceived",
)  # fmt: skip
DETECTIONS = Topic(
    "robot/detections", objects.Detections, 5, depth=8, max_bytes=64 * KB, publishers=BRAIN,
    drawing="detections",
)  # fmt: skip
LABELS = Topic(
    "robot/labels", objects.Labels, 1, keep=True, max_bytes=1024 * KB, many=True,
    publishers=BRAIN, priority="background",
)  # fmt: skip
OBJECT_MAP = Topic(
    "robot/objects", objects.ObjectMap, 1, keep=True, max_bytes=128 * KB, publishers=BRAIN,
    drawing="objects",
)  # fmt: skip
SOLIDS = Topic(
    "robot/solids", objects.Solids, 5, missed=10.0, max_bytes=32 * KB, publishers=BRAIN,
    drawing="solids",
)  # fmt: skip
POSE = Topic("robot/pose", brain.PoseInMap, 10, publishers=BRAIN, drawing="pose")
MAP = Topic(
    "robot/map", brain.OccupancyGrid, 1, keep=True, max_bytes=8 * 1024 * KB,
    publishers=BRAIN, drawing="map",
)  # fmt: skip
ZONES = Topic(
    "robot/zones", zones.Zones, 0.5, keep=True, max_bytes=256 * KB,
    publishers=BRAIN, drawing="zones",
)  # fmt: skip
INTENT = Topic(
    "robot/intent", brain.Intent, 50, echo_ns=150_000_000, max_bytes=16 * KB,
    publishers=BRAIN, drawing="path", plotted=True,
)  # fmt: skip
ARM_PLAN = Topic(
    "robot/arm_plan", brain.ArmPlan, 1, keep=True, max_bytes=16 * KB, priority="background",
    publishers=BRAIN, drawing="arm_plan",
)  # fmt: skip
TELEOP = Topic(
    "robot/teleop", brain.Twist, 20, priority="interactive_high", max_bytes=KB,
    publishers=OPERATOR,
)  # fmt: skip
JOINT_TELEOP = Topic(
    "robot/joint_teleop", brain.JointSpeeds, 20, priority="interactive_high",
    publishers=OPERATOR,
)  # fmt: skip
CMD_VEL = Topic(
    "robot/cmd_vel", brain.CmdVel, 50, priority="interactive_high", depth=16, max_bytes=KB,
    publishers=OPERATOR, plotted=True,
)  # fmt: skip
JOINT_CMD = Topic(
    "robot/joint_cmd", brain.JointCommand, 50, priority="interactive_high", depth=16,
    publishers=OPERATOR,
)  # fmt: skip
SAFETY = Topic(
    "robot/safety", safety.SafetyState, 20, missed=3, priority="interactive_high",
    max_bytes=16 * KB, plotted=True,
)  # fmt: skip
# real_time is for messages that stop the robot, and not for those that a client may send in masses
BUTTON = Topic(
    "robot/button", safety.ButtonState, 20, missed=4, priority="real_time", express=True,
    max_bytes=KB, publishers=OPERATOR,
)  # fmt: skip
HEALTH = Topic(
    "robot/health", safety.Health, 1, priority="background", many=True, depth=32,
    max_bytes=16 * KB, publishers=BOTH,
)  # fmt: skip
LOG = Topic(
    "robot/log", safety.LogRecord, 10, priority="background", depth=256, max_bytes=16 * KB,
    publishers=BOTH, drawing="log",
)  # fmt: skip
TASK = Topic(
    "robot/task", tasks.TaskStatus, 5, keep=True, max_bytes=64 * KB,
    publishers=BRAIN, drawing="task",
)  # fmt: skip
REQUEST_LOG = Topic(
    "robot/request_log", logs.AcceptedRequest, 10, depth=256, max_bytes=128 * KB,
    publishers=BRAIN,
)  # fmt: skip
INPUT_LOG = Topic(
    "robot/input_log", logs.InputLog, 2, priority="background", many=True, depth=32,
    max_bytes=64 * KB, publishers=BRAIN,
)  # fmt: skip
SIM_SCENE = Topic(
    "robot/sim_scene", sim.SimScene, 1, priority="background", keep=True, max_bytes=8 * 1024 * KB,
)  # fmt: skip
SIM_POSES = Topic("robot/sim_poses", sim.SimPoses, 10, max_bytes=32 * KB)
AUDIT = Topic("robot/audit", logs.AuditRecord, 10, depth=256)
TOPICS: tuple[Topic[Any], ...] = tuple(one for one in globals().values() if isinstance(one, Topic))


def command_topic(of: body.BodyDescription) -> Topic[brain.CmdVel]:
    """Return the topic that a body obeys: CMD_VEL, unless its file names another."""
    return CMD_VEL if of.control_topic == CMD_VEL.key else replace(CMD_VEL, key=of.control_topic)


OLD_KEYS = {"robot/heard": INPUT_LOG.key, "robot/granted": REQUEST_LOG.key}  # until release 0.3


def current_key(key: str) -> str:
    """Return the present key for a `key` in a recording of an older release."""
    start, _, rest = key.removeprefix("robot/").partition("/")
    new = OLD_KEYS.get(f"robot/{start}")
    return f"{new}/{rest}" if new and rest else new or key


ESTOP = Service(
    "robot/estop", requests.EstopRequest, requests.GateReply, priority="real_time", callers=BOTH,
)  # fmt: skip
# for clients that can publish but not query: it also stops the robot, without a reply
ESTOP_TOPIC = Topic(
    ESTOP.key, requests.EstopRequest, 10, priority="real_time", congestion="block", express=True,
    depth=16, max_bytes=KB, publishers=BOTH,
)  # fmt: skip
RELEASE = Service("robot/release", requests.ReleaseRequest, requests.GateReply, callers=OPERATOR)
ENABLE = Service("robot/enable", requests.EnableRequest, requests.GateReply, callers=OPERATOR)
LIMP = Service("robot/limp", requests.LimpRequest, requests.GateReply, callers=OPERATOR)
GOAL = Service("robot/goal", tasks.GoalRequest, tasks.GoalReply, callers=OPERATOR, servers=BRAIN)
MISSION = Service(
    "robot/mission", tasks.MissionRequest, tasks.MissionReply, callers=OPERATOR, servers=BRAIN,
)  # fmt: skip
TASK_CHANGE = Service(
    "robot/task_change", tasks.TaskRequest, tasks.TaskReply, callers=OPERATOR, servers=BRAIN,
)  # fmt: skip
MAP_SAVE = Service(
    "robot/map_save", requests.MapRequest, requests.MapReply, callers=OPERATOR, servers=BRAIN,
)  # fmt: skip
SIM_CHANGE = Service("robot/sim_change", sim.SimRequest, sim.SimReply, callers=OPERATOR)
MAP_LOAD = Service(
    "robot/map_load", zones.MapLoadRequest, requests.MapReply, callers=OPERATOR, servers=BRAIN,
)  # fmt: skip
MAP_LIST = Service(
    "robot/map_list", zones.MapListRequest, zones.MapListReply, max_bytes=256 * KB,
    callers=("operator", "viewer"), servers=BRAIN,
)  # fmt: skip
ZONES_CHANGE = Service(
    "robot/zones_change", zones.ZonesRequest, zones.ZonesReply, callers=OPERATOR, servers=BRAIN,
)  # fmt: skip
POSE_SET = Service(
    "robot/pose_set", requests.PoseRequest, requests.PoseReply, callers=OPERATOR, servers=BRAIN,
)  # fmt: skip
OBJECTS_CHANGE = Service(
    "robot/objects_change", objects.ObjectsRequest, objects.ObjectsReply,
    callers=OPERATOR, servers=BRAIN,
)  # fmt: skip
AUDIT_LOG = Service(
    "robot/audit_log", logs.AuditRequest, logs.AuditPage, priority="background",
    max_bytes=1024 * KB, callers=("operator", "viewer"),
)  # fmt: skip
PARAM = Service(
    "robot/param", requests.ParamRequest, requests.ParamReply, many=True,
    callers=OPERATOR, servers=BOTH,
)  # fmt: skip
DESCRIBE = Service(
    "robot/describe", requests.DescribeRequest, requests.Description, many=True,
    callers=ALL, servers=BOTH,
)  # fmt: skip
SERVICES: tuple[Service[Any, Any], ...] = tuple(
    one for one in globals().values() if isinstance(one, Service)
)


def messages() -> tuple[type[Message], ...]:
    """Return the message types of all topics and services, each once."""
    asked = (side for service in SERVICES for side in (service.request, service.reply))
    return tuple(dict.fromkeys((*(topic.type for topic in TOPICS), *asked)))
