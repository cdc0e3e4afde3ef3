"""In lock-step a drive is the same for any order of arrival of the messages of a tick."""

import asyncio
import functools
import logging
import random
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from gigabrain_drivers.bodies.mock.driver import MockBody, MockOptions
from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Close, LocalNetwork, LocalTransport, OnSample
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.config.settings import DriverConfig, PerceptionConfig
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.runtime.replay import Node
from gigabrain_zenoh.testing.in_memory import BRAIN
from gigabrain_zenoh.testing.samples import round_room

# drives as close to obstacles as safety allows
CLOSE_DRIVING = PerceptionConfig(ahead=0.3, corridor=0.05, turning_room=0.0)
Pending = tuple[str, bytes, OnSample]


class ShuffledEnd(LocalTransport):
    """A transport that keeps messages until the test delivers them."""

    def __init__(self, network: LocalNetwork) -> None:
        super().__init__(network)
        self.pending: list[Pending] = []  # in order of sending

    def subscribe(self, key: str, on_sample: OnSample, depth: int, *, lazy: bool = False) -> Close:
        def queue_message(key: str, payload: bytes) -> None:
            self.pending.append((key, payload, on_sample))

        return super().subscribe(key, queue_message, depth)

    @property
    def states_pending(self) -> int:
        """Return the number of ticks that this process is behind."""
        return sum(key == STATE.key for key, _, _ in self.pending)

    def deliver_one(self, draw: random.Random) -> None:
        """Deliver a random one of the oldest messages per key; states wait for all before them."""
        heads: dict[str, Pending] = {}
        for place, entry in enumerate(self.pending):
            if entry[0] != STATE.key or place == 0:
                heads.setdefault(entry[0], entry)
        key, payload, on_sample = chosen = draw.choice(list(heads.values()))
        self.pending.remove(chosen)
        on_sample(key, payload)


class BodyInFixedRoom(MockBody):
    """The mock body, in a room that does not move with it."""

    def _scan(self) -> LaserScan | None:
        scan, pose = super()._scan(), self._pose
        assert scan
        ranges = round_room(1.2, pose.x, pose.y, pose.yaw) + self._noise.normal(0.0, 0.01, 360)
        return replace(scan, ranges=ranges_bytes(ranges))


Drive = list[tuple[int, str, Velocity, Pose]]


async def drive(folder: Path, seed: int, ticks: int) -> Drive:
    """Drive with messages shuffled by `seed`; return mode, velocity and pose at each tick."""
    draw, network, clock = random.Random(seed), LocalNetwork(), FakeClock()
    robot = load_robot("mock")
    body = BodyInFixedRoom(robot, MockOptions(driver="mock"), Run(folder=folder, speed=100.0))
    config = DriverConfig(
        body="mock", speed=100.0, lockstep_timeout_s=60.0, resume="auto", state_dir=str(folder)
    )
    ends = [ShuffledEnd(network) for _ in range(5)]
    driver_bus, *brain_buses = [Bus(end, clock) for end in ends]
    driver = DriverProcess(config, robot, body, driver_bus)
    brain: dict[str, Node] = {
        **BRAIN,
        "perception": functools.partial(perception.run, CLOSE_DRIVING),
    }
    running = [
        asyncio.ensure_future(node(bus, lambda: None))
        for bus, node in zip(brain_buses, brain.values(), strict=True)
    ]
    running.append(asyncio.ensure_future(driver.run(lambda: None)))
    while driver_bus.time.tick <= ticks:
        waiting = [end for end in ends if end.pending]
        behind = [end for end in waiting if end.states_pending > 1]
        if waiting:
            draw.choice(behind or waiting).deliver_one(draw)
        await asyncio.sleep(0)
        for task in running:
            if task.done():
                task.result()
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)
    for bus in (driver_bus, *brain_buses):
        await bus.close()
    assert driver.report()["lockstep_timeouts"] == 0
    return recorded_drive(network)[:ticks]


def recorded_drive(network: LocalNetwork) -> Drive:
    """Return tick, mode, velocity and pose of each state, once for each tick.

    The first tick is published repeatedly until the brain answers.
    """
    decode = msgspec.msgpack.Decoder(RobotState).decode
    states = {(s := decode(data)).tick: s for key, data in network.sent if key == STATE.key}
    return [(s.tick, s.gate.mode, s.velocity, s.pose) for s in states.values()]


async def test_a_drive_does_not_depend_on_the_order_of_messages(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "gigabrain_zenoh.safety")
    first, *others = [await drive(tmp_path / str(seed), seed, 350) for seed in range(6)]
    assert all(other == first for other in others)
    modes, speeds = {mode for _, mode, _, _ in first}, [v for _, _, v, _ in first]
    assert modes == {"latched", "enabled"}
    assert max(v.linear_x for v in speeds) == pytest.approx(0.26)
    assert min(v.angular_z for v in speeds) == pytest.approx(-0.5)
    stopped = [m for m in caplog.messages if m.startswith("slow: obstacle 0.15 m ahead")]
    assert len(stopped) == 6
