"""Driver of a ROS 2 robot: its topics are the sensors, and it obeys a command topic.

The driver sends a new command at once, and repeats it. Without commands it sends zero. For a robot
that would keep driving without messages, a guard process sends zero if the driver dies.
"""

import asyncio
import contextlib
import logging
import math
import re
from typing import Any

import numpy as np
from msgspec.structs import asdict

from gigabrain_drivers.bodies.ros2 import options as ros2
from gigabrain_drivers.bodies.ros2.bringup import ADD_ORIENTATION, NO_TILT, explain
from gigabrain_drivers.bodies.ros2.conversion import (
    Unusable,
    battery_of,
    cut,
    has_orientation,
    imu_of,
    joints_of,
    scan_of,
    stamp_ns,
    yaw_of,
)
from gigabrain_drivers.bodies.ros2.frames import MAX_TILT_RAD, FrameTree, Transform, planar
from gigabrain_drivers.bodies.ros2.guard import Guard
from gigabrain_drivers.bodies.ros2.link import Opener, RosLink
from gigabrain_drivers.bodies.ros2.options import Ros2Options, check_options
from gigabrain_drivers.bodies.ros2.watch import OdometrySample, OdometryWatch
from gigabrain_drivers.driver.base import AT_REST_SPEED, Driver
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.lidars.base import ScanSource, open_lidar
from gigabrain_drivers.links.device_clock import DeviceClock
from gigabrain_drivers.links.recent import Recent
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Battery, Joint, LinkHealth, RobotState
from gigabrain_schemas.sensors import Imu, ImuData
from gigabrain_schemas.topics import IMU, SCAN
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.geometry import se2
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)

NUMBERS = re.compile(r"[\d.]+")
COMMAND_TIMEOUT_NS = 80_000_000  # without a command; zero is then sent within 100 ms
CHECK_PERIOD_NS = 20_000_000
REST_TIMEOUT_NS = 800_000_000  # at close, for the robot to come to rest
STAMP_WRAP_MS = 1 << 40
LOG_AFTER_NS = 500_000_000  # a shorter problem is not logged


class Ros2Driver(Driver):
    """Drives a ROS 2 robot by a node on its network."""

    Options = Ros2Options

    def __init__(
        self,
        robot: RobotFile,
        options: Ros2Options,
        run: Run,
        *,
        clock: Clock | None = None,
        opener: Opener | None = None,
    ) -> None:
        """Prepare. `opener` replaces the transport in the options, and then there is no guard."""
        super().__init__(robot, options, run)
        self._clock = clock or Clock()
        topics = options.topics
        self.link = RosLink(options, self._clock, opener)
        self.link.on_open = self._on_open
        guarded = options.needs_guard and not opener
        self._guard = Guard(options, self._clock, lambda: self.link.readers) if guarded else None
        self._watch = OdometryWatch(
            topics.odometry.name,
            topics.odometry.hz,
            math.hypot(robot.max_linear_speed, robot.max_lateral_speed),
            robot.max_angular_speed,
        )
        self._stamps = DeviceClock(STAMP_WRAP_MS)
        self._frames = FrameTree()
        self._battery, self._imu = Recent[Battery](), Recent[ImuData]()
        self._joints = Recent[tuple[Joint, ...]]()
        self._command = ZERO
        self._sent_ns = self._connected_ns = self._clock.now_ns()
        self._commanded_ns = self._clock.now_ns()
        # half a check period early, because checks are periodic
        self._repeat_ns = round(1e9 / topics.command.hz) - CHECK_PERIOD_NS // 2
        self._connected, self._found, self._reconnects = False, False, 0
        self._fault, self._logged_kind = Fault(log), ""
        self._no_tilt = Fault(log)
        self._task: asyncio.Task[None] | None = None
        self._lidar: ScanSource | None = None
        self.sensors = {} if robot.lidar is None else {"scan": None}
        self._listen()

    @classmethod
    def check(cls, robot: RobotFile, options: Ros2Options) -> None:
        """Raise ValueError if the topics do not fit the body."""
        check_options(options, robot)

    @property
    def problem(self) -> str:
        """The reason why the body cannot be driven, in one line; empty if it can."""
        if self.link.problem:
            return self.link.problem
        now_ns = self._clock.now_ns()
        if wrong := self._watch.problem(now_ns):
            return wrong
        if not self.link.readers:
            return f"{self.options.topics.command.name}: no node takes our commands"
        return self._guard.problem if self._guard else ""

    async def open(self) -> None:
        """Start joining ROS 2 in the background; the robot may appear later."""
        self.link.open()
        if self._guard:
            self._guard.open()
        self._lidar = open_lidar(self, self._clock)
        self._task = asyncio.create_task(self._repeat(), name="ros2 commands")

    async def close(self) -> None:
        """Send zero until the robot is at rest, and leave ROS 2."""
        task, self._task = self._task, None
        await self.stop()
        if task:
            await self._come_to_rest()
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        if self._guard:
            await self._guard.close()
        await self.link.close()
        if self._lidar:
            await self._lidar.close()

    async def stop(self) -> None:
        """Send zero velocity, at once."""
        self._commanded_ns = self._clock.now_ns()
        self._send(ZERO)

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        """Send a velocity, cut to the robot's steps; zero if a speed is not a number."""
        self._commanded_ns = self._clock.now_ns()
        wanted = cut(self.bounded(linear_x, linear_y, angular_z), self.options.topics.command.step)
        if not self._found:  # do not command a robot before its first message
            wanted = ZERO
        due = self._commanded_ns - self._sent_ns >= self._repeat_ns
        if wanted == self._command and not due:
            return wanted
        return wanted if self._send(wanted) else ZERO

    async def read_state(self) -> RobotState:
        """Return the newest values; `link` in it tells whether they are recent."""
        now_ns = self._clock.now_ns()
        self._update_link(now_ns)
        return RobotState(
            robot_type=self.robot.robot_type,
            pose=self._watch.pose,
            velocity=self._watch.velocity,
            joints=self._joints.get(now_ns) or (),
            battery=self._battery.get(now_ns),
            imu=self._imu.get(now_ns),
            link=LinkHealth(
                connected=self._connected,
                age_ms=(self._watch.age_ns(now_ns) or 0) / 1e6,
                late_ms=self._stamps.late_ms,
                errors=self._watch.errors + self.link.errors,
                reconnects=self._reconnects,
            ),
        )

    def _listen(self) -> None:
        topics, listen = self.options.topics, self.link.listen
        rows = (
            (topics.odometry, ros2.ODOMETRY, self._on_odometry),
            (topics.scan, ros2.SCAN, self._on_scan),
            (topics.imu, ros2.IMU, self._on_imu),
            (topics.battery, ros2.BATTERY, self._on_battery),
            (topics.joints, ros2.JOINTS, self._on_joints),
        )
        for topic, type, handle in rows:
            if topic:
                listen(topic.name, type, handle, reliable=topic.qos == "reliable")
        if topics.imu:
            self.sensors["imu"] = None
        if self.options.mounting == "tf_static":
            listen(ros2.TF_STATIC_TOPIC, ros2.TF, self._on_frames, reliable=True, kept=True)

    def _on_open(self) -> None:
        self._watch.restart()
        self._send(ZERO)

    def _send(self, wanted: Velocity) -> bool:
        self._command, self._sent_ns = wanted, self._clock.now_ns()
        if self._guard:
            self._guard.tell(moving=wanted != ZERO)
        return self.link.send(wanted)

    async def _repeat(self) -> None:
        """Repeat the newest command; send zero after COMMAND_TIMEOUT_NS without one."""
        async for now_ns in self._clock.every(CHECK_PERIOD_NS):
            if now_ns - self._commanded_ns >= COMMAND_TIMEOUT_NS and self._command != ZERO:
                self._send(ZERO)
            elif now_ns - self._sent_ns >= self._repeat_ns:
                self._send(self._command)
            self._update_link(now_ns)

    async def _come_to_rest(self) -> None:
        end_ns = self._clock.now_ns() + REST_TIMEOUT_NS
        while self._connected and self._clock.now_ns() < end_ns:
            now = self._watch.velocity
            if max(abs(now.linear_x), abs(now.linear_y), abs(now.angular_z)) < AT_REST_SPEED:
                return
            await self._clock.sleep_ns(CHECK_PERIOD_NS)
            self._update_link(self._clock.now_ns())

    def _update_link(self, now_ns: int) -> None:
        """Update whether the link is up, stop the robot if it is lost, and log changes."""
        problem = self.problem
        if not problem:
            self._reconnects += self._found and not self._connected
            self._connected = self._found = True
            self._connected_ns, self._logged_kind = now_ns, ""
            self._fault.end(f"{self.link}: the robot is there")
            return
        if self._connected:
            self._send(ZERO)
        self._connected = False
        kind = NUMBERS.sub("", problem)  # ignores numbers, such as durations
        if kind == self._logged_kind or now_ns - self._connected_ns < LOG_AFTER_NS:
            return
        self._logged_kind = kind
        transport = self.link.transport
        more = explain(self.options, transport.endpoints()) if transport else ""
        self._fault.end(f"{self.link}: now something else is wrong")
        self._fault.begin(f"{self.link}: {problem}{'; ' if more else ''}{more}")

    def _on_odometry(self, message: Any) -> None:
        now_ns = self._clock.now_ns()
        try:
            place = self._place_of_odometry(message.child_frame_id)
            at, velocity = message.pose.pose.position, _velocity(message.twist.twist)
            pose = _pose(at.x, at.y, yaw_of(message.pose.pose.orientation))
        except Unusable as error:
            self._watch.refuse(str(error), now_ns)
            raise
        if place is not None:
            pose, velocity = _of_body(pose, velocity, place)
        sample = OdometrySample(stamp_ns(message.header.stamp), pose, velocity)
        self._watch.add(sample, now_ns)
        self._stamps.arrived(sample.stamp_ns // 1_000_000 % STAMP_WRAP_MS, now_ns)

    def _place_of_odometry(self, frame: str) -> Floats | None:
        """Return the body's pose (3,) in the child frame; None: the same pose. Raises Unusable."""
        topic = self.options.topics.odometry
        if topic.child_frame and frame.lstrip("/") != topic.child_frame.lstrip("/"):
            raise Unusable(f"its child frame is {frame!r}; expected {topic.child_frame!r}")
        place = planar(topic.x, topic.y, topic.yaw) if (topic.x or topic.y or topic.yaw) else None
        if self.options.mounting == "tf_static":
            place = self._frame(frame)
        if place is None:
            return None
        return se2.inverse(_pose(*place.planar))

    def _frame(self, frame: str) -> Transform:
        """Return the pose of a frame in the body's frame. Raises Unusable."""
        base = self.options.base_frame
        place = self._frames.find(frame, base)
        if place is None:
            known = ", ".join(self._frames.names[:12]) or "none"
            raise Unusable(
                f"/tf_static does not connect {frame!r} with {base!r}; its frames: {known}"
            )
        return place

    def _on_scan(self, message: Any) -> None:
        lidar, options = self.robot.lidar, self.options.topics.scan
        place = None
        if self.options.mounting == "tf_static":
            place = self._frame(message.header.frame_id)
            if place.tilt > MAX_TILT_RAD:
                raise Unusable(
                    f"its frame is tilted by {math.degrees(place.tilt):.0f} degrees; "
                    "expected a level lidar"
                )
        assert lidar
        self.publish("scan", SCAN, scan_of(message, options, lidar, place))

    def _on_imu(self, message: Any) -> None:
        topic, turn = self.options.topics.imu, None
        if self.options.mounting == "tf_static":
            turn = self._frame(message.header.frame_id).turn
        elif topic.yaw:
            turn = planar(0.0, 0.0, topic.yaw).turn
        data = imu_of(message, turn)
        if has_orientation(message):
            self._no_tilt.end(f"{topic.name}: it has an orientation")
        else:
            self._no_tilt.begin(f"{topic.name}: {NO_TILT}; {ADD_ORIENTATION}")
        self._imu.put(data, self._clock.now_ns())
        self.publish("imu", IMU, Imu(**asdict(data)))

    def _on_battery(self, message: Any) -> None:
        battery = battery_of(message, self.options.topics.battery)
        self._battery.put(battery, self._clock.now_ns())

    def _on_joints(self, message: Any) -> None:
        joints = joints_of(message, self.options.topics.joints)
        self._joints.put(joints, self._clock.now_ns())

    def _on_frames(self, message: Any) -> None:
        self._frames.add(message.transforms)


def _pose(x: float, y: float, yaw: float) -> Floats:
    return np.array((x, y, yaw))


def _velocity(twist: Any) -> Velocity:
    """Return the planar velocity of a twist. The watch rejects NaN."""
    return Velocity(
        linear_x=float(twist.linear.x),
        linear_y=float(twist.linear.y),
        angular_z=float(twist.angular.z),
    )


def _of_body(pose: Floats, velocity: Velocity, body: Floats) -> tuple[Floats, Velocity]:
    """Return pose and velocity of the body from those of the child frame.

    `body` is the body's pose in that frame. The returned pose is relative to the body's start.
    """
    moved = se2.compose(se2.inverse(body), se2.compose(pose, body))
    rate = velocity.angular_z
    x = velocity.linear_x - rate * float(body[1])
    y = velocity.linear_y + rate * float(body[0])
    cos, sin = math.cos(body[2]), math.sin(body[2])
    return moved, Velocity(linear_x=cos * x + sin * y, linear_y=cos * y - sin * x, angular_z=rate)
