"""The gateway's data about the robot. Each message is decoded once for all users."""

import logging
from collections.abc import Callable
from typing import Any, TypeVar

from gigabrain_schemas.base import Message, Pose
from gigabrain_schemas.body import Body, BodyDescription, RobotState
from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.topics import ARM_MODEL, BODY, POSE, STATE, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Close
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gateway.conversions.arm_frames import ArmFrames
from gigabrain_zenoh.gateway.conversions.description import arm_frames
from gigabrain_zenoh.geometry.link_model import LinkModel
from gigabrain_zenoh.geometry.pose import PoseHistory, compose, inverse

log = logging.getLogger(__name__)
M = TypeVar("M", bound=Message)
Handle = Callable[[Any], None]


def left_out(config: Ros2Config, name: str) -> bool:
    """Return whether the settings leave out a ROS topic, service or action."""
    return name in {one.strip("/") for one in config.leave_out}


class Feeds:
    """Subscriptions to our topics, opened by their first user and closed with the last."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._users: dict[tuple[str, str], list[Handle]] = {}
        self._closes: dict[tuple[str, str], Close] = {}

    def add(self, topic: Topic[M], handle: Callable[[M], None], name: str = "*") -> Close:
        """Call `handle` for each new message; returns the function that ends it."""
        key = topic.key, name
        users = self._users.setdefault(key, [])
        users.append(handle)
        if key not in self._closes:
            self._closes[key] = self._bus.subscribe(topic, self._passer(users), name=name)

        def close() -> None:
            if handle in users:
                users.remove(handle)
            if not users and self._users.get(key) is users:
                del self._users[key]
                self._closes.pop(key)()

        return close

    @staticmethod
    def _passer(users: list[Handle]) -> Callable[[str, Any], None]:
        def pass_on(_key: str, message: Any) -> None:
            for handle in tuple(users):
                handle(message)

        return pass_on


class Scene:
    """The newest state, body and place of the robot; handlers get each state after them."""

    def __init__(self, bus: Bus) -> None:
        self.bus, self.feeds = bus, Feeds(bus)
        self.on_state: list[Callable[[RobotState], None]] = []
        self.on_body: list[Callable[[Body], None]] = []
        self.state: RobotState | None = None  # newest, of any age
        self._history, self._seen_ns = PoseHistory(), 0
        self._pose: PoseInMap | None = None  # waits for the state of its tick
        self._odom_in_map: Pose | None = None
        self._states, self._poses = (
            bus.latest(STATE, self._take_state),
            bus.latest(POSE, self._place),
        )
        self.arm: ArmFrames | None = None  # None also for an unreadable model
        self._described: tuple[BodyDescription, str] | None = None
        self._arm_models = bus.latest(ARM_MODEL, lambda _: self._follow_arm())
        self._bodies = bus.latest(BODY, self._take_body)

    @property
    def body(self) -> Body | None:
        """The body's description; None before the first."""
        return self._bodies.newest

    @property
    def description(self) -> BodyDescription | None:
        """The body's own part of it."""
        return self._bodies.newest.description if self._bodies.newest else None

    @property
    def awaits_arm(self) -> bool:
        """True until the model of the body's arm has arrived."""
        about = self.description
        return about is not None and about.arm is not None and self._described is None

    @property
    def fresh_state(self) -> RobotState | None:
        """The newest state; None while the robot is silent."""
        return self._states.fresh()

    @property
    def simulated(self) -> bool:
        """Return whether the body is simulated, so that ROS takes its time from /clock."""
        return self.body is not None and self.body.link == "sim"

    @property
    def odom_in_map(self) -> Pose | None:
        """The pose of the odometry's frame in the map; None while the robot is not localized."""
        return self._odom_in_map if self._poses.fresh() else None

    @property
    def here(self) -> Pose | None:
        """The robot's pose in the map now; None while it is not localized."""
        odom = self.odom_in_map
        return compose(odom, self.state.pose) if odom and self.state else None

    def ros_ns(self) -> int:
        """Return ROS time: Unix time, or for a simulation its extrapolated stamps [ns]."""
        if self.simulated and self.state:
            return self.state.stamp_ns + self.bus.clock.now_ns() - self._seen_ns
        return self.bus.clock.unix_ns()

    def _take_state(self, state: RobotState) -> None:
        self.state, self._seen_ns = state, self.bus.clock.now_ns()
        if state.boot != self._history.boot:
            self._odom_in_map = None  # its odometry restarts
        self._history = self._history.then(state)
        if self._pose:
            self._place(self._pose)
        for handle in tuple(self.on_state):
            handle(state)

    def _place(self, pose: PoseInMap) -> None:
        """Use a pose in the map when the odometry of its tick is known."""
        then = self._history.at(pose.boot, pose.basis)
        self._pose = pose if then is None else None
        if not pose.localized:
            self._odom_in_map = None
        elif then:
            self._odom_in_map = compose(Pose(x=pose.x, y=pose.y, yaw=pose.yaw), inverse(then))

    def _follow_arm(self) -> None:
        """Update the arm when its model or its body changes."""
        body, model = self._bodies.newest, self._arm_models.newest
        if not (body and body.description.arm and model):
            self._described = self.arm = None
            return
        described = body.description, model.mjcf
        if described == self._described:
            return
        self._described, self.arm = described, None
        try:
            self.arm = arm_frames(LinkModel(model.mjcf), body)
        except ConfigError as error:
            log.warning("%s", error)

    def _take_body(self, body: Body) -> None:
        self._follow_arm()
        for handle in tuple(self.on_body):
            handle(body)
