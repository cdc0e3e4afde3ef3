"""The one table of topics. Adding a topic means adding a line here, and nowhere else."""

from dataclasses import dataclass, replace
from typing import Any, Generic, Literal, TypeVar

from gigabrain_schemas import audit, body, brain, input_log, requests, safety, sensors, tasks
from gigabrain_schemas.base import Message

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)

KB = 1024
Priority = Literal["real_time", "interactive_high", "data_high", "data", "background"]


@dataclass(frozen=True, slots=True)
class Topic(Generic[M]):
    """A named stream of one message type at a promised rate."""

    key: str  # Zenoh key expression, below the robot's namespace
    type: type[M]
    hz: float  # promised rate, which decides how long a value counts
    missed: float = 5.0  # periods without a message after which the last one no longer counts
    echo_ns: int = 0  # age up to which a tick may be echoed, where the way is longer than `missed`
    priority: Priority = "data"
    congestion: Literal["drop", "block"] = "drop"
    express: bool = False  # not batched: for small messages that must not wait
    keep: bool = False  # the last value is kept for those who join late
    depth: int = 1  # messages that wait for a busy reader; the oldest give way
    max_bytes: int = 4 * KB  # larger ones are not even decoded
    many: bool = False  # one key per camera or process below this one

    @property
    def stale_after_ns(self) -> int:
        """Age from which the newest message no longer counts [ns]."""
        return round(self.missed / self.hz * 1e9)

    def at(self, name: str = "") -> str:
        """The key of this topic; of the camera or process `name` where there are many."""
        return f"{self.key}/{name}" if self.many else self.key


@dataclass(frozen=True, slots=True)
class Service(Generic[Q, R]):
    """A named question and its answer."""

    key: str
    request: type[Q]
    reply: type[R]
    priority: Priority = "interactive_high"
    max_bytes: int = 64 * KB  # of the request and of each reply; larger ones are not even decoded
    many: bool = False  # one key per process below this one

    def at(self, name: str = "") -> str:
        """The key of this service; at the process `name` where there are many."""
        return f"{self.key}/{name}" if self.many else self.key


SCAN = Topic("robot/scan", sensors.LaserScan, 10, missed=2.5, max_bytes=64 * KB)
IMU = Topic("robot/imu", sensors.Imu, 100)
STATE = Topic(
    "robot/state", body.RobotState, 50, missed=12.5, keep=True,
    max_bytes=32 * KB,
)  # fmt: skip
BODY = Topic("robot/body", body.Body, 1, keep=True, max_bytes=16 * KB)
IMAGE = Topic("robot/image", sensors.Image, 10, max_bytes=1024 * KB, many=True, depth=8)
WORLD = Topic("robot/world", brain.WorldModel, 10, missed=2.5, max_bytes=64 * KB)
POSE = Topic("robot/pose", brain.PoseInMap, 10)
MAP = Topic("robot/map", brain.OccupancyGrid, 1, keep=True, max_bytes=8 * 1024 * KB)
INTENT = Topic("robot/intent", brain.Intent, 50, echo_ns=150_000_000, max_bytes=16 * KB)
TELEOP = Topic("robot/teleop", brain.Twist, 20, priority="interactive_high", max_bytes=KB)
CMD_VEL = Topic(
    "robot/cmd_vel", brain.CmdVel, 50, priority="interactive_high", depth=16, max_bytes=KB
)
JOINT_CMD = Topic("robot/joint_cmd", brain.JointCommand, 50, priority="interactive_high", depth=16)
SAFETY = Topic(
    "robot/safety", safety.SafetyState, 20, missed=3, priority="interactive_high",
    max_bytes=16 * KB,
)  # fmt: skip
HEALTH = Topic(
    "robot/health", safety.Health, 1, priority="background", many=True, depth=32, max_bytes=16 * KB
)
LOG = Topic("robot/log", safety.LogRecord, 10, priority="background", depth=256, max_bytes=16 * KB)
# real_time is for what stops the robot, and for nothing that anybody could send by the thousand
BUTTON = Topic(
    "robot/button", safety.ButtonState, 20, missed=4, priority="real_time", express=True,
    max_bytes=KB,
)  # fmt: skip
TASK = Topic("robot/task", tasks.TaskStatus, 5, keep=True, max_bytes=64 * KB)
REQUEST_LOG = Topic(
    "robot/request_log", input_log.AcceptedRequest, 10, depth=256, max_bytes=128 * KB
)
INPUT_LOG = Topic(
    "robot/input_log",
    input_log.InputLog,
    2,
    priority="background",
    many=True,
    depth=32,
    max_bytes=64 * KB,
)
AUDIT = Topic("robot/audit", audit.AuditRecord, 10, depth=256)


def command_topic(of: body.BodyDescription) -> Topic[brain.CmdVel]:
    """The topic that a body obeys: CMD_VEL, unless its file says otherwise."""
    return CMD_VEL if of.control_topic == CMD_VEL.key else replace(CMD_VEL, key=of.control_topic)


TOPICS: tuple[Topic[Any], ...] = (
    SCAN, IMU, STATE, BODY, IMAGE, WORLD, POSE, MAP, INTENT, TELEOP, CMD_VEL, JOINT_CMD, SAFETY,
    BUTTON, HEALTH, LOG, TASK, REQUEST_LOG, INPUT_LOG, AUDIT,
)  # fmt: skip

OLD_KEYS = {"robot/heard": INPUT_LOG.key, "robot/granted": REQUEST_LOG.key}  # until release 0.3


def current_key(key: str) -> str:
    """Return the present key for one that a recording of an older release holds."""
    start, _, rest = key.removeprefix("robot/").partition("/")
    new = OLD_KEYS.get(f"robot/{start}")
    return f"{new}/{rest}" if new and rest else new or key


ESTOP = Service("robot/estop", requests.EstopRequest, requests.GateReply, priority="real_time")
# for clients that can say, but not ask: it stops just the same, and nothing is confirmed
ESTOP_SAID = Topic(
    ESTOP.key, requests.EstopRequest, 10, priority="real_time", congestion="block", express=True,
    depth=16, max_bytes=KB,
)  # fmt: skip
RELEASE = Service("robot/release", requests.ReleaseRequest, requests.GateReply)
ENABLE = Service("robot/enable", requests.EnableRequest, requests.GateReply)
GOAL = Service("robot/goal", tasks.GoalRequest, tasks.GoalReply)
MISSION = Service("robot/mission", tasks.MissionRequest, tasks.MissionReply)
TASK_CHANGE = Service("robot/task_change", tasks.TaskRequest, tasks.TaskReply)
MAP_SAVE = Service("robot/map_save", requests.MapRequest, requests.MapReply)
AUDIT_LOG = Service(
    "robot/audit_log", audit.AuditRequest, audit.AuditPage, priority="background",
    max_bytes=1024 * KB,
)  # fmt: skip
PARAM = Service("robot/param", requests.ParamRequest, requests.ParamReply, many=True)
DESCRIBE = Service("robot/describe", requests.DescribeRequest, requests.Description, many=True)

SERVICES: tuple[Service[Any, Any], ...] = (
    ESTOP,
    RELEASE,
    ENABLE,
    GOAL,
    MISSION,
    TASK_CHANGE,
    MAP_SAVE,
    AUDIT_LOG,
    PARAM,
    DESCRIBE,
)


def messages() -> tuple[type[Message], ...]:
    """Every message type that a topic or a service carries, once."""
    asked = (side for service in SERVICES for side in (service.request, service.reply))
    return tuple(dict.fromkeys((*(topic.type for topic in TOPICS), *asked)))
