"""Nav2's actions on our tasks: navigate_to_pose is a goal, navigate_through_poses a mission."""

import asyncio
import contextlib
import itertools
import logging
import math
from collections.abc import Callable, Coroutine, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import msgspec

from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.tasks import Task, TaskStatus
from gigabrain_schemas.topics import MAP, TASK
from gigabrain_zenoh.client.tasks import PLAN_S, STARTING_S, Tasks
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.errors import BodyLost, GigabrainError, Refused
from gigabrain_zenoh.gateway import result_codes
from gigabrain_zenoh.gateway.conversions.frames import MAP as MAP_FRAME
from gigabrain_zenoh.gateway.conversions.frames import Make, pose_stamped
from gigabrain_zenoh.gateway.conversions.maps import in_map, planar
from gigabrain_zenoh.gateway.result_codes import Codes
from gigabrain_zenoh.gateway.scene import Scene

log = logging.getLogger(__name__)
SECOND_NS = 1_000_000_000
NEAR_M = 0.5  # largest distance between a task's goal and its pose in the request
ACCEPT_S = PLAN_S + STARTING_S  # ROS waits this long until a goal is accepted
LATE_ANSWER_S = 60.0  # wait for a late answer, to cancel a task whose goal was aborted
MAX_POSES = 200
NO_TREES = "this navigator has no behavior trees; leave behavior_tree empty"
_decode_map = Codec(MAP.type, MAP.max_bytes).decode


class EndState(IntEnum):
    """Final states of a goal, by action_msgs/GoalStatus."""

    SUCCEEDED, CANCELED, ABORTED = 4, 5, 6


class Outcome(NamedTuple):
    """The final state of a goal, with its result code and a text."""

    state: EndState
    code: int = result_codes.NONE
    text: str = ""


class Progress(NamedTuple):
    """The progress of a goal, for its feedback."""

    here: Pose | None
    passed_ns: int
    left_s: float
    left_m: float
    poses_left: int


OnProgress = Callable[[Progress], None]


class Navigator:
    """Carries out one goal at a time. A new goal preempts the previous one."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._tasks = scene, Tasks(scene.bus, plan_s=LATE_ANSWER_S)
        self._task = ""  # name of the present task for ROS
        self._abandoned: set[str] = set()  # tasks whose goals were aborted without an answer
        self._cancels: set[asyncio.Task[None]] = set()
        self._listens = False

    async def carry_out(
        self, codes: Codes, poses: Sequence[Pose], on_progress: OnProgress
    ) -> Outcome:
        """Drive to one pose, or through several in the map. Cancelling this cancels the task.

        A new goal replaces the task of the present one.
        """
        before, self._task = self._task, ""
        abandoned, self._abandoned = self._abandoned, set()  # an accepted goal replaces them
        sending = asyncio.ensure_future(self._send(poses))
        try:
            name = self._task = await self._accepted(sending)
        except GigabrainError as error:
            self._abandoned |= abandoned
            await self._cancel(before)
            return await self._refused(codes, poses, error)
        except asyncio.CancelledError:
            await asyncio.wait((self._begin_cancel(sending),), timeout=ACCEPT_S)
            await self._cancel(before)
            raise
        follow = _Follower(self._scene, name, poses, on_progress)
        try:
            task = await self._tasks.result(name, follow.update)
        except GigabrainError as error:
            self._abandon(name)
            return Outcome(EndState.ABORTED, codes.navigator + result_codes.UNKNOWN, str(error))
        except asyncio.CancelledError:
            if self._task == name:  # no other goal replaces it
                await self._cancel(name)
            raise
        finally:
            self._task = "" if self._task == name else self._task
        return self._ended(codes, task, had_path=follow.had_path)

    async def _send(self, poses: Sequence[Pose]) -> str:
        if len(poses) == 1:
            return await self._tasks.go_to(poses[0].x, poses[0].y, poses[0].yaw)
        steps = [{"goto": [at.x, at.y, at.yaw]} for at in poses]
        text = msgspec.json.encode({"do": steps}).decode()
        return await self._tasks.carry_out(text, label="navigate_through_poses")

    async def _accepted(self, sending: asyncio.Future[str]) -> str:
        """Return the name of a task; cancel one that is accepted too late.

        Raises GigabrainError.
        """
        await asyncio.wait((sending,), timeout=ACCEPT_S)
        if sending.done():
            return sending.result()
        self._begin_cancel(sending)
        raise BodyLost(
            f"no answer within {ACCEPT_S:g} s; the goal is cancelled if it is accepted later"
        )

    def _begin_cancel(self, sending: asyncio.Future[str]) -> asyncio.Task[None]:
        """Cancel a task in the background, after it is accepted."""

        async def cancel() -> None:
            with contextlib.suppress(GigabrainError):  # refused: nothing to cancel
                await self._cancel(await sending)

        return self._begin(cancel())

    def _begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.create_task(work)
        self._cancels.add(task)
        task.add_done_callback(self._cancels.discard)
        return task

    async def _cancel(self, name: str) -> None:
        if name:
            with contextlib.suppress(GigabrainError):  # it has ended meanwhile
                await self._tasks.cancel(name)

    def _abandon(self, name: str) -> None:
        """Cancel a task if it still runs after a silence in which its goal was aborted."""
        self._abandoned.add(name)
        if not self._listens:
            self._listens = True
            self._scene.bus.subscribe(TASK, self._on_status)

    def _on_status(self, _key: str, status: TaskStatus) -> None:
        source = self._scene.bus.process  # another client's task may have this name
        for task in (status.current, *status.queue):
            if task and task.source == source and task.id in self._abandoned:
                self._abandoned.remove(task.id)
                self._begin(self._cancel(task.id))

    async def _refused(self, codes: Codes, poses: Sequence[Pose], error: GigabrainError) -> Outcome:
        """Return the outcome of a refused goal, with a code that depends on the map."""
        if not isinstance(error, Refused):
            return Outcome(EndState.ABORTED, codes.navigator + result_codes.UNKNOWN, str(error))
        about, grid = self._scene.description, await self._map()
        radius = result_codes.inner_radius(about.footprint) if about else 0.0
        code = result_codes.of_refusal(codes, self._scene.here, poses, grid, radius)
        return Outcome(EndState.ABORTED, code, str(error))

    def _ended(self, codes: Codes, task: Task, *, had_path: bool) -> Outcome:
        if task.state == "succeeded":
            return Outcome(EndState.SUCCEEDED)
        if task.state == "cancelled":  # by another client: a cancel of ROS ends the wait
            return Outcome(EndState.ABORTED, codes.navigator + result_codes.UNKNOWN, task.reason)
        return Outcome(
            EndState.ABORTED, result_codes.of_failure(codes, had_path=had_path), task.reason
        )

    async def _map(self) -> OccupancyGrid | None:
        for payload in await self._scene.bus.kept(MAP):
            with contextlib.suppress(ValueError):
                return _decode_map(payload)
        return None


class _Follower:
    """Turns the status of a task into feedback."""

    def __init__(
        self, scene: Scene, task: str, poses: Sequence[Pose], on_progress: OnProgress
    ) -> None:
        self._scene, self._task, self._poses = scene, task, poses
        self._on_progress = on_progress
        self._began_ns, self._reached = scene.ros_ns(), 0
        self.had_path = False

    def update(self, status: TaskStatus) -> None:
        """Handle a status, if it is of this task."""
        if status.current is None or status.current.id != self._task:
            return
        self.had_path = self.had_path or len(status.path) > 1
        if status.goal:
            self._pass(Pose(x=status.goal.x, y=status.goal.y, yaw=0.0))
        rest = self._poses[self._reached :]
        further = math.fsum(_apart(a, b) for a, b in itertools.pairwise(rest))
        here = self._scene.here
        left_m = status.distance_remaining
        if left_m is None:
            left_m = _apart(here, rest[0]) if here else 0.0
        left_s = status.eta if status.eta is not None else self._time_for(left_m)
        self._on_progress(
            Progress(
                here,
                max(0, self._scene.ros_ns() - self._began_ns),
                left_s + self._time_for(further),
                left_m + further,
                len(rest),
            )
        )

    def _pass(self, goal: Pose) -> None:
        """Count poses as reached up to the task's present goal."""
        for number in range(self._reached, len(self._poses)):
            if _apart(goal, self._poses[number]) <= NEAR_M:
                self._reached = number
                return

    def _time_for(self, way: float) -> float:
        about = self._scene.description
        return way / about.max_linear_speed if about else 0.0


def _apart(one: Pose, other: Pose) -> float:
    return math.hypot(one.x - other.x, one.y - other.y)


class Requested(NamedTuple):
    """A goal from ROS: poses in the map, or the fault that prevents it."""

    poses: tuple[Pose, ...]
    fault: Outcome | None = None


def requested(codes: Codes, poses: Sequence[Any], tree: str, odom_in_map: Pose | None) -> Requested:
    """Return the goal of PoseStamped messages."""
    if tree:
        code = codes.navigator + result_codes.NO_BEHAVIOR_TREE
        return Requested((), Outcome(EndState.ABORTED, code, NO_TREES))
    if not 0 < len(poses) <= MAX_POSES:
        text = f"{len(poses)} poses; expected 1 to {MAX_POSES}"
        code = codes.navigator + result_codes.UNKNOWN
        return Requested((), Outcome(EndState.ABORTED, code, text))
    try:
        found = tuple(in_map(p.header.frame_id, planar(p.pose), odom_in_map) for p in poses)
    except Refused as error:
        code = codes.navigator + result_codes.NO_TRANSFORM
        return Requested((), Outcome(EndState.ABORTED, code, str(error)))
    return Requested(found)


def feedback(make: Make, action: str, at_ns: int, progress: Progress) -> Any:
    """Return the feedback of an action; our navigator counts no recoveries."""
    here = progress.here or Pose(x=0.0, y=0.0, yaw=0.0)
    fields: dict[str, Any] = {
        "current_pose": pose_stamped(make, at_ns, MAP_FRAME if progress.here else "", here),
        "navigation_time": _duration(make, progress.passed_ns),
        "estimated_time_remaining": _duration(make, round(progress.left_s * SECOND_NS)),
        "number_of_recoveries": 0,
        "distance_remaining": progress.left_m,
    }
    if action.endswith("NavigateThroughPoses"):
        fields["number_of_poses_remaining"] = progress.poses_left
    return make(f"{action}_Feedback", **fields)


def _duration(make: Make, length_ns: int) -> Any:
    sec, nanosec = divmod(max(0, length_ns), SECOND_NS)
    sec = min(sec, 2**31 - 1)
    return make("builtin_interfaces/msg/Duration", sec=sec, nanosec=nanosec)
