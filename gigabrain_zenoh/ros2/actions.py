"""Serves a ROS 2 action over any transport: three services and two topics.

`Goals` is a pure state machine; `ActionServer` connects it to a transport. Goal states and the
meaning of a cancel request are those of `action_msgs`.
"""

import asyncio
import functools
import logging
import time
from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.ros2.qos import ACTION_STATUS, DEFAULT
from gigabrain_zenoh.ros2.transport import Close, RosServer
from gigabrain_zenoh.ros2.types import MAX_COMMAND, Types

log = logging.getLogger(__name__)
MAX_ACTIVE = 32  # goals of one server at the same time
MAX_ENDED = 200  # goals whose results are kept for later requests
RESULT_LIFETIME_S = 300.0  # from the end of a goal until its result is forgotten
CANCEL_TYPE = "action_msgs/srv/CancelGoal"
STATUS_TYPE = "action_msgs/msg/GoalStatusArray"
STATUS_INTERVAL_S = 0.02  # minimum time between two publications of all states


class GoalState(IntEnum):
    """States of action_msgs/msg/GoalStatus."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


ENDED = (GoalState.SUCCEEDED, GoalState.CANCELED, GoalState.ABORTED)


class CancelCode(IntEnum):
    """Return codes of action_msgs/srv/CancelGoal."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL = 2
    GOAL_TERMINATED = 3


class Goal:
    """An accepted goal."""

    def __init__(self, id: bytes, message: Any, accepted_ns: int) -> None:
        self.id, self.message, self.accepted_ns = id, message, accepted_ns
        self.state = GoalState.ACCEPTED
        self.ended_ns = 0
        self.preempted = False  # true: a newer goal replaces it, and it should end as aborted
        self.result: Any = None

    @property
    def active(self) -> bool:
        """Return whether the goal has not ended."""
        return self.state not in ENDED

    @property
    def cancel_requested(self) -> bool:
        """Return whether a client requested cancellation; the goal should end as canceled."""
        return self.state == GoalState.CANCELING


class Outcome(NamedTuple):
    """The final state of a goal, and its result."""

    state: GoalState  # SUCCEEDED, CANCELED or ABORTED
    result: Any = None  # the action's result as a message or mapping; None: default values


class Goals:
    """All goals of a server, and the effect of requests on them. No I/O, and no clock."""

    def __init__(self) -> None:
        self._goals: dict[bytes, Goal] = {}

    def get(self, id: bytes) -> Goal | None:
        """Return a goal by its id; None if it is unknown or forgotten."""
        return self._goals.get(id)

    def all(self) -> tuple[Goal, ...]:
        """Return all goals in order of acceptance."""
        return tuple(self._goals.values())

    def active(self) -> list[Goal]:
        """Return the goals that have not ended."""
        return [goal for goal in self._goals.values() if goal.active]

    def may_accept(self, id: bytes) -> bool:
        """Return whether the id is new and there is room for another active goal."""
        return id not in self._goals and len(self.active()) < MAX_ACTIVE

    def accept(self, id: bytes, message: Any, now_ns: int) -> Goal:
        """Add a goal."""
        goal = self._goals[id] = Goal(id, message, now_ns)
        return goal

    def end(self, goal: Goal, outcome: Outcome, now_ns: int) -> None:
        """End a goal. A CANCELED outcome without a cancel request is recorded as ABORTED."""
        canceled = outcome.state == GoalState.CANCELED
        goal.state = GoalState.ABORTED if canceled and not goal.cancel_requested else outcome.state
        goal.result, goal.ended_ns = outcome.result, now_ns

    def to_cancel(self, id: bytes, until_ns: int) -> tuple[list[Goal], CancelCode]:
        """Return the active goals that a cancel request selects: by id, by time, or all.

        A zero id and a zero time select all goals. If both are set, a goal that matches either
        one is selected. `until_ns` selects the goals accepted up to that time.
        """
        has_id = any(id)
        if not has_id and not until_ns:
            return self.active(), CancelCode.NONE
        selected = [
            goal
            for goal in self.active()
            if (has_id and goal.id == id) or (until_ns and goal.accepted_ns <= until_ns)
        ]
        if has_id and not selected:
            known = id in self._goals
            return [], CancelCode.GOAL_TERMINATED if known else CancelCode.UNKNOWN_GOAL
        return selected, CancelCode.NONE

    def forget(self, now_ns: int) -> None:
        """Forget goals that ended long ago, and the oldest ended goals beyond MAX_ENDED."""
        ended = [goal for goal in self._goals.values() if not goal.active]
        for number, goal in enumerate(ended):
            expired = now_ns - goal.ended_ns > RESULT_LIFETIME_S * 1e9
            if expired or len(ended) - number > MAX_ENDED:
                del self._goals[goal.id]


class ActionHandler(Protocol):
    """The callbacks of an action server: they accept, cancel and run goals."""

    def accept(self, message: Any) -> bool:
        """Return whether to accept a goal."""
        ...

    def cancel(self, goal: Goal) -> bool:
        """Return whether to cancel the goal; `run` then sees `goal.cancel_requested`."""
        ...

    async def run(self, goal: Goal, feedback: Callable[[Any], None]) -> Outcome:
        """Pursue the goal until its end. A GigabrainError aborts the goal.

        `feedback` takes a message or a mapping. It does nothing without subscribers.
        """
        ...


class ActionServer:
    """Serves one action. Close it before closing its transport."""

    def __init__(
        self,
        transport: RosServer,
        types: Types,
        name: str,
        type: str,
        handler: ActionHandler,
        *,
        preempts: bool = False,
        polled: RosServer | None = None,
        max_bytes: int = MAX_COMMAND,
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Offer the action `name` of a type such as nav2_msgs/action/NavigateToPose.

        With `preempts`, a new goal sets `preempted` in all other active goals. `polled` is a second
        transport that offers the same action. There, a result request is answered at once with
        the present state. `max_bytes` limits the size of a goal request.
        """
        self.goals, self._max_bytes = Goals(), max_bytes
        self._types, self._type, self._handler = types, type, handler
        self._name, self._preempts, self._now_ns = name, preempts, now_ns
        self._end_events: dict[bytes, asyncio.Event] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._loop, self._published_s = asyncio.get_running_loop(), 0.0
        self._publishing: asyncio.TimerHandle | None = None
        base = f"{name}/_action"
        servers = [transport, polled] if polled else [transport]
        message = f"{type}_FeedbackMessage"
        self._feedback = [each.publisher(f"{base}/feedback", message, DEFAULT) for each in servers]
        self._status = [
            each.publisher(f"{base}/status", STATUS_TYPE, ACTION_STATUS) for each in servers
        ]
        self._closes: list[Close] = []
        for server in servers:
            get_result = functools.partial(self._get_result, waits=server is not polled)
            self._closes += [
                server.serve(f"{base}/send_goal", f"{type}_SendGoal", self._send_goal),
                server.serve(f"{base}/get_result", f"{type}_GetResult", get_result),
                server.serve(f"{base}/cancel_goal", CANCEL_TYPE, self._cancel_goal),
            ]
        self._publish_states()

    async def close(self) -> None:
        """Withdraw the action; its goals end as aborted."""
        for close in self._closes:
            close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for goal in self.goals.active():  # those whose task was cancelled before it began
            self.goals.end(goal, Outcome(GoalState.ABORTED), self._now_ns())
            self._end_events.pop(goal.id).set()
        if self._publishing:
            self._publishing.cancel()
        self._publish_states()
        for publisher in (*self._feedback, *self._status):
            publisher.close()

    async def _send_goal(self, request: bytes) -> bytes:
        kind = f"{self._type}_SendGoal_Request"
        decoded = self._types.decode_command(kind, request, self._max_bytes)
        id, now_ns = decoded.goal_id.uuid.tobytes(), self._now_ns()
        self.goals.forget(now_ns)
        accepted = self.goals.may_accept(id) and self._handler.accept(decoded.goal)
        if accepted:
            self._start(self.goals.accept(id, decoded.goal, now_ns))
        return self._encode("SendGoal_Response", accepted=accepted, stamp=_time(now_ns))

    def _start(self, goal: Goal) -> None:
        if self._preempts:
            for other in self.goals.active():
                other.preempted = other is not goal
        self._end_events[goal.id] = asyncio.Event()
        task = self._loop.create_task(self._run(goal))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        self._publish_states_soon()

    async def _run(self, goal: Goal) -> None:
        if goal.state == GoalState.ACCEPTED:  # it may already be CANCELING
            goal.state = GoalState.EXECUTING
            self._publish_states_soon()
        outcome = Outcome(GoalState.ABORTED)
        try:
            outcome = await self._handler.run(
                goal, lambda fields: self._publish_feedback(goal, fields)
            )
        except GigabrainError as error:
            log.warning("%s: goal aborted: %s", self._name, error)
        finally:
            self.goals.end(goal, outcome, self._now_ns())
            self._publish_states_soon()
            self._end_events.pop(goal.id).set()

    def _publish_feedback(self, goal: Goal, fields: Any) -> None:
        """Publish the feedback of an active goal, if there are subscribers."""
        publishers = [each for each in self._feedback if each.readers]
        if publishers and goal.active:
            fields = self._message("Feedback", fields)
            payload = self._encode("FeedbackMessage", goal_id=_uuid(goal.id), feedback=fields)
            for publisher in publishers:
                publisher.publish(payload)

    async def _get_result(self, request: bytes, *, waits: bool) -> bytes:
        decoded = self._types.decode_command(f"{self._type}_GetResult_Request", request)
        goal = self.goals.get(decoded.goal_id.uuid.tobytes())
        if goal is None:
            return self._encode("GetResult_Response", status=int(GoalState.UNKNOWN))
        if waits and goal.active:
            await self._end_events[goal.id].wait()
        result = self._message("Result", goal.result)
        return self._encode("GetResult_Response", status=int(goal.state), result=result)

    async def _cancel_goal(self, request: bytes) -> bytes:
        info = self._types.decode_command(f"{CANCEL_TYPE}_Request", request).goal_info
        until_ns = info.stamp.sec * 10**9 + info.stamp.nanosec
        selected, code = self.goals.to_cancel(info.goal_id.uuid.tobytes(), until_ns)
        canceling = [goal for goal in selected if self._handler.cancel(goal)]
        for goal in canceling:
            goal.state = GoalState.CANCELING
        if selected and not canceling:
            code = CancelCode.REJECTED
        if canceling:
            self._publish_states_soon()
        response = self._types.make(
            f"{CANCEL_TYPE}_Response",
            return_code=int(code),
            goals_canceling=[_info(goal) for goal in canceling],
        )
        return self._types.encode(f"{CANCEL_TYPE}_Response", response)

    def _publish_states_soon(self) -> None:
        """Publish all states in a later turn of the loop, at most every STATUS_INTERVAL_S.

        Encoding the states of many goals takes milliseconds.
        """
        if self._publishing is None:
            at_s = max(self._loop.time(), self._published_s + STATUS_INTERVAL_S)
            self._publishing = self._loop.call_at(at_s, self._publish_states)

    def _publish_states(self) -> None:
        self._publishing, self._published_s = None, self._loop.time()
        states = [
            {"goal_info": _info(goal), "status": int(goal.state)} for goal in self.goals.all()
        ]
        message = self._types.make(STATUS_TYPE, status_list=states)
        payload = self._types.encode(STATUS_TYPE, message)
        for publisher in self._status:
            publisher.publish(payload)

    def _message(self, part: str, fields: Any) -> Any:
        """Make a message of a part of the action; a message is returned unchanged."""
        if fields is None or isinstance(fields, Mapping):
            return self._types.make(f"{self._type}_{part}", **(fields or {}))
        return fields

    def _encode(self, part: str, **fields: Any) -> bytes:
        name = f"{self._type}_{part}"
        return self._types.encode(name, self._types.make(name, **fields))


def _uuid(id: bytes) -> dict[str, Any]:
    return {"uuid": id}


def _time(ns: int) -> dict[str, int]:
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}


def _info(goal: Goal) -> dict[str, Any]:
    return {"goal_id": _uuid(goal.id), "stamp": _time(goal.accepted_ns)}
