"""Commands from ROS: /cmd_vel through the commander, and poses from RViz."""

import asyncio
import logging
from collections.abc import Iterable
from typing import Any

from msgspec.structs import asdict

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.requests import PoseRequest
from gigabrain_schemas.tasks import GoalRequest
from gigabrain_schemas.topics import GOAL, POSE_SET, command_topic
from gigabrain_zenoh.client.requests import ANSWER_S, enable
from gigabrain_zenoh.client.tasks import PLAN_S, late
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.errors import BadPayload, BodyLost, GigabrainError, Refused
from gigabrain_zenoh.gateway import commander
from gigabrain_zenoh.gateway.background import Background
from gigabrain_zenoh.gateway.commander import Action, Ask, Memory, Now, Refuse, Send, wanted_of
from gigabrain_zenoh.gateway.conversions.diagnostics import Level, Status
from gigabrain_zenoh.gateway.conversions.frames import MAP, stamp_ns
from gigabrain_zenoh.gateway.conversions.maps import in_map, planar, planar_covariance
from gigabrain_zenoh.gateway.scene import Scene, left_out
from gigabrain_zenoh.gateway.topic_requests import TopicRequests
from gigabrain_zenoh.geometry.limits import limits_of
from gigabrain_zenoh.logs import QuietFault
from gigabrain_zenoh.ros2.qos import Qos
from gigabrain_zenoh.ros2.transport import Received, RosTransport
from gigabrain_zenoh.ros2.types import Types

log = logging.getLogger(__name__)
COMMANDS = Qos(reliable=False, depth=1)  # matches every publisher; only the newest counts
TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
POSE, GUESS = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"


class RosCommander:
    """Listens to /cmd_vel, and commands the robot's gate."""

    def __init__(
        self, scene: Scene, ros: RosTransport, types: Types, config: Ros2Config, work: Background
    ) -> None:
        self._scene, self._types, self._work = scene, types, work
        self._bus, self._bad = scene.bus, QuietFault(log)
        self._config = commander.Config(
            name=scene.bus.process,
            take=config.take,
            timeout_ns=round(config.cmd_vel_timeout * 1e9),
        )
        self._memory, self._refused = Memory(), QuietFault(log)
        scene.on_state.append(self._observe)
        if not left_out(config, "cmd_vel"):
            ros.subscribe("cmd_vel", TWIST, COMMANDS, self._on_twist)
            ros.subscribe("cmd_vel", STAMPED, COMMANDS, self._on_stamped)

    @property
    def holds(self) -> bool:
        """True while it holds the body."""
        return self._memory.holds

    def offsets_s(self) -> list[float]:
        """Return how far the clocks of present senders are behind this host's [s]."""
        return commander.offsets_s(self._memory, self._now())

    def forget(self, why: str) -> None:
        """Stop commanding at once, until the sender has paused."""
        self._memory = commander.forget(self._memory, why)

    def status(self) -> Status:
        """Return a line of diagnostics: the commander, and why commands are refused."""
        counters = self._bus.counters
        values = {key: n for key, n in counters.items() if key.startswith("cmd_vel_")}
        if self._memory.refusal:
            return Status("cmd_vel", Level.WARN, f"refused: {self._memory.refusal}", values)
        return Status("cmd_vel", Level.OK, "drives" if self.holds else "no commands", values)

    def _on_twist(self, received: Received) -> None:
        twist = self._decoded(TWIST, received)
        if twist is not None:
            self._arrive(wanted_of(twist, received))

    def _on_stamped(self, received: Received) -> None:
        message = self._decoded(STAMPED, received)
        if message is None:
            return
        wanted = wanted_of(message.twist, received)
        at = stamp_ns(message.header.stamp)
        self._arrive(wanted._replace(stamp_ns=at, frame=message.header.frame_id))

    def _decoded(self, name: str, received: Received) -> Any | None:
        try:
            message = self._types.decode_command(name, received.payload)
        except BadPayload as error:
            self._bus.counters["cmd_vel_broken"] += 1
            self._bad.begin(f"dropped a message on /cmd_vel: {error}", self._bus.clock.now_ns())
            return None
        self._bad.end("/cmd_vel can be decoded again", self._bus.clock.now_ns())
        return message

    def _arrive(self, wanted: commander.Wanted) -> None:
        about = self._scene.description
        if about is None or self._scene.fresh_state is None:
            self._memory, actions = commander.silent(self._memory, self._now())
            self._act(actions)
            return
        limits, now = limits_of(about), self._now()
        self._memory, actions = commander.arrive(self._config, limits, self._memory, wanted, now)
        self._act(actions)

    def _observe(self, state: RobotState) -> None:
        self._memory, actions = commander.observe(self._config, self._memory, state, self._now())
        self._act(actions)

    def _now(self) -> Now:
        clock = self._bus.clock
        return Now(clock.now_ns(), self._scene.ros_ns(), clock.unix_ns(), clock.boot_ns())

    def _act(self, actions: Iterable[Action]) -> None:
        for action in actions:
            match action:
                case Send(velocity):
                    about = self._scene.description
                    assert about
                    command = CmdVel(**asdict(velocity), source=self._config.name)
                    self._bus.publish(command_topic(about), command)
                case Ask(take):
                    self._work.start(self._ask(take=take))
                case Refuse(code):
                    self._bus.counters[f"cmd_vel_{code}"] += 1
        now_ns = self._bus.clock.now_ns()
        if self._memory.refusal:
            self._refused.begin(f"refused /cmd_vel: {self._memory.refusal}", now_ns)
        else:
            self._refused.end("/cmd_vel is accepted again, or silent", now_ns)

    async def _ask(self, *, take: bool) -> None:
        gate, text = None, ""
        try:
            gate = (await enable(self._bus, self._config.name, take=take)).gate
        except GigabrainError as error:
            text = str(error)
        now = self._now()
        self._memory, actions = commander.answer(self._config, self._memory, gate, text, now)
        self._act(actions)


class PoseRequests:
    """Passes on poses from RViz: the initial pose, and goals."""

    def __init__(
        self, scene: Scene, ros: RosTransport, types: Types, config: Ros2Config, work: Background
    ) -> None:
        self._scene = scene
        requests = TopicRequests(scene.bus, ros, types, work)
        for topic, name, ask in (
            ("initialpose", GUESS, self._initial_pose),
            ("goal_pose", POSE, self._goal),
        ):
            if not left_out(config, topic):
                requests.serve(topic, name, ask)
        self.status = requests.status

    async def _initial_pose(self, message: Any) -> str:
        frame, guess = message.header.frame_id, message.pose
        if frame != MAP:
            raise Refused(f"frame {frame[:60]!r} is not valid for an initial pose; expected {MAP}")
        at, covariance = planar(guess.pose), planar_covariance(guess.covariance)
        bus = self._scene.bus
        request = PoseRequest(x=at.x, y=at.y, yaw=at.yaw, covariance=covariance, source=bus.process)
        replies = await bus.ask(POSE_SET, request, timeout_s=ANSWER_S)
        if not replies:
            raise Refused("no process localizes; run perception with mapping: slam or localize")
        if not replies[0].ok:
            raise Refused(replies[0].text)
        return replies[0].text

    async def _goal(self, message: Any) -> str:
        at = in_map(message.header.frame_id, planar(message.pose), self._scene.odom_in_map)
        bus = self._scene.bus
        request = GoalRequest(x=at.x, y=at.y, yaw=at.yaw, source=bus.process)
        now = asyncio.get_running_loop().time
        asked = now()
        replies = await bus.ask(GOAL, request, timeout_s=PLAN_S)
        if not replies and now() - asked >= PLAN_S:
            raise BodyLost(late(PLAN_S))
        if not replies:
            raise Refused("no process serves goals; run decision with behaviour: navigate")
        if not replies[0].ok:
            raise Refused(replies[0].text)
        return replies[0].text
