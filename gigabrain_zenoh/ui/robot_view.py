"""Parts shared by the operator page and the Foxglove bridge: the newest messages, and steering."""

import functools
from typing import Any, Protocol

from msgspec.structs import asdict

from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.body import Body
from gigabrain_schemas.brain import Twist
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import (
    BODY,
    CMD_VEL,
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
    Topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.listening import Sampled
from gigabrain_zenoh.geometry.limits import ZERO, clamp, limits_of

LEASE_S = 0.5  # after this time without a command, another viewer may steer
STREAM_GAP_S = 0.2  # after a longer gap, commands count as a new stream
SETTLE_S = 0.1  # start of a new stream that is ignored: commands the network had buffered


class RobotView:
    """Newest messages of a robot. Those of busy topics are decoded only when they are read."""

    max_cameras = 8  # whose images are shown

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self.state, self.scan = Sampled(bus, STATE), Sampled(bus, SCAN)
        self.world, self.intent = Sampled(bus, WORLD), Sampled(bus, INTENT)
        self.pose, self.safety = Sampled(bus, POSE), Sampled(bus, SAFETY)
        self.command = Sampled(bus, CMD_VEL)
        self.images: dict[str, Sampled[Image]] = {}  # by camera
        self.body: Body | None = None
        rare_topics: tuple[Topic[Any], ...] = (MAP, TASK, BODY)
        for rare in rare_topics:
            bus.latest(rare, functools.partial(self.show, rare))
        events: tuple[Topic[Any], ...] = (LOG, HEALTH)
        for event in events:
            bus.subscribe(event, functools.partial(self._show_event, event))
        bus.tap(IMAGE.at("*"), self._take_image)

    @property
    def enables(self) -> int | None:
        """Return how often the gate was enabled; None while the robot sends nothing."""
        state = self.state.fresh()
        return state.gate.enables if state else None

    def steer(self, wanted: Velocity) -> None:
        """Publish the operator's wanted velocity with the newest tick."""
        self.state.look()
        self._bus.publish(TELEOP, Twist(**asdict(wanted)))

    def show(self, topic: Topic[Any], message: Message) -> None:
        """Show a message of MAP, TASK, BODY, LOG or HEALTH as it arrives."""
        raise NotImplementedError

    def _show_event(self, topic: Topic[Any], _key: str, message: Message) -> None:
        self.show(topic, message)

    def _take_image(self, key: str, encoding: str, payload: bytes) -> None:
        camera = key.rpartition("/")[2]
        if camera in self.images or len(self.images) < self.max_cameras:
            sampled = self.images.setdefault(camera, Sampled(self._bus, IMAGE))
            sampled.take(key, encoding, payload)


class Steered(Protocol):
    """Interface to the robot that steering needs."""

    @property
    def body(self) -> Body | None:
        """Return the robot's body; None until it is received."""
        ...

    @property
    def enables(self) -> int | None:
        """Return how often its gate was enabled; None while the robot sends nothing."""
        ...

    def steer(self, wanted: Velocity) -> None:
        """Send the operator's wanted velocity to the robot's control."""
        ...


class TeleopArbiter:
    """Lets one viewer steer at a time, while its commands arrive. Commands are never repeated."""

    def __init__(self, robot: Steered) -> None:
        self._robot = robot
        self._viewer = 0
        self._lease_end_s = self._last_command_s = self._obey_from_s = 0.0
        self._enables: int | None = None  # the gate's count when a viewer last steered

    def driving(self, now_s: float) -> int:
        """Return the number of the viewer that steers, or 0."""
        return self._viewer if now_s < self._lease_end_s else 0

    def drive(self, viewer: int, wanted: Velocity, now_s: float) -> bool:
        """Pass on the velocity that a viewer (1, 2, …) wants; return False if another one steers.

        A zero velocity from another viewer is ignored, and returns True.
        """
        if self.driving(now_s) not in (0, viewer):
            return wanted == ZERO
        body = self._robot.body
        if body is None or (wanted == ZERO and viewer != self._viewer):
            return True
        if viewer != self._viewer or now_s - self._last_command_s > STREAM_GAP_S:
            self._obey_from_s = now_s + SETTLE_S
        self._viewer, self._last_command_s, self._lease_end_s = viewer, now_s, now_s + LEASE_S
        if wanted == ZERO:
            self._end()
        elif now_s >= self._obey_from_s:
            self._enables = self._robot.enables
            self._robot.steer(clamp(wanted, limits_of(body.description)))
        return True

    def leave(self, viewer: int) -> None:
        """Stop the robot if the viewer that leaves was steering it."""
        if viewer == self._viewer:
            self._end()

    def clear(self) -> None:
        """End steering by any viewer, because an e-stop was pressed."""
        if self._viewer:
            self._end()

    def _end(self) -> None:
        """Publish a zero velocity, unless the gate was enabled again since the last command.

        In that case a zero would take the body back from its new commander.
        """
        self._viewer = 0
        if self._robot.enables in (None, self._enables):
            self._robot.steer(ZERO)
