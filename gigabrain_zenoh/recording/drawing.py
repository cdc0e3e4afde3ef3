"""Converts messages into drawings for Foxglove, Lichtblick and Rerun.

The recorder and the live bridge share this table. Frames follow REP-105: map → odom → base_link →
frame of the lidar, and the links of an arm.
"""

import functools
import math
from collections.abc import Callable, Iterable
from typing import Any, cast

import msgspec
import numpy as np
from foxglove import messages as fox

from gigabrain_schemas.base import Message, Pose
from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.brain import (
    Intent,
    Objects,
    Obstacle,
    OccupancyGrid,
    PoseInMap,
    WorldModel,
)
from gigabrain_schemas.safety import LogRecord
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.tasks import TaskStatus
from gigabrain_schemas.topics import Drawing, Topic
from gigabrain_schemas.zones import Place, Zone, Zones
from gigabrain_zenoh.geometry.pose import to_frame
from gigabrain_zenoh.recording import camera_drawing
from gigabrain_zenoh.recording.arm_drawing import ArmDrawing
from gigabrain_zenoh.recording.drawn import (
    BASE,
    BLUE,
    LAST_STAMP_NS,
    LIDAR,
    MAP,
    ODOM,
    Drawn,
    KnownEntities,
    as_drawn,
    json_schema,
    label,
    pose_of,
    quaternion,
    stamp,
)

GREY = [round(254 - 2.54 * cell) for cell in range(101)]  # by probability of being occupied [%]
CELL_COLOURS = np.array(  # red, green, blue and alpha as one number; unknown is transparent
    [
        *((grey, grey, grey, 255) for grey in GREY),
        *[(128, 128, 128, 255)] * 154,
        (128, 128, 128, 0),
    ],
    np.uint8,
).view("<u4")[:, 0]
PATH_STEP = 2  # every second point of a trajectory is drawn: five per second
LOG_LEVELS = {
    "debug": fox.LogLevel.Debug,
    "info": fox.LogLevel.Info,
    "warning": fox.LogLevel.Warning,
    "error": fox.LogLevel.Error,
    "critical": fox.LogLevel.Fatal,
}

AMBER = fox.Color(r=0.96, g=0.62, b=0.04, a=0.6)
ZONE_COLOURS = {
    "keepout": fox.Color(r=0.77, g=0.08, b=0.11, a=0.8),
    "speed": fox.Color(r=0.96, g=0.62, b=0.04, a=0.8),
    "one_way": fox.Color(r=0.04, g=0.37, b=0.49, a=0.3),
}
PLACE_LENGTH_M = 0.4
OBSTACLE_HEIGHT_M = 0.3
LINE_WIDTH_M = 0.08
ARROW_TIME_S = 1.0  # an arrow ends at the obstacle's place after this time
MIN_ARROW_SPEED = 0.05  # [m/s]
MIN_WALL_RADIUS_M = 0.3  # larger obstacles at rest are drawn as lines along the scan's points
MAX_POINT_GAP_M = 0.25  # between neighbouring points of one obstacle
OBSTACLE_LIFETIME = fox.Duration(sec=1)


def _numbers(topic: Topic[Any], message: Message) -> Drawn:
    """Return the numbers of a message for plots, without the parts that have drawings."""
    if isinstance(message, WorldModel):
        message = msgspec.structs.replace(message, hits=b"", obstacles=(), contours=())
    elif isinstance(message, Intent):
        message = msgspec.structs.replace(message, trajectory=())
    schema = functools.partial(json_schema, topic.type)
    name = f"/viz/{topic.key.rpartition('/')[2]}_numbers"
    return Drawn(name, "json", schema, msgspec.json.encode(message))


class Drawer:
    """Converts one message after another; keeps the newest odometry pose for the frames."""

    def __init__(self) -> None:
        self._odometry = Pose(x=0.0, y=0.0, yaw=0.0)
        self._zones_drawn = KnownEntities()
        self._arm = ArmDrawing()
        self._last_intent = (0, -1)  # boot and basis of the last path drawn
        self._converters: dict[Drawing, Callable[[Any, str], Iterable[Drawn]]] = {
            "scan": self._scan,
            "map": self._map,
            "zones": self._zones,
            "pose": self._pose,
            "path": self._path,
            "obstacles": self._obstacles,
            "task": self._task,
            "log": self._log,
            "odometry": self._state,
            "lidar_frame": self._body,
            "arm_model": self._arm.draw_model,
            "arm_plan": self._arm.draw_plan,
            "image": camera_drawing.picture,
            "depth": camera_drawing.depth,
            "camera": camera_drawing.calibration,
            "detections": camera_drawing.recognised,
            "objects": camera_drawing.ObjectMapDrawing().draw,
            "solids": camera_drawing.SolidsDrawing().draw,
            "perceived": self._perceived,
        }

    def draws(self, topic: Topic[Any]) -> bool:
        """Return whether there are drawings or plots of a topic."""
        return topic.plotted or topic.drawing is not None

    def draw(self, topic: Topic[Any], message: Message, name: str = "") -> Iterable[Drawn]:
        """Yield the drawings of `message`; `name` is the last part of its key, such as a camera.

        Yields nothing if the stamp is later than viewers accept.
        """
        if message.stamp_ns > LAST_STAMP_NS:
            return
        if isinstance(message, Intent) and not self._is_new(message):
            return
        if topic.drawing:
            yield from self._converters[topic.drawing](message, name)
        if topic.plotted:
            yield _numbers(topic, message)

    def _is_new(self, intent: Intent) -> bool:
        """Return whether an intent is new, as each is repeated with every tick."""
        before, self._last_intent = self._last_intent, (intent.boot, intent.basis)
        return before != self._last_intent

    def _scan(self, scan: LaserScan, _: str) -> Iterable[Drawn]:
        ranges = scan.ranges_m
        last = scan.angle_min + scan.angle_increment * (len(ranges) - 1)
        drawn = fox.LaserScan(
            timestamp=stamp(scan),
            frame_id=scan.frame_id,
            start_angle=scan.angle_min,
            end_angle=last,
            ranges=cast(list[float], ranges.astype(np.float64)),
        )
        yield as_drawn("scan", drawn)

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
            data=CELL_COLOURS[cells].tobytes(),
        )
        yield as_drawn("map", drawn)

    def _zones(self, zones: Zones, _: str) -> Iterable[Drawn]:
        """Draw zones, the direction of lanes, and places, each with its name."""
        entities = {zone.name: _zone_entity(zones, zone) for zone in zones.zones}
        entities |= {place.name: _place_entity(zones, place) for place in zones.places}
        yield as_drawn("zones", self._zones_drawn.update(zones, entities))

    def _pose(self, pose: PoseInMap, _: str) -> Iterable[Drawn]:
        here = pose_of(pose.x, pose.y, pose.yaw)
        in_map = fox.PoseInFrame(timestamp=stamp(pose), frame_id=MAP, pose=here)
        yield as_drawn("pose", in_map)
        odom = self._odometry
        yaw = pose.yaw - odom.yaw
        x = pose.x - odom.x * math.cos(yaw) + odom.y * math.sin(yaw)
        y = pose.y - odom.x * math.sin(yaw) - odom.y * math.cos(yaw)
        yield self._frame(pose, MAP, ODOM, Pose(x=x, y=y, yaw=yaw))

    def _path(self, intent: Intent, _: str) -> Iterable[Drawn]:
        shown = intent.trajectory[::PATH_STEP]
        poses = [pose_of(point.x, point.y, point.yaw) for point in shown]
        path = fox.PosesInFrame(timestamp=stamp(intent), frame_id=BASE, poses=poses)
        yield as_drawn("path", path)

    def _obstacles(self, world: WorldModel, _: str) -> Iterable[Drawn]:
        entities = obstacle_entities(world, self._odometry)
        yield as_drawn("obstacles", fox.SceneUpdate(entities=entities))
        yield from camera_drawing.contours(world)

    def _perceived(self, found: Objects, name: str) -> Iterable[Drawn]:
        """Draw a perceptor's objects with their labels."""
        entities = [_cylinder(found, each, each.label) for each in found.objects]
        yield as_drawn(f"perceived/{name}", fox.SceneUpdate(entities=entities))

    def _task(self, status: TaskStatus, _: str) -> Iterable[Drawn]:
        """Draw the path to the goal, with the goal at its end."""
        poses = [pose_of(x, y, 0.0) for x, y in status.path]
        if status.goal:
            goal = status.goal
            poses.append(pose_of(goal.x, goal.y, goal.yaw or 0.0))
        path = fox.PosesInFrame(timestamp=stamp(status), frame_id=MAP, poses=poses)
        yield as_drawn("way", path)

    def _log(self, record: LogRecord, _: str) -> Iterable[Drawn]:
        drawn = fox.Log(
            timestamp=stamp(record),
            level=LOG_LEVELS[record.level],
            message=record.text,
            name=record.process,
        )
        yield as_drawn("log", drawn)

    def _state(self, state: RobotState, _: str) -> Iterable[Drawn]:
        self._odometry = state.pose
        yield self._frame(state, ODOM, BASE, state.pose)
        yield from self._arm.draw_joints(state)

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
            rotation=quaternion(pose.yaw),
        )
        return as_drawn("tf", drawn)


def obstacle_entities(world: WorldModel, odometry: Pose) -> list[fox.SceneEntity]:
    """Draw all obstacles: cylinders in `odom`, large ones at rest as points in `base_link`.

    `odometry` is the robot's pose at the time of `world`.
    """
    return [
        _wall(world, obstacle, odometry)
        if obstacle.radius > MIN_WALL_RADIUS_M
        and _speed(obstacle) <= MIN_ARROW_SPEED
        and world.hits
        else _cylinder(world, obstacle)
        for obstacle in world.obstacles
    ]


def _speed(obstacle: Obstacle) -> float:
    return math.hypot(obstacle.velocity_x, obstacle.velocity_y)


def _wall(world: WorldModel, obstacle: Obstacle, odometry: Pose) -> fox.SceneEntity:
    """Draw lines along the scan's points on an obstacle."""
    hits = world.points()
    x, y = to_frame(odometry, obstacle.x, obstacle.y)
    distances = np.hypot(hits[:, 0] - x, hits[:, 1] - y)
    near = hits[distances < obstacle.radius + MAX_POINT_GAP_M]
    joined = np.hypot(*np.diff(near, axis=0).T) < MAX_POINT_GAP_M
    ends = np.hstack((near[:-1], near[1:]))[joined].reshape(-1, 2).tolist()
    lines = fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineList,
        points=[fox.Point3(x=x, y=y, z=OBSTACLE_HEIGHT_M / 2) for x, y in ends],
        thickness=LINE_WIDTH_M, color=AMBER,
    )  # fmt: skip
    return fox.SceneEntity(
        timestamp=stamp(world), frame_id=BASE, id=str(obstacle.id), lifetime=OBSTACLE_LIFETIME,
        lines=[lines],
    )  # fmt: skip


def _zone_entity(zones: Zones, zone: Zone) -> fox.SceneEntity:
    """Draw the edges of a zone, or the centre line of a lane with an arrow at its end."""
    lane, colour = zone.kind == "one_way", ZONE_COLOURS[zone.kind]
    kind = fox.LinePrimitiveLineType.LineStrip if lane else fox.LinePrimitiveLineType.LineLoop
    line = fox.LinePrimitive(
        type=kind, points=[fox.Point3(x=x, y=y, z=0.02) for x, y in zone.points],
        thickness=(zone.lane_width or 0.0) if lane else LINE_WIDTH_M, color=colour,
    )  # fmt: skip
    arrows = []
    if lane:
        (x, y), (to_x, to_y) = zone.points[-2:]
        arrows = [_arrow(x, y, math.atan2(to_y - y, to_x - x), math.hypot(to_x - x, to_y - y))]
    x, y = zone.points[0]
    text = zone.name if zone.max_speed is None else f"{zone.name}: {zone.max_speed:g} m/s"
    return fox.SceneEntity(
        timestamp=stamp(zones), frame_id=MAP, id=zone.name, lines=[line], arrows=arrows,
        texts=[label(x, y, text)],
    )  # fmt: skip


def _place_entity(zones: Zones, place: Place) -> fox.SceneEntity:
    """Draw an arrow along the heading of a place, or a dot."""
    length = PLACE_LENGTH_M if place.yaw is not None else LINE_WIDTH_M
    return fox.SceneEntity(
        timestamp=stamp(zones), frame_id=MAP, id=place.name,
        arrows=[_arrow(place.x, place.y, place.yaw or 0.0, length)],
        texts=[label(place.x, place.y, place.name)],
    )  # fmt: skip


def _arrow(x: float, y: float, yaw: float, length: float) -> fox.ArrowPrimitive:
    return fox.ArrowPrimitive(
        pose=pose_of(x, y, yaw), shaft_length=length, shaft_diameter=0.04,
        head_length=0.1, head_diameter=0.1, color=BLUE,
    )  # fmt: skip


def _cylinder(at: Message, obstacle: Obstacle, text: str = "") -> fox.SceneEntity:
    """Draw an obstacle as a cylinder, with an arrow along its velocity and a text."""
    here = pose_of(obstacle.x, obstacle.y, 0.0)
    width = 2 * max(obstacle.radius, 0.01)
    body = fox.CylinderPrimitive(
        pose=here, size=fox.Vector3(x=width, y=width, z=OBSTACLE_HEIGHT_M), color=AMBER,
        top_scale=1.0, bottom_scale=1.0,
    )  # fmt: skip
    speed = _speed(obstacle)
    arrow = fox.ArrowPrimitive(
        pose=pose_of(obstacle.x, obstacle.y, math.atan2(obstacle.velocity_y, obstacle.velocity_x)),
        shaft_length=ARROW_TIME_S * speed, shaft_diameter=0.03,
        head_length=0.08, head_diameter=0.08, color=AMBER,
    )  # fmt: skip
    return fox.SceneEntity(
        timestamp=stamp(at), frame_id=ODOM, id=str(obstacle.id), lifetime=OBSTACLE_LIFETIME,
        cylinders=[body], arrows=[arrow] if speed > MIN_ARROW_SPEED else [],
        texts=[label(obstacle.x, obstacle.y, text, OBSTACLE_HEIGHT_M)] if text else [],
    )  # fmt: skip
