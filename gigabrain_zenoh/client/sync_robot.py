"""A robot for scripts and notebooks without asyncio: each call returns when it is done."""

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar, overload

from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.body import BodyDescription, Joint, RobotState
from gigabrain_schemas.logs import AuditRecord
from gigabrain_schemas.objects import ObjectMap
from gigabrain_schemas.requests import GateReply
from gigabrain_schemas.tasks import How, Task, TaskStatus
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.client.motion import Reached
from gigabrain_zenoh.client.requests import closed
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.client.tasks import OnStatus, Tasks

M = TypeVar("M", bound=Message)
T = TypeVar("T")

CLEAN_UP_TIMEOUT_S = 10.0  # for a cancelled call to end


class EventLoopThread:
    """An event loop in a thread of its own, which runs coroutines for other threads."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(
            target=self._loop.run_forever, name="gigabrain", daemon=True
        )
        self._thread.start()

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run `coroutine` and return its result.

        An interrupt cancels it and waits until it ends, as its clean-up may cancel a goal.
        """
        with self._running(coroutine) as future:
            return future.result()

    def run_calling(
        self,
        start: Callable[[Callable[[M], None]], Coroutine[Any, Any, T]],
        call: Callable[[M], None],
    ) -> T:
        """Run the coroutine that `start` creates from a callback, and return its result.

        The newest message given to the callback is passed to `call` in the calling thread.
        """
        newest, arrived = deque[M](maxlen=1), threading.Event()

        def on_message(message: M) -> None:
            newest.append(message)
            arrived.set()

        with self._running(start(on_message)) as future:
            future.add_done_callback(lambda _: arrived.set())
            while not future.done():
                arrived.wait()
                arrived.clear()
                if newest:
                    call(newest.pop())
            return future.result()

    @contextlib.contextmanager
    def _running(self, coroutine: Coroutine[Any, Any, T]) -> Iterator[Future[T]]:
        """Run `coroutine` while a block waits for it, and cancel it if the block is interrupted.

        Raises BusError if the loop is closed, as in a notebook's cell after the `with` block.
        """
        if self._loop.is_closed():
            coroutine.close()
            raise closed("with")
        started, ended = threading.Event(), threading.Event()

        async def work() -> T:
            started.set()
            try:
                return await coroutine
            finally:
                ended.set()

        future = asyncio.run_coroutine_threadsafe(work(), self._loop)
        try:
            yield future
        except BaseException:
            if future.cancel() and started.is_set():
                ended.wait(CLEAN_UP_TIMEOUT_S)
            raise

    def close(self) -> None:
        """Cancel all tasks, and stop the loop and its thread."""
        self.run(_cancel_others())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


async def _cancel_others() -> None:
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)
    await asyncio.get_running_loop().shutdown_asyncgens()


class SyncTasks:
    """The tasks of one robot; each call returns when it is done. See `Tasks` for details."""

    def __init__(self, tasks: Tasks, loop: EventLoopThread) -> None:
        self._tasks, self._run, self._run_calling = tasks, loop.run, loop.run_calling

    def go_to(self, x: float, y: float, yaw: float | None = None, *, how: How = "replace") -> str:
        """Send the robot to a pose in the map [m, m, rad]; return the task's name."""
        return self._run(self._tasks.go_to(x, y, yaw, how=how))

    def go_to_place(self, name: str, yaw: float | None = None, *, how: How = "replace") -> str:
        """Send the robot to a named place of the map; return the task's name."""
        return self._run(self._tasks.go_to_place(name, yaw, how=how))

    def carry_out(
        self, mission: str | Path, *, how: How = "replace", label: str = "mission"
    ) -> str:
        """Start a mission, given as a file or as its text; return the task's name."""
        return self._run(self._tasks.carry_out(mission, how=how, label=label))

    def go_to_object(self, label: str = "", *, tag: int | None = None, how: How = "replace") -> str:
        """Send the robot to a thing of a class, or to a tag; return the task's name."""
        return self._run(self._tasks.go_to_object(label, tag=tag, how=how))

    def explore(self, *, how: How = "replace") -> str:
        """Start exploring until nothing unknown is reachable; return the task's name."""
        return self._run(self._tasks.explore(how=how))

    def cancel(self, task: str = "") -> str:
        """Cancel a task by name, the current one (empty name), or `all`; return the reply."""
        return self._run(self._tasks.cancel(task))

    def pause(self, task: str = "") -> str:
        """Pause a task; return the reply in words."""
        return self._run(self._tasks.pause(task))

    def resume(self, task: str = "") -> str:
        """Resume a paused task; return the reply in words."""
        return self._run(self._tasks.resume(task))

    def status(self) -> TaskStatus:
        """Return the current, the waiting and the most recent ended tasks."""
        return self._run(self._tasks.status())

    def result(self, task: str, on_status: OnStatus | None = None) -> Task:
        """Wait until a task has ended, and return it; meanwhile call `on_status` in this thread.

        `on_status` may use the robot.
        """
        if on_status is None:
            return self._run(self._tasks.result(task))
        return self._run_calling(lambda callback: self._tasks.result(task, callback), on_status)


class SyncRobot:
    """A running robot; each call returns when it is done. See `Robot` for details."""

    def __init__(self, robot: Robot, loop: EventLoopThread) -> None:
        self._robot, self._run = robot, loop.run
        self.tasks = SyncTasks(robot.tasks, loop)

    def move(self, distance: float, *, speed: float | None = None) -> Reached:
        """Drive straight by `distance` [m], backwards if it is negative."""
        return self._run(self._robot.move(distance, speed=speed))

    def turn(self, angle: float, *, speed: float | None = None) -> Reached:
        """Turn on the spot by `angle` [rad], counter-clockwise if it is positive."""
        return self._run(self._robot.turn(angle, speed=speed))

    def goto(
        self,
        x: float | str | None = None,
        y: float | None = None,
        yaw: float | None = None,
        *,
        object: str = "",
        tag: int | None = None,
    ) -> Task:
        """Send the robot to a pose [m, m, rad], a place's name, an object or a tag, and wait."""
        return self._run(self._robot.goto(x, y, yaw, object=object, tag=tag))

    def objects(self) -> ObjectMap:
        """Return the things and tags that the cameras have recognised."""
        return self._run(self._robot.objects())

    def drive(self, linear_x: float = 0.0, angular_z: float = 0.0, *, seconds: float) -> None:
        """Drive [m/s, rad/s] for `seconds` of the robot's time, then stop."""
        self._run(self._robot.drive(linear_x, angular_z, seconds=seconds))

    def set_base_velocity(
        self, linear_x: float, linear_y: float = 0.0, angular_z: float = 0.0
    ) -> Velocity:
        """Drive [m/s, m/s, rad/s] for one second, or until the next call."""
        return self._run(self._robot.set_base_velocity(linear_x, linear_y, angular_z))

    def steer(self, wanted: Velocity) -> None:
        """Publish an operator's velocity to the robot's control; repeat at 20 Hz."""
        self._run(_called(lambda: self._robot.steer(wanted)))

    def jog(self, speeds: Mapping[str, float]) -> None:
        """Publish an operator's velocities of joints [rad/s or m/s]; repeat at 20 Hz."""
        self._run(_called(lambda: self._robot.jog(speeds)))

    def limp(self) -> GateReply:
        """Let go of all joints, so that a person can move them; an arm may fall."""
        return self._run(self._robot.limp())

    def hold(self) -> GateReply:
        """Hold limp joints again, where they are."""
        return self._run(self._robot.hold())

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

    def audit(self, newest: int = 100) -> tuple[AuditRecord, ...]:
        """Return the newest entries of all audit logs, oldest first."""
        return self._run(self._robot.audit(newest))

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

    def get_joint_states(self) -> tuple[Joint, ...]:
        """Return all measured joints."""
        return self._run(self._robot.get_joint_states())

    def set_joint_position(
        self, joint_name: str, position: float, *, speed: float | None = None, wait: bool = True
    ) -> float:
        """Move one joint to a position [rad or m]; return the measured one."""
        return self._run(
            self._robot.set_joint_position(joint_name, position, speed=speed, wait=wait)
        )

    def set_joint_positions(
        self, positions: Mapping[str, float], *, speed: float | None = None, wait: bool = True
    ) -> dict[str, float]:
        """Move joints together to positions [rad or m]; return those of all, as measured."""
        return self._run(self._robot.set_joint_positions(positions, speed=speed, wait=wait))

    def track_joint_positions(
        self, positions: Mapping[str, float], *, speed: float | None = None
    ) -> dict[str, float]:
        """Make joints follow changing positions [rad or m]; return the commanded ones."""
        return self._run(self._robot.track_joint_positions(positions, speed=speed))

    def set_joint_trajectory(
        self, points: Sequence[tuple[float, Mapping[str, float]]], *, wait: bool = True
    ) -> dict[str, float]:
        """Follow points, each a time from now [s] and positions by joint [rad or m]."""
        return self._run(self._robot.set_joint_trajectory(points, wait=wait))

    def get_sensor_data(self, sensor_name: str) -> Message:
        """Return the next message of `scan`, `imu` or another topic."""
        return self._run(self._robot.get_sensor_data(sensor_name))

    @overload
    def topic(self, topic: Topic[M], *, timeout: float | None = None) -> Iterator[M]: ...

    @overload
    def topic(self, topic: str, *, timeout: float | None = None) -> Iterator[Any]: ...

    def topic(self, topic: Topic[M] | str, *, timeout: float | None = None) -> Iterator[M]:
        """Yield each message on a topic: `for scan in robot.topic("scan", timeout=5)`."""
        messages = self._robot.topic(topic, timeout=timeout)
        while True:
            try:
                yield self._run(_next_of(messages))
            except StopAsyncIteration:
                return


async def _next_of(messages: AsyncIterator[M]) -> M:
    return await anext(messages)


async def _called(function: Callable[[], T]) -> T:
    return function()
