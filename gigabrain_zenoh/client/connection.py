"""Connects to a robot: `async with connect()`, or `with connect()` in scripts and notebooks."""

import os
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import TYPE_CHECKING, Any

from gigabrain_zenoh.client.requests import MAX_SOURCE_CHARS
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.client.sync_robot import EventLoopThread, SyncRobot
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.runtime.running import find_endpoint

ROBOT_ATTRIBUTES = frozenset(dir(SyncRobot)) | {"tasks"}
# names that a script may not use: the gate could not tell its commands from the robot's own
PROCESSES = (
    "router", "emulator", "driver", "camera", "perception", "recognition", "decision", "relay",
    "control", "safety", "page", "foxglove", "ros2", "recorder", "button",
)  # fmt: skip


class Connection:
    """A robot that is connected while a block runs: `async with`, or `with` in a script.

    It connects again with each block.
    """

    def __init__(self, open_robot: Callable[[], AbstractAsyncContextManager[Robot]]) -> None:
        self._open_robot = open_robot
        self._opening: AbstractAsyncContextManager[Robot] | None = None
        self._thread: EventLoopThread | None = None

    if not TYPE_CHECKING:  # type checkers then still report unknown attributes

        def __getattr__(self, name: str) -> None:
            """Raise AttributeError; for an attribute of a robot, with a hint how to connect."""
            hint = (
                "; use `with gigabrain_zenoh.connect() as robot:`"
                if name in ROBOT_ATTRIBUTES
                else ""
            )
            raise AttributeError(f"a connection has no {name!r}{hint}", name=name, obj=self)

    async def __aenter__(self) -> Robot:
        self._opening = self._open_robot()
        return await self._opening.__aenter__()

    async def __aexit__(self, *error: Any) -> bool | None:
        assert self._opening
        return await self._opening.__aexit__(*error)

    def __enter__(self) -> SyncRobot:
        self._thread, self._opening = EventLoopThread(), self._open_robot()
        try:
            return SyncRobot(self._thread.run(self._opening.__aenter__()), self._thread)
        except BaseException:
            self._thread.close()
            raise

    def __exit__(self, *error: Any) -> bool | None:
        assert self._thread
        assert self._opening
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
    the folder of this script's identity, if the router requires one. `source` is this script's name
    for the gate; it must not be the name of a process of the robot. With `take` the script takes
    over the body from another commander. With `wait=False` the first state is not awaited, so that
    an e-stop reaches a silent body. Raises BusError without a router, ConfigError for invalid keys
    or a wrong `source`, and BodyLost without a driver.
    """
    if len(source) > MAX_SOURCE_CHARS:
        expected = f"expected at most {MAX_SOURCE_CHARS} characters"
        raise ConfigError(f"source: {expected}, got {len(source)}")
    if source in PROCESSES:
        text = f"source: {source!r} is a process of the robot itself; choose another name"
        raise ConfigError(text)
    return Connection(lambda: _open(connect, namespace, keys, source, take, wait))


@asynccontextmanager
async def _open(
    connect: str | None, namespace: str, keys: str, source: str, take: bool, wait: bool
) -> AsyncIterator[Robot]:
    # imported late, as Zenoh takes long to import
    from gigabrain_zenoh.runtime.connect import connect as connect_bus

    endpoint = find_endpoint(connect, namespace, keys)
    async with connect_bus(endpoint, source or f"script-{os.getpid()}") as bus:
        robot = Robot(bus, take=take, keys=endpoint.keys)
        if wait:
            await robot.read_state()
        yield robot
        await robot.stop()
