"""What the page shows of a robot, as frames; busy topics are decoded only when they are shown."""

import itertools
from collections.abc import Callable, Iterator

from msgspec.structs import asdict, replace

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.brain import OccupancyGrid, Twist
from gigabrain_schemas.safety import Health, LogRecord
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.tasks import TaskStatus
from gigabrain_schemas.topics import (
    BODY,
    HEALTH,
    IMAGE,
    INTENT,
    LOG,
    MAP,
    POSE,
    SAFETY,
    SCAN,
    STATE,
    TASK,
    TELEOP,
    WORLD,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.listening import Sampled
from gigabrain_zenoh.host.bounded import put_newest
from gigabrain_zenoh.ui.page import wire

PROCESSES = 64  # whose health is shown
CAMERAS = 4  # whose pictures are shown
KEPT_LINES = 30  # of the log, for a viewer who comes later


class Scene:
    """The newest of everything that the page shows."""

    def __init__(self, bus: Bus, tell: Callable[[str, bytes], None]) -> None:
        self._bus, self._tell = bus, tell
        self._state = Sampled(bus, STATE)
        self._intent, self._safety = Sampled(bus, INTENT), Sampled(bus, SAFETY)
        self._world, self._scan = Sampled(bus, WORLD), Sampled(bus, SCAN)
        self._place, self._images = Sampled(bus, POSE), dict[str, Sampled[Image]]()
        self._map_frame = self._task_frame = b""
        self._health: dict[str, bytes] = {}
        self._lines: list[bytes] = []
        self._numbers = itertools.count()
        self.body: Body | None = None
        bus.subscribe(HEALTH, self._hear_health)
        bus.subscribe(LOG, self._hear_line)
        bus.latest(MAP, self._hear_map)
        bus.latest(TASK, self._hear_task)
        bus.latest(BODY, self._hear_body)
        bus.tap(IMAGE.at("*"), self._hear_image)
        self.on_body: Callable[[], None] = lambda: None

    @property
    def enables(self) -> int | None:
        """How often the gate was enabled; None while the robot is silent."""
        state = self._state.fresh()
        return state.gate.enables if state else None

    def steer(self, wanted: Velocity) -> None:
        """Tell the robot's own control what an operator wants, with the newest tick."""
        self._state.look()
        self._bus.publish(TELEOP, Twist(**asdict(wanted)))

    def moment(self, driving: int, viewers: int) -> bytes:
        """How the robot is now."""
        state = self._state.fresh()
        pose, in_map = self._pose(state)
        world = self._world.fresh()
        return wire.as_json(
            wire.MOMENT,
            wire.Moment(
                state=state,
                pose=pose,
                frame="map" if in_map else "odom",
                intent=self._intent.fresh(),
                safety=self._safety.fresh(),
                world=world and replace(world, hits=b""),  # the page draws the scan itself
                driving=driving,
                viewers=viewers,
            ),
        )

    def news(self) -> Iterator[tuple[str, bytes]]:
        """Scan and pictures that have come since the last call, with their slots."""
        pose, _ = self._pose(self._state.fresh())
        scan = self._scan.look()
        if scan and pose and self.body:
            yield "scan", wire.scan_frame(scan, self.body.description, pose)
        for camera, sampled in list(self._images.items()):
            if image := sampled.look():
                yield f"image/{camera}", wire.image_frame(camera, image)

    def before(self) -> Iterator[tuple[str, bytes]]:
        """What somebody who comes late has missed: the map, the task, healths, the log."""
        for slot, frame in (("map", self._map_frame), ("task", self._task_frame)):
            if frame:
                yield slot, frame
        yield from ((f"health/{name}", frame) for name, frame in self._health.items())
        yield from ((f"log/{next(self._numbers)}", frame) for frame in self._lines)

    def _pose(self, state: RobotState | None) -> tuple[Pose | None, bool]:
        """Where the robot is, and whether that is in the map."""
        place = self._place.fresh()
        if place and place.localized:
            return Pose(x=place.x, y=place.y, yaw=place.yaw), True
        return (state.pose if state else None), False

    def _hear_health(self, _key: str, health: Health) -> None:
        frame = wire.as_json(wire.HEALTH, health)
        put_newest(self._health, health.process, frame, PROCESSES)
        self._tell(f"health/{health.process}", frame)

    def _hear_line(self, _key: str, line: LogRecord) -> None:
        frame = wire.as_json(wire.LOG, line)
        self._lines = [*self._lines[1 - KEPT_LINES :], frame]
        self._tell(f"log/{next(self._numbers)}", frame)

    def _hear_map(self, grid: OccupancyGrid) -> None:
        self._map_frame = wire.map_frame(grid)
        self._tell("map", self._map_frame)

    def _hear_task(self, status: TaskStatus) -> None:
        self._task_frame = wire.as_json(wire.TASK, status)
        self._tell("task", self._task_frame)

    def _hear_body(self, body: Body) -> None:
        before, self.body = self.body, body
        if before is None or before.description != body.description:
            self.on_body()

    def _hear_image(self, key: str, encoding: str, payload: bytes) -> None:
        camera = key.rpartition("/")[2]
        if camera in self._images or len(self._images) < CAMERAS:
            sampled = self._images.setdefault(camera, Sampled(self._bus, IMAGE))
            sampled.take(key, encoding, payload)
