"""Publishing to ROS: a table of topics, and publishers that work only with readers."""

import functools
import logging
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from typing import Any

from gigabrain_schemas.body import Body, Camera, RobotState
from gigabrain_schemas.tasks import TaskStatus
from gigabrain_schemas.topics import (
    BODY,
    CMD_VEL,
    DEPTH,
    ENABLE,
    ESTOP,
    GOAL,
    IMAGE,
    IMU,
    JOINT_CMD,
    MAP,
    MAP_SAVE,
    MISSION,
    POSE_SET,
    RELEASE,
    SCAN,
    STATE,
    TASK,
    Topic,
)
from gigabrain_zenoh.bus.transport import Close
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.gateway.conversions import body as of_body
from gigabrain_zenoh.gateway.conversions import maps, sensors
from gigabrain_zenoh.gateway.conversions.description import robot_description
from gigabrain_zenoh.gateway.conversions.frames import (
    MAP as MAP_FRAME,
)
from gigabrain_zenoh.gateway.conversions.frames import (
    ODOM,
    Make,
    on_floor,
    tf_static,
    transforms,
)
from gigabrain_zenoh.gateway.scene import Scene, left_out
from gigabrain_zenoh.logs import Fault
from gigabrain_zenoh.ros2.qos import DEFAULT, LATCHED, SENSOR_DATA, Qos
from gigabrain_zenoh.ros2.transport import RosPublisher, RosServer
from gigabrain_zenoh.ros2.types import Types

log = logging.getLogger(__name__)
SECOND_NS = 1_000_000_000
TF = Qos(depth=100)  # as in tf2's broadcaster
CLOCK = Qos(reliable=False, depth=1)  # as in ROS's own subscription
COMMANDED = {  # interfaces for commands from ROS; published topics are in `table`
    "cmd_vel": CMD_VEL.key, "initialpose": POSE_SET.key, "goal_pose": GOAL.key,
    "navigate_to_pose": GOAL.key, "navigate_through_poses": MISSION.key, "estop": ESTOP.key,
    "release": RELEASE.key, "enable": ENABLE.key, "map_save": MAP_SAVE.key,
    "joint_trajectory": JOINT_CMD.key, "follow_joint_trajectory": JOINT_CMD.key,
}  # fmt: skip
OF_FIRST_CAMERA = ("image", "depth", "camera_info")  # parts of its topics, below `camera`
# returns a message, or its CDR; None: nothing to publish
Convert = Callable[[Make, Any, Scene], Any | None]


@dataclass(frozen=True)
class Row:
    """A ROS topic, and its sources."""

    topic: str  # below the namespace
    type: str
    qos: Qos
    sources: tuple[tuple[Topic[Any], Convert], ...]
    name: str = "*"  # of the camera
    every_ns: int = 0  # shortest time between two messages
    content: Callable[[Any, Scene], object] | None = None  # published again only if this changes
    simulated: bool = False  # for simulations only


def _tf(make: Make, state: RobotState, scene: Scene) -> Any:
    """Return the moving frames, with the present pose of the map's frame."""
    frames = of_body.moving_frames(scene.body, state)
    if odom := scene.odom_in_map:
        frames.insert(0, on_floor(MAP_FRAME, ODOM, odom))
    if scene.arm:
        frames += scene.arm.moving(state)
    return transforms(make, state.stamp_ns, frames)


class _ImuSource:
    """Prefers a body's own IMU stream to the readings in its states."""

    def __init__(self) -> None:
        self._last_tick = (0, 0)

    def of_topic(self, make: Make, reading: Any, _: Scene) -> Any:
        self._last_tick = reading.boot, reading.tick
        return of_body.imu(make, reading)

    def of_state(self, make: Make, state: RobotState, _: Scene) -> Any | None:
        boot, tick = self._last_tick
        streams = boot == state.boot and state.tick - tick < IMU_TICKS
        return None if streams else of_body.imu_of_state(make, state)


IMU_TICKS = 50  # a stream has ended after this silence


def table() -> tuple[Row, ...]:
    """Return the rows of every robot; those of its cameras are `camera_rows`."""
    imu = _ImuSource()
    return (
        Row("scan", "sensor_msgs/msg/LaserScan", SENSOR_DATA, (
            (SCAN, lambda _, scan, scene: sensors.laser_scan(scan, scene.body)),)),
        Row("odom", "nav_msgs/msg/Odometry", DEFAULT, ((STATE, _plain(of_body.odometry)),)),
        Row("tf", "tf2_msgs/msg/TFMessage", TF, ((STATE, _tf),)),
        Row("tf_static", "tf2_msgs/msg/TFMessage", LATCHED, (
            (BODY, _tf_static),), content=_content),
        Row("map", "nav_msgs/msg/OccupancyGrid", LATCHED, ((MAP, _plain(maps.occupancy_grid)),)),
        Row("imu", "sensor_msgs/msg/Imu", SENSOR_DATA, (
            (IMU, imu.of_topic), (STATE, imu.of_state))),
        Row("joint_states", "sensor_msgs/msg/JointState", DEFAULT, (
            (STATE, _plain(of_body.joint_states)),)),
        Row("battery_state", "sensor_msgs/msg/BatteryState", DEFAULT, (
            (STATE, _plain(of_body.battery_state)),), every_ns=SECOND_NS),
        Row("plan", "nav_msgs/msg/Path", DEFAULT, ((TASK, _plain(_Plans()),),)),
        Row("robot_description", "std_msgs/msg/String", LATCHED, (
            (BODY, _robot_description),), content=_content),
        Row("clock", "rosgraph_msgs/msg/Clock", CLOCK, ((STATE, _plain(of_body.clock)),),
            simulated=True),
    )  # fmt: skip


def _content(body: Body, scene: Scene) -> object:
    return body.description, scene.arm


def _tf_static(make: Make, body: Body, scene: Scene) -> Any:
    return tf_static(make, body, scene.arm.static() if scene.arm else ())


def _robot_description(make: Make, body: Body, scene: Scene) -> Any | None:
    """Return the complete URDF, because readers may keep the first one; None before."""
    return None if scene.awaits_arm else robot_description(make, body, scene.arm)


def _plain(convert: Callable[[Make, Any], Any | None]) -> Convert:
    return lambda make, message, _: convert(make, message)


class _Plans:
    """Publishes a path while there is one, and then an empty one once."""

    def __init__(self) -> None:
        self._empty = False

    def __call__(self, make: Make, status: TaskStatus) -> Any | None:
        was_empty, self._empty = self._empty, not status.path
        return None if was_empty and self._empty else maps.plan(make, status)


def camera_rows(cameras: tuple[Camera, ...]) -> Iterator[Row]:
    """Yield the rows of the cameras: the first below `camera`, others below `camera/NAME`.

    A further camera `depth` is below `camera/depth_camera`.
    """
    names = {camera.name for camera in cameras}
    for number, camera in enumerate(cameras):
        at = f"camera/{_apart(camera.name, names)}" if number else "camera"

        def picture(make: Make, image: Any, _: Scene, camera: Camera = camera) -> Any:
            return sensors.compressed_image(make, image, camera.name)

        def info(make: Make, message: Any, _: Scene, camera: Camera = camera) -> Any:
            return sensors.camera_info(make, message.stamp_ns, camera)

        def depth(make: Make, image: Any, _: Scene, camera: Camera = camera) -> Any:
            return sensors.depth_image(make, image, camera.name)

        about, image = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/CompressedImage"
        yield Row(f"{at}/image/compressed", image, SENSOR_DATA, ((IMAGE, picture),), camera.name)
        yield Row(f"{at}/camera_info", about, SENSOR_DATA, ((IMAGE, info),), camera.name)
        if camera.depth:
            raw, at = "sensor_msgs/msg/Image", f"{at}/depth"
            yield Row(f"{at}/image_raw", raw, SENSOR_DATA, ((DEPTH, depth),), camera.name)
            # depth_image_proc looks for it there
            yield Row(f"{at}/camera_info", about, SENSOR_DATA, ((DEPTH, info),), camera.name)


def _apart(name: str, names: Collection[str]) -> str:
    """Return the name below `camera`: another one where the first camera has topics by it."""
    if name not in OF_FIRST_CAMERA:
        return name
    name += "_camera"
    while name in names:
        name += "_"
    return name


@dataclass
class _Published:
    """A published row."""

    row: Row
    publisher: RosPublisher | None = None
    readers: int = 0
    closes: list[Close] = field(default_factory=list)
    sent_ns: int = -SECOND_NS
    fault: Fault = field(default_factory=lambda: Fault(log))
    content: object = None  # of the last message, if the row compares it


class Publishing:
    """Publishers of all rows; those without readers receive and encode nothing."""

    def __init__(
        self,
        scene: Scene,
        ros: RosServer,
        types: Types,
        config: Ros2Config,
        only: Collection[str] | None = None,
    ) -> None:
        """Offer all topics that `config` does not leave out; with `only`, only those."""
        self._scene, self._ros, self._types, self._config = scene, ros, types, config
        self._only = only
        self._cameras: tuple[Camera, ...] = ()
        self._of_cameras: list[_Published] = []
        self._closed = False
        self._simulated: _Published | None = None
        self._rows = [self._open(row) for row in table() if not row.simulated]
        scene.on_body.append(self._follow_body)
        if scene.body:
            self._follow_body(scene.body)

    @property
    def topics(self) -> list[str]:
        """The present topics, below the namespace."""
        every = [*self._rows, *self._of_cameras]
        return [one.row.topic for one in every if one.publisher]

    def close(self) -> None:
        """Withdraw all publishers."""
        self._closed = True
        for one in (*self._rows, *self._of_cameras):
            self._end(one)

    def _follow_body(self, body: Body) -> None:
        """Offer the topics of its cameras, and for a simulation the clock."""
        if self._closed:
            return
        if body.link == "sim" and self._simulated is None:
            (row,) = (row for row in table() if row.simulated)
            self._simulated = self._open(row)
            self._rows.append(self._simulated)
        if body.description.cameras == self._cameras:
            return
        self._cameras = body.description.cameras
        for one in self._of_cameras:
            self._end(one)
        self._of_cameras = [self._open(row) for row in camera_rows(self._cameras)]

    def _open(self, row: Row) -> _Published:
        one = _Published(row)
        wanted = self._only is None or row.topic in self._only
        if wanted and not left_out(self._config, row.topic):
            count = functools.partial(self._count, one)
            one.publisher = self._ros.publisher(row.topic, row.type, row.qos, count)
        return one

    def _end(self, one: _Published) -> None:
        self._count(one, 0)
        if one.publisher:
            one.publisher.close()

    def _count(self, one: _Published, readers: int) -> None:
        """Subscribe with the first reader, and end with the last."""
        before, one.readers = one.readers, readers
        if readers and not one.closes and not self._closed:
            one.content, one.sent_ns = None, -SECOND_NS
            for topic, convert in one.row.sources:
                take = functools.partial(self._take, one, convert)
                one.closes.append(self._scene.feeds.add(topic, take, one.row.name))
        elif before and not readers:
            for close in one.closes:
                close()
            one.closes = []

    def _take(self, one: _Published, convert: Convert, message: Any) -> None:
        now_ns = self._scene.bus.clock.now_ns()
        content = one.row.content(message, self._scene) if one.row.content else None
        same = content is not None and content == one.content
        if one.publisher is None or same or now_ns - one.sent_ns < one.row.every_ns:
            return
        try:
            made = convert(self._types.make, message, self._scene)
        except ValueError as error:
            self._scene.bus.counters["not_converted"] += 1
            one.fault.begin(f"/{one.row.topic}: left out a message: {error}")
            return
        one.fault.end(f"/{one.row.topic}: messages can be converted again")
        if made is None:
            return
        one.content, one.sent_ns = content, now_ns
        cdr = made if isinstance(made, bytes) else self._types.encode(one.row.type, made)
        one.publisher.publish(cdr)
        self._scene.bus.counters["published"] += 1
