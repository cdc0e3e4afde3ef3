"""Frames between the page's server and a browser: a byte for their kind, then JSON or arrays."""

import itertools
import logging
import struct
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from gigabrain_schemas import topics
from gigabrain_schemas.base import Count, Finite, Message, Name, Pose, Text, Velocity
from gigabrain_schemas.body import (
    MAX_ARM_JOINTS,
    ArmModel,
    Body,
    BodyDescription,
    JointSpeed,
    RobotState,
)
from gigabrain_schemas.brain import ArmPlan, Intent, OccupancyGrid, WorldModel
from gigabrain_schemas.requests import Param
from gigabrain_schemas.safety import Health, LogRecord, SafetyState
from gigabrain_schemas.sensors import Image, LaserScan
from gigabrain_schemas.sim import SimPoses, SimRequest, SimScene
from gigabrain_schemas.tasks import GoalRequest
from gigabrain_schemas.zones import SavedMapInfo, Zones, ZonesRequest
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Close
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.config.name_words import plain
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry.link_model import LinkModel
from gigabrain_zenoh.ui.page.arm_scene import ArmScene
from gigabrain_zenoh.ui.page.tool_jog import ToolPlace, tool_place, tool_speeds
from gigabrain_zenoh.ui.steering import ViewerScene

ABOUT, STATE, SCAN, MAP, HEALTH, LOG, REPLY, IMAGE, TASK = range(1, 10)  # to the browser
SCENE, POSES, ZONES = 10, 11, 12
CAMERA, FOUND, CONTOURS, PERCEIVED, OBJECTS, ARM_PLAN = range(13, 19)
LOGIN, DRIVE, ASK, WATCH, SHOWN, JOG = range(1, 7)  # from the browser
ENTERED_FIELDS = ("goal", "world", "zones", "process", "name", "value")  # typed by a person
MAX_KEPT_LOG_LINES = 30  # for viewers that connect later

log = logging.getLogger(__name__)

T = TypeVar("T")
ToolSpeed = Annotated[float, Meta(ge=-2.0, le=2.0)]  # [m/s]


class About(Struct, frozen=True, kw_only=True):
    """Facts about the robot and the viewer; sent at the start and when the body changes."""

    role: str
    viewer: int  # number of this viewer
    version: str
    body: BodyDescription | None = None
    link: str = ""


class StateFrame(Struct, frozen=True, kw_only=True):
    """Present state of the robot; values that are not fresh are None."""

    state: RobotState | None
    pose: Pose | None  # in the map if there is one, else by odometry
    frame: Literal["map", "odom"]
    intent: Intent | None
    safety: SafetyState | None
    world: WorldModel | None
    tool: ToolPlace | None = None  # of an arm
    driving: int = 0  # number of the viewer that steers
    viewers: int = 1


class Login(Struct, frozen=True, forbid_unknown_fields=True):
    """First frame of a browser."""

    token: Annotated[str, Meta(max_length=128)] = ""


class Jog(Struct, frozen=True, forbid_unknown_fields=True):
    """Frame of an operator: speeds of joints while their buttons are held."""

    speeds: Annotated[dict[Name, JointSpeed], Meta(max_length=MAX_ARM_JOINTS)] = {}
    # [rad/s or m/s]
    tool: tuple[ToolSpeed, ToolSpeed, ToolSpeed] | None = None
    # [m/s], of the arm's tool, along x, y and z of the base


class PageRequest(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Request to the robot."""

    id: Annotated[int, Meta(ge=0, le=2**31)]
    what: Literal[
        "estop", "release", "enable", "take", "goal", "cancel", "settings", "set", "world",
        "zones", "maps", "map_save", "map_load", "hold", "limp",
    ]  # fmt: skip
    estop_generation: Count = 0  # the one that the page shows, so that no newer one is released
    goal: GoalRequest | None = None
    world: SimRequest | None = None
    zones: ZonesRequest | None = None
    process: Name = ""  # of a setting
    name: Name = ""  # of a setting, or of a map
    value: Text = ""  # of a setting; "yes" where a person has agreed that an arm may fall


class Setting(Struct, frozen=True, kw_only=True):
    """A parameter of a running process that a settings file may keep."""

    process: str
    param: Param


class PageReply(Struct, frozen=True, kw_only=True):
    """Result of a request."""

    id: int
    what: str
    ok: bool
    text: Text
    robot: str = ""  # type of the robot that confirmed it
    settings: tuple[Setting, ...] = ()  # of the robot; answers `settings`
    maps: tuple[SavedMapInfo, ...] = ()  # answers `maps`
    not_confirmed: bool = False  # an e-stop without confirmation; the text gives the remedy


def as_json(kind: int, content: Any) -> bytes:
    """Return a frame of JSON."""
    return bytes((kind,)) + msgspec.json.encode(content)


def scan_frame(scan: LaserScan, body: BodyDescription, pose: Pose) -> bytes:
    """Return a scan and the robot's pose: 4 + 9 · 4 bytes, then the ranges as float32.

    x, y, yaw of the robot, x, y, yaw of the lidar on it, first angle, increment, greatest range.
    """
    lidar = body.lidar
    mount = (lidar.x, lidar.y, lidar.yaw) if lidar else (0.0, 0.0, 0.0)
    head = struct.pack(
        "<4B9f", SCAN, 0, 0, 0, pose.x, pose.y, pose.yaw, *mount,
        scan.angle_min, scan.angle_increment, scan.range_max,
    )  # fmt: skip
    return head + scan.ranges


def map_frame(grid: OccupancyGrid) -> bytes:
    """Return a map: 4 bytes, resolution, origin, width and height, then the cells."""
    origin = grid.origin_x, grid.origin_y
    head = struct.pack("<4B3f2I", MAP, 0, 0, 0, grid.resolution, *origin, grid.width, grid.height)
    return head + grid.cells


def image_frame(camera: str, image: Image) -> bytes:
    """Return an image: 4 bytes, width, height, camera (64 bytes), encoding (16), then the data."""
    texts = camera.encode()[:64], image.encoding.encode()
    head = struct.pack("<4B2I64s16s", IMAGE, 0, 0, 0, image.width, image.height, *texts)
    return head + image.data


def poses_frame(poses: SimPoses) -> bytes:
    """Return the poses of a scene's bodies: 4 bytes, the scene's version, then float32."""
    return struct.pack("<4BI", POSES, 0, 0, 0, poses.version % 2**32) + poses.poses


class _Drive(Struct, frozen=True, array_like=True):
    x: Finite
    y: Finite
    z: Finite


def drive_of(content: bytes) -> Velocity:
    """Return the velocity in a DRIVE frame: three float32 after 3 bytes. Raises ValueError."""
    try:
        values = msgspec.convert(struct.unpack("<3x3f", content), _Drive)
    except (struct.error, msgspec.ValidationError) as error:
        raise ValueError(f"not a velocity: {error}") from None
    return Velocity(linear_x=values.x, linear_y=values.y, angular_z=values.z)


def decoded(content: bytes, kind: type[T]) -> T:
    """Decode the JSON of a frame as `kind`. Raises ValueError."""
    try:
        return msgspec.json.decode(content, type=kind)
    except DECODE_ERRORS as error:
        raise ValueError(str(error)) from None


def request_of(content: bytes) -> PageRequest | PageReply:
    """Return the request in a frame, or its refusal if a person entered a wrong value.

    Raises ValueError for a frame that the page never sends.
    """
    try:
        return decoded(content, PageRequest)
    except ValueError as error:
        fields = decoded(content, dict[str, Any])
        checked = {name: value for name, value in fields.items() if name not in ENTERED_FIELDS}
        request = decoded(msgspec.json.encode(checked), PageRequest)
        return PageReply(id=request.id, what=request.what, ok=False, text=plain(error))


class PageView(ViewerScene):
    """Newest messages of a robot as frames. `send` passes a frame and its slot to all viewers."""

    def __init__(
        self,
        bus: Bus,
        send: Callable[[str, bytes], None],
        on_body: Callable[[], None] = lambda: None,
    ) -> None:
        self._send, self._on_body = send, on_body
        self._kept: dict[str, bytes] = {}  # map, task, objects and scene, by slot
        self._log_lines: list[bytes] = []
        self._described: BodyDescription | None = None
        self._numbers = itertools.count()
        self._zones = Zones()
        super().__init__(bus)
        bus.latest(topics.ZONES, self._on_zones)
        bus.latest(topics.OBJECT_MAP, lambda one: self._keep("objects", as_json(OBJECTS, one)))
        self.newest_of(topics.SIM_POSES)
        self._links: LinkModel | None = None  # of an arm
        self._arm: ArmScene | None = None  # if no simulation publishes its world
        self._arm_models = bus.latest(topics.ARM_MODEL, self._on_arm_model)
        self._scenes = bus.latest(topics.SIM_SCENE, self._on_scene)
        self._end_plans: Close | None = None

    def watch_plans(self, on: bool) -> None:
        """Start or stop receiving an arm's plans; they are computed only for subscribers."""
        if on and self._end_plans is None:
            self._end_plans = self.bus.subscribe(topics.ARM_PLAN, self._on_plan)
        elif not on and self._end_plans:
            self._end_plans()
            self._end_plans = None

    def state_frame(self, driving: int, viewers: int) -> bytes:
        """Return the present state of the robot."""
        state = self.state.fresh()
        pose, in_map = self._newest_pose(state)
        world, tool = self.world.fresh(), None
        if state and self.body and self._links:
            tool = tool_place(self._links, self.body.description, state)
        content = StateFrame(
            state=state,
            pose=pose,
            frame="map" if in_map else "odom",
            intent=self.intent.fresh(),
            safety=self.safety.fresh(),
            world=world and replace(world, hits=b"", contours=()),  # drawn by frames of their own
            tool=tool and tuple(round(value, 6) for value in tool),  # type: ignore[arg-type]
            driving=driving,
            viewers=viewers,
        )
        return as_json(STATE, content)

    def new_frames(self) -> Iterator[tuple[str, bytes]]:
        """Yield scan and poses received since the last call, with their slots."""
        pose, _ = self._newest_pose(self.state.fresh())
        scan: LaserScan | None = self.sampled[topics.SCAN].poll()
        if scan and pose and self.body:
            yield "scan", scan_frame(scan, self.body.description, pose)
        if poses := self.sampled[topics.SIM_POSES].poll():
            yield "poses", poses_frame(poses)
        elif self._arm and pose and (state := self.state.fresh()):
            yield "poses", poses_frame(self._arm.poses(state, pose))

    def kept_frames(self) -> Iterator[tuple[str, bytes]]:
        """Yield the frames for a new viewer: map, task, health and log."""
        yield from self._kept.items()
        yield from ((f"health/{name}", as_json(HEALTH, one)) for name, one in self.health.items())
        yield from ((f"log/{next(self._numbers)}", frame) for frame in self._log_lines)

    def joint_speeds(self, jog: Jog) -> dict[str, float]:
        """Return the joint speeds [rad/s or m/s] that a browser's frame commands."""
        state = self.state.fresh()
        if jog.tool is None or self._links is None or self.body is None or state is None:
            return jog.speeds
        return tool_speeds(self._links, self.body.description, state, jog.tool) | jog.speeds

    def hold_joints(self) -> bool:
        """Take the joints from the brain, so that control holds them; return whether it had them.

        Control holds them until the gate is enabled again.
        """
        state = self.state.fresh()
        joints = self.body.description.joints if self.body else ()
        brain_drives = state and state.gate.mode == "enabled" and state.gate.commander == BRAIN
        if not brain_drives or not joints:
            return False
        self.publish({joint.name: 0.0 for joint in joints})
        return True

    def on_rare(self, topic: topics.Topic[Any], message: Message) -> None:
        """Send a rare message at once, and keep it for later viewers."""
        if isinstance(message, Body):
            before, self._described = self._described, message.description
            if before != message.description:
                self._on_body()
        elif isinstance(message, Health):
            self._send(f"health/{message.process}", as_json(HEALTH, message))
        elif isinstance(message, LogRecord):
            frame = as_json(LOG, message)
            self._log_lines = [*self._log_lines[1 - MAX_KEPT_LOG_LINES :], frame]
            self._send(f"log/{next(self._numbers)}", frame)
        elif isinstance(message, OccupancyGrid):
            self._keep("map", map_frame(message))
        else:
            self._keep("task", as_json(TASK, message))

    def _on_scene(self, scene: SimScene) -> None:
        self._arm = None
        self._keep("scene", as_json(SCENE, scene))

    def _on_arm_model(self, model: ArmModel) -> None:
        """Show an arm by its model, unless a simulation shows it."""
        self._links = self._arm = None
        try:
            self._links = LinkModel(model.mjcf)
        except ConfigError as error:
            log.warning("%s", error)
            return
        if not self._scenes.newest:
            self._arm = ArmScene(self._links)
            self._keep("scene", as_json(SCENE, self._arm.scene()))

    def _on_plan(self, _key: str, plan: ArmPlan) -> None:
        content = {"path": plan.points().round(4).tolist(), "grasps": plan.grasps}
        self._keep("arm_plan", as_json(ARM_PLAN, content))

    def _on_zones(self, zones: Zones) -> None:
        """Send zones only when they change, as they are published repeatedly."""
        before, self._zones = self._zones, zones
        if (zones.zones, zones.places, zones.map) != (before.zones, before.places, before.map):
            self._keep("zones", as_json(ZONES, zones))

    def _keep(self, slot: str, frame: bytes) -> None:
        if self._kept.get(slot) != frame:  # an unchanged map is published every two seconds
            self._kept[slot] = frame
            self._send(slot, frame)

    def _newest_pose(self, state: RobotState | None) -> tuple[Pose | None, bool]:
        """Return the robot's pose, and whether it is in the map."""
        place = self.pose.fresh()
        if place and place.localized:
            return Pose(x=place.x, y=place.y, yaw=place.yaw), True
        return (state.pose if state else None), False
