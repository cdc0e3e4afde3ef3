"""What the page's server and a browser say to one another: frames that begin with their kind."""

import struct
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct

from gigabrain_schemas.base import Count, Finite, Pose, Text, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import Intent, OccupancyGrid, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.sensors import Image, LaserScan
from gigabrain_schemas.tasks import GoalRequest
from gigabrain_zenoh.codec import DECODE_ERRORS

ABOUT, MOMENT, SCAN, MAP, HEALTH, LOG, REPLY, IMAGE, TASK = range(1, 10)  # to the browser
LOGIN, DRIVE, ASK = range(1, 4)  # from it

T = TypeVar("T")


class About(Struct, frozen=True, kw_only=True):
    """Said once the body is known, and again when it changes."""

    role: str
    viewer: int  # the number of this viewer
    version: str
    body: BodyDescription | None = None
    link: str = ""


class Moment(Struct, frozen=True, kw_only=True):
    """How the robot is now; None for what is not fresh."""

    state: RobotState | None
    pose: Pose | None  # in the map where there is one, else by odometry
    frame: Literal["map", "odom"]
    intent: Intent | None
    safety: SafetyState | None
    world: WorldModel | None
    driving: int = 0  # the number of the viewer who steers
    viewers: int = 1


class Login(Struct, frozen=True, forbid_unknown_fields=True):
    """The first thing that a browser says."""

    token: Annotated[str, Meta(max_length=128)] = ""


class Ask(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Something is asked of the robot."""

    id: Annotated[int, Meta(ge=0, le=2**31)]
    what: Literal["estop", "release", "enable", "take", "goal", "cancel"]
    estop_generation: Count = 0  # as the page shows it, so that nobody releases a stop unseen
    goal: GoalRequest | None = None


class Reply(Struct, frozen=True, kw_only=True):
    """What became of it."""

    id: int
    what: str
    ok: bool
    text: Text
    robot: str = ""  # who confirmed it
    took_ms: float = 0.0


def as_json(kind: int, content: Any) -> bytes:
    """A frame of one byte and JSON."""
    return bytes((kind,)) + msgspec.json.encode(content)


def scan_frame(scan: LaserScan, body: BodyDescription, pose: Pose) -> bytes:
    """A scan, and where the robot was: 4 + 9 · 4 bytes, then the ranges as float32.

    x, y, yaw of the robot, x, y, yaw of the lidar on it, first angle, increment, longest range.
    """
    lidar = body.lidar
    mount = (lidar.x, lidar.y, lidar.yaw) if lidar else (0.0, 0.0, 0.0)
    head = struct.pack(
        "<4B9f", SCAN, 0, 0, 0, pose.x, pose.y, pose.yaw, *mount,
        scan.angle_min, scan.angle_increment, scan.range_max,
    )  # fmt: skip
    return head + scan.ranges


def map_frame(grid: OccupancyGrid) -> bytes:
    """A map: 4 bytes, resolution, origin, width and height, then the cells."""
    origin = grid.origin_x, grid.origin_y
    return (
        struct.pack("<4B3f2I", MAP, 0, 0, 0, grid.resolution, *origin, grid.width, grid.height)
        + grid.cells
    )


def image_frame(camera: str, image: Image) -> bytes:
    """A picture: 4 bytes, width, height, 64 bytes of camera and 16 of encoding, then its data."""
    name, encoding = camera.encode()[:64], image.encoding.encode()
    return (
        struct.pack("<4B2I64s16s", IMAGE, 0, 0, 0, image.width, image.height, name, encoding)
        + image.data
    )


class _Drive(Struct, frozen=True, array_like=True):
    x: Finite
    y: Finite
    z: Finite


def drive_of(content: bytes) -> Velocity:
    """The velocity in a DRIVE frame: three float32 after 3 bytes. Raises ValueError."""
    try:
        values = msgspec.convert(struct.unpack("<3x3f", content), _Drive)
    except (struct.error, msgspec.ValidationError) as error:
        raise ValueError(f"not a velocity: {error}") from None
    return Velocity(linear_x=values.x, linear_y=values.y, angular_z=values.z)


def login_of(content: bytes) -> Login:
    """The login in a LOGIN frame. Raises ValueError."""
    return _decoded(content, Login)


def ask_of(content: bytes) -> Ask:
    """The request in an ASK frame. Raises ValueError."""
    return _decoded(content, Ask)


def _decoded(content: bytes, kind: type[T]) -> T:
    try:
        return msgspec.json.decode(content, type=kind)
    except DECODE_ERRORS as error:
        raise ValueError(str(error)) from None
