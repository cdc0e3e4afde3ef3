"""The robot for scripts without asyncio offers all that the asynchronous one does."""

import asyncio
import inspect

import pytest

from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.client.sync_robot import EventLoopThread, SyncRobot, SyncTasks
from gigabrain_zenoh.client.tasks import Tasks


def public(kind: type) -> dict[str, list[tuple[str, object, object]]]:
    """The parameters of each public method."""
    functions = inspect.getmembers(kind, inspect.isfunction)
    found = {name: inspect.signature(one).parameters.values() for name, one in functions}
    return {
        name: [(one.name, one.kind, one.default) for one in given]
        for name, given in found.items()
        if name[0] != "_"
    }


@pytest.mark.parametrize(("sync", "asynchronous"), [(SyncRobot, Robot), (SyncTasks, Tasks)])
def test_each_method_is_there_with_the_same_parameters(sync: type, asynchronous: type) -> None:
    assert public(sync) == public(asynchronous)


def test_closing_ends_what_an_interrupt_left_running() -> None:
    thread, ended = EventLoopThread(), []

    async def forever() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ended.append(True)

    async def start() -> asyncio.Task[None]:
        task = asyncio.ensure_future(forever())
        await asyncio.sleep(0)
        return task

    task = thread.run(start())
    thread.close()
    assert (ended, task.cancelled()) == ([True], True)
