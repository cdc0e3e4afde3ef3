"""Connects to a robot: `async with connect()`, or `with connect()` in scripts and notebooks."""

import os
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any

from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.client.sync_robot import EventLoopThread, SyncRobot
from gigabrain_zenoh.runtime.running import find_endpoint


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
