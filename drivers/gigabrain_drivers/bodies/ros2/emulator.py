"""Emulates a ROS 2 robot: its nodes and its board, with simulated physics.

As in a TurtleBot3, a command is valid until the next one, without a time limit, unless the robot's
file promises a watchdog. If the nodes freeze or end, the board stops the motors.
"""

import asyncio
import contextlib
import errno
import logging
import math
import random
import socket
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from gigabrain_drivers.bodies.ros2 import options as ros2
from gigabrain_drivers.bodies.ros2.conversion import NANO, cut
from gigabrain_drivers.bodies.ros2.link import all_types
from gigabrain_drivers.bodies.ros2.options import TWIST_STAMPED, Address, Ros2Options
from gigabrain_drivers.emulators.base import Device, EmulatedBody, Port, Sweep, Wire
from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.bus.zenoh.session import open_session
from gigabrain_zenoh.config.settings import Endpoint, Ros2Link
from gigabrain_zenoh.errors import BadPayload, GigabrainError
from gigabrain_zenoh.geometry.limits import clamp, limits_of
from gigabrain_zenoh.logs import Fault
from gigabrain_zenoh.ros2.opening import open_transport
from gigabrain_zenoh.ros2.qos import LATCHED, SENSOR_DATA, Qos
from gigabrain_zenoh.ros2.transport import RosPublisher, RosTransport

log = logging.getLogger(__name__)

NODE = "emulated_robot"
HEARTBEAT_NS = 500_000_000  # the board stops the motors after this time without its nodes
NAME_END = b"\0"  # after a topic's name, in a frame between device and port
QUEUE = 10  # commands that wait while the node is frozen
DOMAINS = range(101, 200)  # for emulators, with ports below Linux's ephemeral ones
BASE, ODOM, SCAN_FRAME, IMU_FRAME = "base_footprint", "odom", "base_scan", "imu_link"
LIDAR_HEIGHT_M = 0.182


def frame(topic: str, payload: bytes) -> bytes:
    """Encode a message as a frame between device and port."""
    return topic.encode() + NAME_END + payload


class RosPort:
    """The robot's nodes on a transport; their address is in the file `path`."""

    def __init__(self, path: Path, options: Ros2Options) -> None:
        self.path, self._options = path, options
        self.on_bytes: Callable[[bytes], None] = lambda data: None
        self._publishers: dict[str, RosPublisher] = {}
        self._address: Address | None = None
        self._plugged = False
        self._running: asyncio.Task[None] | None = None
        self._endings: set[asyncio.Task[None]] = set()

    def plug(self) -> None:
        """Start the nodes. Does nothing if they are running."""
        if self._plugged:
            return
        self._plugged = True
        self._running = asyncio.create_task(self._run(self._running), name="emulated nodes")

    def unplug(self) -> None:
        """End the nodes. Does nothing if they have ended."""
        self._plugged = False
        self._publishers = {}
        if self._running and not self._running.done():
            self._running.cancel()
            self._endings.add(self._running)
            self._running.add_done_callback(self._endings.discard)

    def write(self, data: bytes) -> bool:
        """Publish a frame; return False while the nodes are unplugged."""
        name, _, payload = data.partition(NAME_END)
        publisher = self._publishers.get(name.decode("ascii", "replace"))
        if publisher:
            publisher.publish(payload)
        return self._plugged

    async def _run(self, previous: "asyncio.Task[None] | None") -> None:
        """Run the nodes until cancelled, once the previous task has ended."""
        if previous:
            await asyncio.wait((previous,))
        fault = Fault(log)
        while True:
            try:
                async with self._joined() as transport:
                    fault.end("emulated nodes: joined")
                    self._attach(transport)
                    await asyncio.Event().wait()
            except GigabrainError as error:
                fault.begin(f"emulated nodes: {error}")
                self._address = None  # another process may have taken it meanwhile
                await asyncio.sleep(0.5)

    @contextlib.asynccontextmanager
    async def _joined(self) -> AsyncIterator[RosTransport]:
        types = await asyncio.to_thread(all_types)
        options = self._options
        link = Ros2Link(
            transport=options.transport,
            namespace=options.namespace,
            node=NODE,
            distro=options.distro,
            localhost=options.transport == "dds",
        )
        async with contextlib.AsyncExitStack() as stack:
            address = self._address = self._address or _free_address(options)
            if address.router:
                await _open_router(stack, address.router)
            changes = msgspec.structs.asdict(address)
            link = msgspec.structs.replace(link, **changes)
            transport = await stack.enter_async_context(open_transport(link, types))
            self.path.parent.mkdir(parents=True, exist_ok=True)
            new = self.path.with_name(f".{self.path.name}.new")
            new.write_bytes(msgspec.json.encode(address))
            new.replace(self.path)
            stack.callback(self.path.unlink, missing_ok=True)
            yield transport

    def _attach(self, transport: RosTransport) -> None:
        topics = self._options.topics
        command = topics.command
        for topic, type, qos in published(self._options):
            self._publishers[topic] = transport.publisher(topic, type, qos)
        transport.subscribe(
            command.name,
            command.type,
            Qos(depth=QUEUE),
            lambda received: self._on_received(command.name, received.payload),
        )

    def _on_received(self, topic: str, payload: bytes) -> None:
        if self._plugged:
            self.on_bytes(frame(topic, payload))


def _free_address(options: Ros2Options) -> Address:
    """Return an unused address. The caller keeps it when the nodes restart."""
    if options.transport == "dds":
        return Address(domain=free_domain())
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return Address(router=f"tcp/127.0.0.1:{probe.getsockname()[1]}")


async def _open_router(stack: contextlib.AsyncExitStack, endpoint: str) -> None:
    session = await open_session(Endpoint(listen=(endpoint,)))
    stack.push_async_callback(asyncio.to_thread, session.close)


def free_domain() -> int:
    """Return a DDS domain without participants on this machine. Raises OSError."""
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        first = 7400 + 250 * domain
        with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
            for port in (first, first + 10, first + 11):
                probe = stack.enter_context(socket.socket(type=socket.SOCK_DGRAM))
                probe.bind(("", port))
            return domain
    raise OSError(errno.EADDRINUSE, "all DDS domains are in use")


def published(options: Ros2Options) -> list[tuple[str, str, Qos]]:
    """Return (topic, type, offered QoS) of all topics that a robot publishes."""
    topics = options.topics
    found = [(topics.odometry.name, ros2.ODOMETRY, Qos())]
    if topics.scan:
        reliable = topics.scan.qos == "reliable"
        found.append((topics.scan.name, ros2.SCAN, Qos() if reliable else SENSOR_DATA))
    for topic, type in (
        (topics.imu, ros2.IMU),
        (topics.battery, ros2.BATTERY),
        (topics.joints, ros2.JOINTS),
    ):
        if topic:
            found.append((topic.name, type, Qos()))
    found.append((ros2.TF_TOPIC, ros2.TF, Qos(depth=100)))
    found.append((ros2.TF_STATIC_TOPIC, ros2.TF, LATCHED))
    return found


class Ros2Robot(Device):
    """Publishes sensor data at the rates in the robot's file, and obeys its command topic."""

    Options = Ros2Options
    period_s = 0.01
    watchdog_ns = HEARTBEAT_NS
    promised_in = "the board, without its nodes"

    def __init__(self, body: EmulatedBody, options: Any, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self._options: Ros2Options = options
        self._types = all_types()
        self._limits = limits_of(body.robot)
        watchdog = options.watchdog
        self._watchdog_ns = None if watchdog == "none" else round(watchdog * 1e9)
        if self._watchdog_ns:
            self.watchdog_ns, self.promised_in = self._watchdog_ns, "its file"
        self._lidar = options.lidar or body.robot.lidar
        self._sweep: Sweep | None = None
        if options.topics.scan and self._lidar:
            self._sweep = Sweep(body, self._lidar.range_min, self._lidar.range_max)
        self._state_ns = round(1e9 / options.topics.odometry.hz)
        self.reset()

    @classmethod
    def port(cls, options: Any) -> Port:
        """Return the nodes on the transport; the file `options.port` has their address."""
        return RosPort(Path(options.port), options)

    def reset(self) -> None:
        """Restart: wheels at rest, odometry at zero."""
        self._obeyed_ns: int | None = None
        self._alive_ns: int | None = None  # the newest time at which the nodes ran
        self._next_ns = self._static_ns = 0
        self._start = self.body.snapshot.odometry
        self.body.command(0.0, 0.0, 0.0)
        if self._sweep and self._lidar:
            beams, hz = self._lidar.beams, self._lidar.rate_hz
            self._sweep.start(beams * hz, hz)

    def feed(self, data: bytes) -> None:
        """Obey received commands, at most the QUEUE newest ones."""
        command = self._options.topics.command
        name = command.name.encode() + NAME_END
        for payload in data.split(name)[1:][-QUEUE:]:
            with contextlib.suppress(BadPayload):
                self._obey(self._types.decode(command.type, payload))

    def _obey(self, message: Any) -> None:
        stamped = self._options.topics.command.type == TWIST_STAMPED
        twist = message.twist if stamped else message
        speeds = (twist.linear.x, twist.linear.y, twist.angular.z)
        if not all(map(math.isfinite, speeds)):
            return
        x, y, z = map(float, speeds)
        wanted = clamp(Velocity(linear_x=x, linear_y=y, angular_z=z), self._limits)
        wanted = cut(wanted, self._options.topics.command.step)
        self._obeyed_ns = time.monotonic_ns()
        self.body.command(wanted.linear_x, wanted.linear_y, wanted.angular_z)

    def step(self, now_ns: int) -> None:
        """Stop the motors if nodes or commands are missing, and publish due messages."""
        if not self.halted or self._alive_ns is None:
            self._alive_ns = now_ns
        watched_ns = self._watchdog_ns and self._obeyed_ns
        if now_ns - self._alive_ns >= HEARTBEAT_NS or (
            watched_ns and now_ns - watched_ns >= (self._watchdog_ns or 0)
        ):
            self.body.command(0.0, 0.0, 0.0)
        self._scan()
        if now_ns < self._next_ns:
            return
        self._next_ns = max(self._next_ns + self._state_ns, now_ns - self._state_ns)
        self._report()
        if now_ns >= self._static_ns:  # repeated for late subscribers that are volatile
            self._static_ns = now_ns + NANO
            self._send(ros2.TF_STATIC_TOPIC, ros2.TF, transforms=self._static_transforms())

    def _send(self, topic: str, type: str, **fields: Any) -> None:
        payload = self._types.encode(type, self._types.make(type, **fields))
        self.wire.write(frame(topic, payload))

    def _report(self) -> None:
        snapshot, topics = self.body.snapshot, self._options.topics
        odometry, start = snapshot.odometry, self._start
        yaw = odometry.yaw
        position = {"x": odometry.x - start.x, "y": odometry.y - start.y}
        pose = {"position": position, "orientation": _heading(yaw)}
        twist = {"linear": {"x": odometry.linear_x}, "angular": {"z": odometry.angular_z}}
        self._send(
            topics.odometry.name,
            ros2.ODOMETRY,
            header=_header(ODOM),
            child_frame_id=topics.odometry.child_frame or BASE,
            pose={"pose": pose},
            twist={"twist": twist},
        )
        moved = {"translation": position, "rotation": _heading(yaw)}
        link = {"header": _header(ODOM), "child_frame_id": BASE, "transform": moved}
        self._send(ros2.TF_TOPIC, ros2.TF, transforms=[link])
        if topics.imu:
            self._send(topics.imu.name, ros2.IMU, **_imu(snapshot.imu))
        if topics.battery:
            volts = max(snapshot.battery.voltage - self.sag_volts, 0.0)
            share = snapshot.battery.percentage / 100 * topics.battery.full
            values = {"voltage": volts, "percentage": share, "current": -snapshot.battery.current}
            self._send(topics.battery.name, ros2.BATTERY, header=_header(""), **values)
        if topics.joints:
            factor = topics.joints.velocity_factor or 1.0
            self._send(
                topics.joints.name,
                ros2.JOINTS,
                header=_header("base_link"),
                name=[wheel.name for wheel in snapshot.wheels],
                position=np.array([wheel.position for wheel in snapshot.wheels]),
                velocity=np.array([wheel.velocity / factor for wheel in snapshot.wheels]),
                effort=np.array([]),
            )

    def _scan(self) -> None:
        topic, lidar = self._options.topics.scan, self._lidar
        if not (self._sweep and topic and lidar):
            return
        samples = self._sweep.next_samples(lidar.beams)
        if not samples:
            return
        ranges = np.full(lidar.beams, np.nan, np.float32)
        index = np.rint([-s.angle * lidar.beams / 360 for s in samples]).astype(int) % lidar.beams
        metres = np.array([s.distance / 1000 for s in samples], np.float32)
        ranges[index] = np.where(metres > 0, metres, np.nan if topic.nan == "no_return" else np.inf)
        self._send(
            topic.name,
            ros2.SCAN,
            header=_header(SCAN_FRAME),
            angle_min=0.0,
            angle_max=math.tau * (1 - 1 / lidar.beams),
            angle_increment=math.tau / lidar.beams,
            time_increment=1 / lidar.rate_hz / lidar.beams,
            scan_time=1 / lidar.rate_hz,
            range_min=lidar.range_min,
            range_max=lidar.range_max,
            ranges=ranges,
            intensities=np.array([], np.float32),
        )

    def _static_transforms(self) -> list[dict[str, Any]]:
        """Return the static transforms of the sensors."""
        lidar = self._lidar
        places: dict[str, tuple[float, float, float, float]] = {IMU_FRAME: (0.0, 0.0, 0.068, 0.0)}
        if lidar:
            places[SCAN_FRAME] = (lidar.x, lidar.y, LIDAR_HEIGHT_M, lidar.yaw)
        return [
            {
                "header": _header(BASE),
                "child_frame_id": child,
                "transform": {
                    "translation": {"x": x, "y": y, "z": z},
                    "rotation": _heading(yaw),
                },
            }
            for child, (x, y, z, yaw) in places.items()
        ]


def _header(frame_id: str) -> dict[str, Any]:
    now_ns = time.time_ns()
    return {"stamp": {"sec": now_ns // NANO, "nanosec": now_ns % NANO}, "frame_id": frame_id}


def _heading(yaw: float) -> dict[str, float]:
    return {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def _imu(sample: Any) -> dict[str, Any]:
    x, y, z, w = sample.orientation
    return {
        "header": _header(IMU_FRAME),
        "orientation": {"x": x, "y": y, "z": z, "w": w},
        "angular_velocity": dict(zip("xyz", sample.angular_velocity, strict=True)),
        "linear_acceleration": dict(zip("xyz", sample.linear_acceleration, strict=True)),
    }
