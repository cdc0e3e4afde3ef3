"""What Foxglove, Lichtblick and Rerun draw of our messages: one conversion per message type.

The recorder and the live bridge have this table in common. Frames by REP-105: map → odom →
base_link → the lidar's own.
"""

import functools
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, cast

import msgspec
import numpy as np
from foxglove import Schema
from foxglove import messages as fox

from gigabrain_schemas import arrays
from gigabrain_schemas.base import Message, Pose
from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.brain import Intent, OccupancyGrid, PoseInMap, WorldModel
from gigabrain_schemas.safety import LogRecord
from gigabrain_schemas.sensors import Image, LaserScan
from gigabrain_schemas.tasks import TaskStatus
from gigabrain_schemas.topics import CMD_VEL, INTENT, SAFETY, STATE, WORLD, Topic
from gigabrain_zenoh.recording.schema import flat_schema
from gigabrain_zenoh.recording.shapes import pose_of, stamp, things, turn

MAP, ODOM, BASE = "map", "odom", "base_link"
LIDAR = "base_scan"  # as LaserScan has it
GREY = [round(254 - 2.54 * cell) for cell in range(101)]  # by how sure it is that a cell is taken
COLOURS = np.array(  # red, green, blue and alpha as one number; what is unknown is not drawn
    [
        *((grey, grey, grey, 255) for grey in GREY),
        *[(128, 128, 128, 255)] * 154,
        (128, 128, 128, 0),
    ],
    np.uint8,
).view("<u4")[:, 0]
PATH_STEP = 2  # of the trajectory's points one is drawn: five a second of the way ahead
LEVELS = {
    "debug": fox.LogLevel.Debug,
    "info": fox.LogLevel.Info,
    "warning": fox.LogLevel.Warning,
    "error": fox.LogLevel.Error,
    "critical": fox.LogLevel.Fatal,
}


PLOTTED = {topic.key for topic in (STATE, WORLD, INTENT, CMD_VEL, SAFETY)}


class Drawn(NamedTuple):
    """One message for a viewer."""

    topic: str
    encoding: str  # protobuf or json
    schema: Callable[[], Schema]
    data: bytes


def of(topic: str, message: Any) -> Drawn:
    """A message of foxglove's, encoded."""
    return Drawn(f"/viz/{topic}", "protobuf", type(message).get_schema, message.encode())


def numbers(topic: Topic[Any], message: Message) -> Drawn:
    """The numbers of a message, for plots; what is drawn anyway is left out."""
    if isinstance(message, WorldModel):
        message = msgspec.structs.replace(message, hits=b"", obstacles=())
    elif isinstance(message, Intent):
        message = msgspec.structs.replace(message, trajectory=())
    schema = functools.partial(json_schema, topic.type)
    name = f"/viz/{topic.key.rpartition('/')[2]}_numbers"
    return Drawn(name, "json", schema, msgspec.json.encode(message))


def json_schema(kind: type[Message]) -> Schema:
    """The schema of one of our messages, as viewers accept it."""
    return Schema(name=f"gigabrain.{kind.__name__}", encoding="jsonschema", data=flat_schema(kind))


class Drawer:
    """Converts message after message; remembers how the frames lie to one another."""

    def __init__(self) -> None:
        self._odometry = Pose(x=0.0, y=0.0, yaw=0.0)
        self._thought = (0, -1)  # boot and basis of the intent whose path was drawn last
        self._converters: dict[type[Message], Callable[[Any, str], Iterable[Drawn]]] = {
            LaserScan: self._scan,
            OccupancyGrid: self._map,
            PoseInMap: self._pose,
            Intent: self._path,
            WorldModel: self._obstacles,
            TaskStatus: self._task,
            Image: self._image,
            LogRecord: self._log,
            RobotState: self._state,
            Body: self._body,
        }

    def draws(self, topic: Topic[Any]) -> bool:
        """Whether there is anything to see of a topic."""
        return topic.key in PLOTTED or topic.type in self._converters

    def draw(self, topic: Topic[Any], message: Message, name: str = "") -> Iterable[Drawn]:
        """What viewers show of `message`; `name` is the camera's, where there are several."""
        if isinstance(message, Intent) and not self._thought_again(message):
            return
        if topic.type in self._converters:
            yield from self._converters[topic.type](message, name)
        if topic.key in PLOTTED:
            yield numbers(topic, message)

    def _thought_again(self, intent: Intent) -> bool:
        """Whether it is new: it is said again with every tick, and drawn once."""
        before, self._thought = self._thought, (intent.boot, intent.basis)
        return before != self._thought

    def _scan(self, scan: LaserScan, _: str) -> Iterable[Drawn]:
        ranges = arrays.ranges(scan)
        last = scan.angle_min + scan.angle_increment * (len(ranges) - 1)
        drawn = fox.LaserScan(
            timestamp=stamp(scan),
            frame_id=scan.frame_id,
            start_angle=scan.angle_min,
            end_angle=last,
            ranges=cast(list[float], ranges.astype(np.float64)),
        )
        yield of("scan", drawn)

    def _map(self, grid: OccupancyGrid, _: str) -> Iterable[Drawn]:
        cells = np.frombuffer(grid.cells, np.uint8)
        byte = fox.PackedElementFieldNumericType.Uint8
        names = enumerate(("red", "green", "blue", "alpha"))
        drawn = fox.Grid(
            timestamp=stamp(grid),
            frame_id=MAP,
            pose=pose_of(grid.origin_x, grid.origin_y, 0.0),
            column_count=grid.width,
            cell_size=fox.Vector2(x=grid.resolution, y=grid.resolution),
            row_stride=grid.width * 4,
            cell_stride=4,
            fields=[fox.PackedElementField(name=n, offset=i, type=byte) for i, n in names],
            data=COLOURS[cells].tobytes(),
        )
        yield of("map", drawn)

    def _pose(self, pose: PoseInMap, _: str) -> Iterable[Drawn]:
        here = pose_of(pose.x, pose.y, pose.yaw)
        yield of("pose", fox.PoseInFrame(timestamp=stamp(pose), frame_id=MAP, pose=here))
        odom = self._odometry
        yaw = pose.yaw - odom.yaw
        x = pose.x - odom.x * math.cos(yaw) + odom.y * math.sin(yaw)
        y = pose.y - odom.x * math.sin(yaw) - odom.y * math.cos(yaw)
        yield self._frame(pose, MAP, ODOM, Pose(x=x, y=y, yaw=yaw))

    def _path(self, intent: Intent, _: str) -> Iterable[Drawn]:
        shown = intent.trajectory[::PATH_STEP]
        poses = [pose_of(point.x, point.y, point.yaw) for point in shown]
        yield of("path", fox.PosesInFrame(timestamp=stamp(intent), frame_id=BASE, poses=poses))

    def _obstacles(self, world: WorldModel, _: str) -> Iterable[Drawn]:
        entities = things(world, self._odometry, ODOM, BASE)
        yield of("obstacles", fox.SceneUpdate(entities=entities))

    def _task(self, status: TaskStatus, _: str) -> Iterable[Drawn]:
        """The way to the goal, and the goal at its end."""
        way = [pose_of(x, y, 0.0) for x, y in status.path]
        if status.goal:
            goal = status.goal
            way.append(pose_of(goal.x, goal.y, goal.yaw or 0.0))
        yield of("way", fox.PosesInFrame(timestamp=stamp(status), frame_id=MAP, poses=way))

    def _image(self, image: Image, name: str) -> Iterable[Drawn]:
        when = stamp(image)
        if image.encoding == "jpeg":
            jpeg = fox.CompressedImage(
                timestamp=when, frame_id=image.frame_id, data=image.data, format="jpeg"
            )
            yield of(f"image/{name}", jpeg)
            return
        raw = fox.RawImage(
            timestamp=when,
            frame_id=image.frame_id,
            width=image.width,
            height=image.height,
            encoding={"depth16": "16UC1", "depth32f": "32FC1"}.get(image.encoding, image.encoding),
            step=len(image.data) // max(image.height, 1),
            data=image.data,
        )
        yield of(f"image/{name}", raw)

    def _log(self, record: LogRecord, _: str) -> Iterable[Drawn]:
        drawn = fox.Log(
            timestamp=stamp(record),
            level=LEVELS[record.level],
            message=record.text,
            name=record.process,
        )
        yield of("log", drawn)

    def _state(self, state: RobotState, _: str) -> Iterable[Drawn]:
        self._odometry = state.pose
        yield self._frame(state, ODOM, BASE, state.pose)

    def _body(self, body: Body, _: str) -> Iterable[Drawn]:
        lidar = body.description.lidar
        if lidar:
            place = Pose(x=lidar.x, y=lidar.y, yaw=lidar.yaw)
            yield self._frame(body, BASE, LIDAR, place)

    @staticmethod
    def _frame(at: Message, parent: str, child: str, pose: Pose) -> Drawn:
        drawn = fox.FrameTransform(
            timestamp=stamp(at),
            parent_frame_id=parent,
            child_frame_id=child,
            translation=fox.Vector3(x=pose.x, y=pose.y),
            rotation=turn(pose.yaw),
        )
        return of("tf", drawn)
