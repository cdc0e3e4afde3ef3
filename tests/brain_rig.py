"""A body as the brain sees it, and a bench for one node: alone on a network, in fake time."""

import asyncio
import math
from collections.abc import Awaitable, Callable
from typing import Self, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import Message, Pose, Velocity
from gigabrain_schemas.body import (
    Battery,
    Body,
    BodyDescription,
    GateStatus,
    Joint,
    Lidar,
    RobotState,
)
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from tests.bus_rig import PatientJournal

M = TypeVar("M", bound=Message)
Node = Callable[[Bus, Callable[[], None]], Awaitable[None]]

BOOT = 7
TICK_NS = 20_000_000
LIDAR = Lidar(beams=360, rate_hz=10, range_min=0.12, range_max=3.5)
WAFFLE = BodyDescription(
    robot_type="waffle",
    drive_type="differential",
    footprint=((0.075, 0.155), (-0.200, 0.155), (-0.200, -0.155), (0.075, -0.155)),
    max_linear_speed=0.26,
    max_angular_speed=1.82,
    max_linear_acceleration=1.0,
    max_linear_deceleration=1.0,
    max_angular_acceleration=3.0,
    lidar=LIDAR,
)
DRIVING = GateStatus(mode="enabled", commander="control", enables=1)


def body(description: BodyDescription = WAFFLE, *, real: bool = False, boot: int = BOOT) -> Body:
    """The body as its driver announces it."""
    return Body(description=description, link="real" if real else "sim", boot=boot)


def state(
    tick: int = 1,
    *,
    v: float = 0.0,
    w: float = 0.0,
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gate: GateStatus = DRIVING,
    battery: float = 100.0,
    motor: float | None = 30.0,
    boot: int = BOOT,
) -> RobotState:
    """What the body says of itself in `tick`."""
    x, y, yaw = pose
    return RobotState(
        robot_type="waffle",
        pose=Pose(x=x, y=y, yaw=yaw),
        velocity=Velocity(linear_x=v, angular_z=w),
        joints=(Joint(name="left_wheel", position=0.0, temperature=motor),),
        battery=Battery(voltage=12.0, percentage=battery),
        gate=gate,
        boot=boot,
        tick=tick,
        basis=tick,
    )


def scan(
    values: NDArray[np.floating],
    tick: int = 1,
    *,
    angle_min: float = 0.0,
    angle_increment: float | None = None,
    boot: int = BOOT,
) -> LaserScan:
    """One turn of the lidar, all the way round unless it is said otherwise."""
    return LaserScan(
        angle_min=angle_min,
        angle_increment=2 * math.pi / len(values) if angle_increment is None else angle_increment,
        range_min=0.12,
        range_max=3.5,
        ranges=ranges_bytes(values),
        boot=boot,
        tick=tick,
        basis=tick,
    )


def open_space(**hits_at_degrees: float) -> NDArray[np.float32]:
    """360 beams, a degree apart, that hit nothing but what is said: `deg_15=0.8`."""
    values = np.full(360, np.inf, "f4")
    for name, distance in hits_at_degrees.items():
        values[int(name.removeprefix("deg_"))] = distance
    return values


def round_room(radius: float, x: float, y: float, yaw: float) -> NDArray[np.float64]:
    """What 360 beams measure at (x, y, yaw) in a round room: |p + d u| = radius, solved for d."""
    angles = yaw + np.radians(np.arange(360.0))
    along: NDArray[np.float64] = x * np.cos(angles) + y * np.sin(angles)
    return np.sqrt(along**2 + radius**2 - x**2 - y**2) - along


class Bench:
    """One node under test. Used as `async with Bench(node) as bench:`."""

    def __init__(self, node: Node) -> None:
        self.clock, self.network = FakeClock(), LocalNetwork()
        self._node, self._read = node, 0
        self._ready = asyncio.Event()

    async def __aenter__(self) -> Self:
        self.bus = Bus(self.network.transport(), self.clock, "node")
        self.bus.journal = PatientJournal()
        self._running = asyncio.ensure_future(self._node(self.bus, self._ready.set))
        await self.clock.advance(0)
        return self

    async def ready(self) -> None:
        """Wait until the node says that it is; some compile first."""
        waiting = asyncio.ensure_future(self._ready.wait())
        await asyncio.wait((waiting, self._running), return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        if self._running.done():
            self._running.result()

    async def restart(self) -> None:
        """End the node, and start it anew."""
        await self._end()
        self._ready.clear()
        await self.__aenter__()

    async def __aexit__(self, *_: object) -> None:
        await self._end()

    async def _end(self) -> None:
        self._running.cancel()
        result = (await asyncio.gather(self._running, return_exceptions=True))[0]
        await self.bus.close()
        assert isinstance(result, asyncio.CancelledError), result

    def send(self, topic: Topic[M], message: M) -> None:
        """Hand `message` to the node as it is, header and all."""
        self.network.deliver(topic.at(), codec.encode(message))

    def sent(self, topic: Topic[M]) -> list[M]:
        """What the node has sent on `topic` since this was last asked, and nothing else."""
        new = self.network.sent[self._read :]
        self._read = len(self.network.sent)
        decode = msgspec.msgpack.Decoder(topic.type).decode
        return [decode(payload) for key, payload in new if key == topic.key]
