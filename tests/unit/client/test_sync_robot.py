"""The robot for scripts without asyncio offers all that the asynchronous one does."""

import asyncio
import contextlib
import inspect
import signal
import threading
from collections.abc import Callable, Iterator

import pytest

from gigabrain_schemas.tasks import Task, TaskReply, TaskRequest, TaskState, TaskStatus
from gigabrain_schemas.topics import TASK, TASK_CHANGE
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.client.sync_robot import EventLoopThread, SyncRobot, SyncTasks
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.errors import BusError
from gigabrain_zenoh.testing.in_memory import Net


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


@pytest.mark.filterwarnings("error")  # as of a coroutine that was never awaited
def test_a_robot_that_outlived_its_block_says_how_to_connect_again() -> None:
    with tasks_of_a_robot() as tasks:
        pass
    with pytest.raises(
        BusError, match=r"closed.*use `with gigabrain_zenoh\.connect\(\) as robot:`"
    ):
        tasks.explore()
    with pytest.raises(BusError, match="closed"):
        tasks.result("goal-1", lambda _: None)


async def serve_task(net: Net) -> None:
    """Publish a task that goes on until somebody pauses it."""
    state: TaskState = "active"

    async def pause(request: TaskRequest) -> TaskReply:
        nonlocal state
        state = "succeeded"
        return TaskReply(ok=True, text="paused", task=request.task)

    net.one.serve(TASK_CHANGE, pause)
    while True:
        task = Task(id="goal-1", kind="goal", label="goal", source="ann", state=state)
        active = state == "active"
        net.one.publish(TASK, TaskStatus(current=task) if active else TaskStatus(done=(task,)))
        await asyncio.sleep(0.01)


@contextlib.contextmanager
def tasks_of_a_robot() -> Iterator[SyncTasks]:
    thread = EventLoopThread()

    async def start() -> tuple[Tasks, object]:
        net = Net()
        return Tasks(net.two), asyncio.ensure_future(serve_task(net))

    tasks, _serving = thread.run(start())
    yield SyncTasks(tasks, thread)
    thread.close()


def test_a_callback_may_use_the_robot_as_it_is_called_in_the_scripts_own_thread() -> None:
    with tasks_of_a_robot() as tasks:
        said = list[str]()

        def on_status(_: TaskStatus) -> None:
            assert threading.current_thread() is threading.main_thread()  # else it hangs here:
            said.append(tasks.pause("goal-1"))

        assert tasks.result("goal-1", on_status).state == "succeeded"
        assert set(said) == {"paused"}


def test_an_error_in_a_callback_reaches_the_script_and_ends_the_wait() -> None:
    with tasks_of_a_robot() as tasks:

        def on_status(_: TaskStatus) -> None:
            raise KeyError("of the script")

        with pytest.raises(KeyError, match="of the script"):
            tasks.result("goal-1", on_status)
        tasks.pause("goal-1")
        assert tasks.result("goal-1").state == "succeeded"


async def tidied(tidy: list[str], ready: Callable[[], object]) -> None:
    """Run `ready`, and tidy up slowly once cancelled, as `goto` cancels its goal."""
    try:
        await asyncio.sleep(0.05)  # the script waits by then
        ready()
        await asyncio.Event().wait()
    finally:
        await asyncio.sleep(0.05)
        tidy.append("done")


def test_an_interrupt_waits_until_the_call_has_tidied_up() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    thread, tidy, main = EventLoopThread(), list[str](), threading.main_thread().ident
    assert main
    try:
        with pytest.raises(KeyboardInterrupt):
            thread.run(tidied(tidy, lambda: signal.pthread_kill(main, signal.SIGINT)))
        assert tidy == ["done"]
    finally:
        signal.signal(signal.SIGINT, before)
        thread.close()


def test_an_error_in_a_callback_waits_as_well() -> None:
    thread, tidy = EventLoopThread(), list[str]()

    def fail(_: int) -> None:
        raise KeyError("of the script")

    with pytest.raises(KeyError):
        thread.run_calling(lambda take: tidied(tidy, lambda: take(1)), fail)
    assert tidy == ["done"]
    thread.close()
