"""Connects to a robot: `async with connect()`, or `with connect()` in scripts and notebooks."""

import asyncio
import os
import threading
from collections.abc import AsyncIterator, Coroutine, Iterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any, TypeVar, overload

from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.requests import GateReply
from gigabrain_schemas.tasks import Task
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.client.motion import Reached
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.runtime.running import find_endpoint

M = TypeVar("M", bound=Message)
T = TypeVar("T")


class EventLoopThread:
    """An event loop in a thread of its own, which runs coroutines for other threads."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(
            target=self._loop.run_forever, name="gigabrain", daemon=True
        )
        self._thread.start()

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run `coroutine` and return its result; an interrupt cancels it."""
        future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def close(self) -> None:
        """Stop the loop and its thread."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


class SyncRobot:
    """A running robot; each call returns when it is done. See `Robot` for details."""

    def __init__(self, robot: Robot, loop: EventLoopThread) -> None:
        self._robot, self._run = robot, loop.run

    def move(self, distance: float, *, speed: float | None = None) -> Reached:
        """Drive straight by `distance` [m], backwards if it is negative."""
        return self._run(self._robot.move(distance, speed=speed))

    def turn(self, angle: float, *, speed: float | None = None) -> Reached:
        """Turn on the spot by `angle` [rad], counter-clockwise if it is positive."""
        return self._run(self._robot.turn(angle, speed=speed))

    def goto(self, x: float | str, y: float | None = None, yaw: float | None = None) -> Task:
        """Send the robot to a pose [m, m, rad] or a place's name, and wait until it arrives."""
        return self._run(self._robot.goto(x, y, yaw))

    def drive(self, linear_x: float = 0.0, angular_z: float = 0.0, *, seconds: float) -> None:
        """Drive [m/s, rad/s] for `seconds` of the robot's time, then stop."""
        self._run(self._robot.drive(linear_x, angular_z, seconds=seconds))

    def set_base_velocity(
        self, linear_x: float, linear_y: float = 0.0, angular_z: float = 0.0
    ) -> Velocity:
        """Drive [m/s, m/s, rad/s] for one second, or until the next call."""
        return self._run(self._robot.set_base_velocity(linear_x, linear_y, angular_z))

    def stop(self) -> None:
        """Come to rest."""
        self._run(self._robot.stop())

    def estop(self, reason: str = "") -> GateReply:
        """Stop at once and latch."""
        return self._run(self._robot.estop(reason))

    def release(self) -> GateReply:
        """Release a latched robot."""
        return self._run(self._robot.release())

    def enable(self, source: str = "", *, take: bool = False) -> GateReply:
        """Ask for the body, for this script or for `source`."""
        return self._run(self._robot.enable(source, take=take))

    @property
    def state(self) -> RobotState | None:
        """The newest state; None while the robot is silent."""
        return self._robot.state

    def read_state(self) -> RobotState:
        """Return the newest state."""
        return self._run(self._robot.read_state())

    def read_body(self) -> BodyDescription:
        """Return the body's limits, footprint and sensors."""
        return self._run(self._robot.read_body())

    def get_sensor_data(self, sensor_name: str) -> Message:
        """Return the next message of `scan`, `imu` or another topic."""
        return self._run(self._robot.get_sensor_data(sensor_name))

    @overload
    def topic(self, topic: Topic[M]) -> Iterator[M]: ...

    @overload
    def topic(self, topic: str) -> Iterator[Any]: ...

    def topic(self, topic: Topic[M] | str) -> Iterator[M]:
        """Yield each message on a topic: `for scan in robot.topic("scan")`."""
        messages = self._robot.topic(topic)
        while True:
            try:
                yield self._run(_next_of(messages))
            except StopAsyncIteration:
                return


async def _next_of(messages: AsyncIterator[M]) -> M:
    return await anext(messages)


class Connection:
    """A robot that is connected while a block runs: `async with`, or `with` in a script."""

    def __init__(self, opening: AbstractAsyncContextManager[Robot]) -> None:
        self._opening = opening
        self._thread: EventLoopThread | None = None

    async def __aenter__(self) -> Robot:
        return await self._opening.__aenter__()

    async def __aexit__(self, *error: Any) -> bool | None:
        return await self._opening.__aexit__(*error)

    def __enter__(self) -> SyncRobot:
        self._thread = EventLoopThread()
        try:
            return SyncRobot(self._thread.run(self._opening.__aenter__()), self._thread)
        except BaseException:
            self._thread.close()
            raise

    def __exit__(self, *error: Any) -> bool | None:
        assert self._thread
        try:
            return self._thread.run(self._opening.__aexit__(*error))
        finally:
            self._thread.close()


def connect(
    connect: str | None = None,
    *,
    namespace: str = "",
    keys: str = "",
    source: str = "",
    take: bool = False,
    wait: bool = True,
) -> Connection:
    """Connect to a robot, with `async with` or, in a script without asyncio, with `with`.

    `connect` is its router's Zenoh endpoint; by default the only robot on this machine. `keys` is
    the folder of this script's identity, if the router requires one. `source` names this script to
    the gate; with `take` it takes the body over from another commander. With `wait=False` the
    first state is not awaited, so that an e-stop reaches a silent body. Raises BusError without a
    router, ConfigError for invalid keys, and BodyLost without a driver.
    """
    return Connection(_open(connect, namespace, keys, source, take, wait))


@asynccontextmanager
async def _open(
    connect: str | None, namespace: str, keys: str, source: str, take: bool, wait: bool
) -> AsyncIterator[Robot]:
    # imported only when used, since Zenoh takes a while
    from gigabrain_zenoh.runtime.connect import connect as connect_bus

    endpoint = find_endpoint(connect, namespace, keys)
    async with connect_bus(endpoint, source or f"script-{os.getpid()}") as bus:
        robot = Robot(bus, take=take, keys=endpoint.keys)
        if wait:
            await robot.read_state()
        yield robot
        await robot.stop()
