"""A server of a ROS 2 action over any transport: three services and two topics.

Goals and their states are a pure state machine, `Goals`; `ActionServer` is its way to the wire.
States, and what a cancel request means, are those of `action_msgs`.
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
MAX_ACTIVE = 32  # goals of a server at once
MAX_KEPT = 200  # goals that have ended, whose results can still be asked for
KEPT_S = 300.0  # how long they can
CANCEL = "action_msgs/srv/CancelGoal"
STATUSES = "action_msgs/msg/GoalStatusArray"
STATUS_S = 0.02  # from one publication of all states to the next, however many goals come


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
    """A goal that was accepted."""

    def __init__(self, id: bytes, message: Any, accepted_ns: int) -> None:
        self.id, self.message, self.accepted_ns = id, message, accepted_ns
        self.state = GoalState.ACCEPTED
        self.ended_ns = 0
        self.preempted = False  # by a newer goal; it should end as aborted
        self.result: Any = None

    @property
    def active(self) -> bool:
        """Return whether it has not ended."""
        return self.state not in ENDED

    @property
    def cancel_requested(self) -> bool:
        """Return whether a client has asked for its end; it should end as canceled."""
        return self.state == GoalState.CANCELING


class Outcome(NamedTuple):
    """The final state of a goal, and its result."""

    state: GoalState  # SUCCEEDED, CANCELED or ABORTED
    result: Any = None  # message or mapping of the action's result; None: its defaults


class Goals:
    """All goals of a server, and what requests change in them. No I/O, and no clock."""

    def __init__(self) -> None:
        self._goals: dict[bytes, Goal] = {}

    def get(self, id: bytes) -> Goal | None:
        """Return a goal that is active or has ended lately."""
        return self._goals.get(id)

    def all(self) -> tuple[Goal, ...]:
        """Return the goals in the order of their acceptance."""
        return tuple(self._goals.values())

    def active(self) -> list[Goal]:
        """Return the goals that have not ended."""
        return [goal for goal in self._goals.values() if goal.active]

    def may_accept(self, id: bytes) -> bool:
        """Return whether an id is new, and another goal fits in."""
        return id not in self._goals and len(self.active()) < MAX_ACTIVE

    def accept(self, id: bytes, message: Any, now_ns: int) -> Goal:
        """Add a goal."""
        goal = self._goals[id] = Goal(id, message, now_ns)
        return goal

    def end(self, goal: Goal, outcome: Outcome, now_ns: int) -> None:
        """End a goal. Canceled is what a client asked for; any other such end is an abort."""
        canceled = outcome.state == GoalState.CANCELED
        goal.state = GoalState.ABORTED if canceled and not goal.cancel_requested else outcome.state
        goal.result, goal.ended_ns = outcome.result, now_ns

    def to_cancel(self, id: bytes, until_ns: int) -> tuple[list[Goal], CancelCode]:
        """Return the active goals that a request means: an id, all until a time, or all.

        A zero id and a zero time mean all goals. With both, either is enough.
        """
        named = any(id)
        if not named and not until_ns:
            return self.active(), CancelCode.NONE
        meant = [
            goal
            for goal in self.active()
            if (named and goal.id == id) or (until_ns and goal.accepted_ns <= until_ns)
        ]
        if named and not meant:
            known = id in self._goals
            return [], CancelCode.GOAL_TERMINATED if known else CancelCode.UNKNOWN_GOAL
        return meant, CancelCode.NONE

    def forget(self, now_ns: int) -> None:
        """Forget goals that ended long ago, and the first of too many."""
        ended = [goal for goal in self._goals.values() if not goal.active]
        for number, goal in enumerate(ended):
            old = now_ns - goal.ended_ns > KEPT_S * 1e9
            if old or len(ended) - number > MAX_KEPT:
                del self._goals[goal.id]


class ActionHandler(Protocol):
    """The callbacks of an action: they accept, cancel and run its goals."""

    def accept(self, message: Any) -> bool:
        """Return whether to accept a goal."""
        ...

    def cancel(self, goal: Goal) -> bool:
        """Return whether to cancel it; `run` then sees `goal.cancel_requested`."""
        ...

    async def run(self, goal: Goal, feedback: Callable[[Any], None]) -> Outcome:
        """Pursue the goal until its end. A GigabrainError aborts it.

        `feedback` takes a message or a mapping, and does nothing while no client listens.
        """
        ...


class ActionServer:
    """Serves one action. Close it before its transport."""

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

        With `preempts`, a new goal sets `preempted` of those that are active. `polled` is a second
        transport that has the action too, where a request for a result does not wait for the goal's
        end: it is answered at once with the present state. Goals have `max_bytes` at most.
        """
        self.goals, self._max_bytes = Goals(), max_bytes
        self._types, self._type, self._handler = types, type, handler
        self._name, self._preempts, self._now_ns = name, preempts, now_ns
        self._ends: dict[bytes, asyncio.Event] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._loop, self._published_s = asyncio.get_running_loop(), 0.0
        self._publishing: asyncio.TimerHandle | None = None
        base = f"{name}/_action"
        servers = [transport, polled] if polled else [transport]
        message = f"{type}_FeedbackMessage"
        self._feedback = [one.publisher(f"{base}/feedback", message, DEFAULT) for one in servers]
        self._status = [one.publisher(f"{base}/status", STATUSES, ACTION_STATUS) for one in servers]
        self._closes: list[Close] = []
        for one in servers:
            get_result = functools.partial(self._get_result, waits=one is not polled)
            self._closes += [
                one.serve(f"{base}/send_goal", f"{type}_SendGoal", self._send_goal),
                one.serve(f"{base}/get_result", f"{type}_GetResult", get_result),
                one.serve(f"{base}/cancel_goal", CANCEL, self._cancel_goal),
            ]
        self._publish_states()

    async def close(self) -> None:
        """Withdraw the action; its goals end as aborted."""
        for close in self._closes:
            close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for goal in self.goals.active():  # whose task had not begun
            self.goals.end(goal, Outcome(GoalState.ABORTED), self._now_ns())
            self._ends.pop(goal.id).set()
        if self._publishing:
            self._publishing.cancel()
        self._publish_states()
        for publisher in (*self._feedback, *self._status):
            publisher.close()

    async def _send_goal(self, request: bytes) -> bytes:
        kind = f"{self._type}_SendGoal_Request"
        asked = self._types.decode_command(kind, request, self._max_bytes)
        id, now_ns = asked.goal_id.uuid.tobytes(), self._now_ns()
        self.goals.forget(now_ns)
        accepted = self.goals.may_accept(id) and self._handler.accept(asked.goal)
        if accepted:
            self._start(self.goals.accept(id, asked.goal, now_ns))
        return self._encode("SendGoal_Response", accepted=accepted, stamp=_time(now_ns))

    def _start(self, goal: Goal) -> None:
        if self._preempts:
            for other in self.goals.active():
                other.preempted = other is not goal
        self._ends[goal.id] = asyncio.Event()
        task = self._loop.create_task(self._run(goal))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        self._publish_states_soon()

    async def _run(self, goal: Goal) -> None:
        if goal.state == GoalState.ACCEPTED:  # unless it was canceled already
            goal.state = GoalState.EXECUTING
            self._publish_states_soon()
        outcome = Outcome(GoalState.ABORTED)
        try:
            outcome = await self._handler.run(goal, lambda fields: self._feed(goal, fields))
        except GigabrainError as error:
            log.warning("%s: goal aborted: %s", self._name, error)
        finally:
            self.goals.end(goal, outcome, self._now_ns())
            self._publish_states_soon()
            self._ends.pop(goal.id).set()

    def _feed(self, goal: Goal, fields: Any) -> None:
        """Publish the feedback of a goal, if a client listens."""
        read = [one for one in self._feedback if one.readers]
        if read and goal.active:
            fields = self._message("Feedback", fields)
            payload = self._encode("FeedbackMessage", goal_id=_uuid(goal.id), feedback=fields)
            for publisher in read:
                publisher.publish(payload)

    async def _get_result(self, request: bytes, *, waits: bool) -> bytes:
        asked = self._types.decode_command(f"{self._type}_GetResult_Request", request)
        goal = self.goals.get(asked.goal_id.uuid.tobytes())
        if goal is None:
            return self._encode("GetResult_Response", status=int(GoalState.UNKNOWN))
        if waits and goal.active:
            await self._ends[goal.id].wait()
        result = self._message("Result", goal.result)
        return self._encode("GetResult_Response", status=int(goal.state), result=result)

    async def _cancel_goal(self, request: bytes) -> bytes:
        asked = self._types.decode_command(f"{CANCEL}_Request", request).goal_info
        until_ns = asked.stamp.sec * 10**9 + asked.stamp.nanosec
        meant, code = self.goals.to_cancel(asked.goal_id.uuid.tobytes(), until_ns)
        canceling = [goal for goal in meant if self._handler.cancel(goal)]
        for goal in canceling:
            goal.state = GoalState.CANCELING
        if meant and not canceling:
            code = CancelCode.REJECTED
        if canceling:
            self._publish_states_soon()
        response = self._types.make(
            f"{CANCEL}_Response",
            return_code=int(code),
            goals_canceling=[_info(goal) for goal in canceling],
        )
        return self._types.encode(f"{CANCEL}_Response", response)

    def _publish_states_soon(self) -> None:
        """Publish the states once this turn of the loop is over and the last time is a while ago.

        The states of many goals take milliseconds to encode.
        """
        if self._publishing is None:
            at_s = max(self._loop.time(), self._published_s + STATUS_S)
            self._publishing = self._loop.call_at(at_s, self._publish_states)

    def _publish_states(self) -> None:
        self._publishing, self._published_s = None, self._loop.time()
        states = [
            {"goal_info": _info(goal), "status": int(goal.state)} for goal in self.goals.all()
        ]
        message = self._types.make(STATUSES, status_list=states)
        payload = self._types.encode(STATUSES, message)
        for publisher in self._status:
            publisher.publish(payload)

    def _message(self, part: str, fields: Any) -> Any:
        """Return a message of one of the action's parts; a message is taken as it is."""
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
