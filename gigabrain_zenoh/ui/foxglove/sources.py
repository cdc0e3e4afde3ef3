"""What viewers may look at: the newest of each topic, drawn only while somebody does look."""

from collections.abc import Iterable
from typing import Any

from foxglove import Channel, Context
from msgspec.structs import asdict

from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.body import Body
from gigabrain_schemas.brain import OccupancyGrid, Twist
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.tasks import TaskStatus
from gigabrain_schemas.topics import (
    BODY,
    CMD_VEL,
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
    Topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.listening import Sampled
from gigabrain_zenoh.recording.drawing import Drawer, Drawn

SAMPLED: tuple[Topic[Any], ...] = (STATE, SCAN, WORLD, INTENT, POSE, SAFETY, CMD_VEL)
CAMERAS = 8  # whose pictures are shown


class Sources:
    """Draws what comes over the bus, by the recorder's table."""

    def __init__(self, bus: Bus, context: Context) -> None:
        self._bus, self._context, self._drawer = bus, context, Drawer()
        self._sampled = [(topic, Sampled(bus, topic)) for topic in SAMPLED]
        self._state = self._sampled[0][1]
        self._images: dict[str, Sampled[Image]] = {}
        self._kept: dict[Topic[Any], Message] = {}
        self._channels: dict[str, Channel] = {}
        self._drawn: dict[str, set[str]] = {}  # names of channels by what they are drawn from
        self.body: Body | None = None
        bus.subscribe(LOG, lambda _key, line: self._draw(LOG, line))
        bus.latest(MAP, self._hear_map)
        bus.latest(TASK, self._hear_task)
        bus.latest(BODY, self._hear_body)
        bus.tap(IMAGE.at("*"), self._hear_image)

    @property
    def enables(self) -> int | None:
        """How often the gate was enabled; None while the robot is silent."""
        state = self._state.fresh()
        return state.gate.enables if state else None

    def steer(self, wanted: Velocity) -> None:
        """Tell the robot's own control what an operator wants, with the newest tick."""
        self._state.look()
        self._bus.publish(TELEOP, Twist(**asdict(wanted)))

    def show(self) -> None:
        """Draw what has come since the last call."""
        for topic, sampled in self._sampled:
            if self._looked_at(topic.key) and (message := sampled.look()):
                self._draw(topic, message)
        for camera, pictures in list(self._images.items()):
            if self._looked_at(IMAGE.at(camera)) and (image := pictures.look()):
                self._draw(IMAGE, image, camera)

    def show_again(self, name: str) -> None:
        """Somebody has come to a channel: draw what is seldom sent once more."""
        for topic, kept in self._kept.items():
            if name in self._drawn.get(topic.key, ()):
                self._draw(topic, kept)

    def _looked_at(self, key: str) -> bool:
        """Whether somebody looks, or could not yet, as nothing has been drawn of it so far."""
        names: Iterable[str] = self._drawn.get(key, ())
        return not names or any(self._channels[name].base.has_sinks() for name in names)

    def _draw(self, topic: Topic[Any], message: Message, name: str = "") -> None:
        key = topic.at(name)
        if not self._looked_at(key):
            return
        for drawn in self._drawer.draw(topic, message, name):
            self._drawn.setdefault(key, set()).add(drawn.topic)
            self._channel(drawn).log(drawn.data, log_time=message.stamp_ns or None)

    def _channel(self, drawn: Drawn) -> Channel:
        if drawn.topic not in self._channels:
            self._channels[drawn.topic] = Channel(
                drawn.topic,
                message_encoding=drawn.encoding,
                schema=drawn.schema(),
                context=self._context,
            )
        return self._channels[drawn.topic]

    def _hear_map(self, grid: OccupancyGrid) -> None:
        self._kept[MAP] = grid
        self._draw(MAP, grid)

    def _hear_task(self, status: TaskStatus) -> None:
        self._kept[TASK] = status
        self._draw(TASK, status)

    def _hear_body(self, body: Body) -> None:
        self.body = self._kept[BODY] = body
        self._draw(BODY, body)

    def _hear_image(self, key: str, encoding: str, payload: bytes) -> None:
        camera = key.rpartition("/")[2]
        if camera in self._images or len(self._images) < CAMERAS:
            sampled = self._images.setdefault(camera, Sampled(self._bus, IMAGE))
            sampled.take(key, encoding, payload)
