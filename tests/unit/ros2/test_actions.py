"""An action server on a network in memory: goals, results, cancelling and preemption."""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.errors import NoAnswer, Refused
from gigabrain_zenoh.ros2.actions import (
    CANCEL_TYPE,
    MAX_ACTIVE,
    RESULT_LIFETIME_S,
    STATUS_INTERVAL_S,
    STATUS_TYPE,
    ActionServer,
    CancelCode,
    Goal,
    Goals,
    GoalState,
    Outcome,
)
from gigabrain_zenoh.ros2.memory import MemoryNetwork, MemoryTransport
from gigabrain_zenoh.ros2.qos import ACTION_STATUS, DEFAULT
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.testing.waiting import settle, until

NAVIGATE = "nav2_msgs/action/NavigateToPose"
S = GoalState


class Walk:
    """A handler whose goals run until the test sets their outcome."""

    def __init__(self) -> None:
        self.accepts = self.cancels = True
        self.running: dict[bytes, asyncio.Future[Outcome]] = {}
        self.feedback: Callable[[Any], None] = print

    def accept(self, message: Any) -> bool:
        return self.accepts

    def cancel(self, goal: Goal) -> bool:
        return self.cancels

    async def run(self, goal: Goal, feedback: Callable[[Any], None]) -> Outcome:
        self.feedback = feedback
        self.running[goal.id] = asyncio.get_running_loop().create_future()
        return await self.running[goal.id]


class Client:
    """Sends requests as an action client of ROS does."""

    def __init__(self, node: MemoryTransport, types: Types) -> None:
        self.node, self.types = node, types

    async def ask(self, service: str, type: str, **fields: Any) -> Any:
        request = self.types.encode(f"{type}_Request", self.types.make(f"{type}_Request", **fields))
        name = f"/navigate_to_pose/_action/{service}"
        response = await self.node.call(name, type, request, 60)
        return self.types.decode(f"{type}_Response", response)

    async def send(self, id: bytes, **goal: Any) -> bool:
        answer = await self.ask(
            "send_goal", f"{NAVIGATE}_SendGoal", goal_id={"uuid": id}, goal=goal
        )
        return bool(answer.accepted)

    async def result(self, id: bytes) -> tuple[int, int]:
        answer = await self.ask("get_result", f"{NAVIGATE}_GetResult", goal_id={"uuid": id})
        return answer.status, answer.result.error_code

    async def cancel(self, id: bytes = bytes(16), sec: int = 0) -> tuple[int, list[bytes]]:
        info = {"goal_id": {"uuid": id}, "stamp": {"sec": sec}}
        answer = await self.ask("cancel_goal", CANCEL_TYPE, goal_info=info)
        ids = [each.goal_id.uuid.tobytes() for each in answer.goals_canceling]
        return answer.return_code, ids


class World:
    def __init__(self, types: Types) -> None:
        self.types = types
        self.network = MemoryNetwork(types)
        self.now_ns = 10**9
        self.walk = Walk()
        self.server = ActionServer(
            self.network.transport(),
            types,
            "navigate_to_pose",
            NAVIGATE,
            self.walk,
            preempts=True,
            now_ns=lambda: self.now_ns,
        )
        self.client = Client(self.network.transport(Ros2Link(node="rviz")), types)

    def statuses(self) -> list[int]:
        """Return the states that a late reader of the status topic receives."""
        received_lists: list[list[int]] = []
        self.client.node.subscribe(
            "/navigate_to_pose/_action/status",
            STATUS_TYPE,
            ACTION_STATUS,
            lambda received: received_lists.append(
                [
                    each.status
                    for each in self.types.decode(STATUS_TYPE, received.payload).status_list
                ]
            ),
        )()
        return received_lists[-1]

    async def wait_for_states(self, states: list[int]) -> None:
        """Wait for these states, which are published a little later."""
        await until(lambda: self.statuses() == states, f"{states} on the status topic")


A, B = bytes(15) + b"\1", bytes(15) + b"\2"


@pytest.fixture(scope="session")
def types() -> Types:
    return Types()


@pytest.fixture
async def world(types: Types) -> AsyncIterator[World]:
    world = World(types)
    yield world
    await world.server.close()


@pytest.mark.long
async def test_a_goal_is_followed_to_its_result(world: World) -> None:
    feedback: list[Any] = []
    kind = f"{NAVIGATE}_FeedbackMessage"
    world.client.node.subscribe(
        "/navigate_to_pose/_action/feedback",
        kind,
        DEFAULT,
        lambda received: feedback.append(world.types.decode(kind, received.payload)),
    )
    await world.wait_for_states([])
    assert await world.client.send(A, behavior_tree="here")
    await settle()
    await world.wait_for_states([S.EXECUTING])
    waiting = asyncio.create_task(world.client.result(A))
    await settle()
    world.walk.feedback({"distance_remaining": 1.5})
    assert not waiting.done()
    world.walk.running[A].set_result(Outcome(S.SUCCEEDED, {"error_code": 7}))
    assert await waiting == (S.SUCCEEDED, 7)
    assert await world.client.result(A) == (S.SUCCEEDED, 7)
    await world.wait_for_states([S.SUCCEEDED])
    assert (feedback[0].goal_id.uuid.tobytes(), feedback[0].feedback.distance_remaining) == (A, 1.5)


async def test_a_goal_is_rejected_by_the_handler_or_if_its_id_is_known(world: World) -> None:
    world.walk.accepts = False
    assert not await world.client.send(A)
    world.walk.accepts = True
    assert await world.client.send(A)
    assert not await world.client.send(A)


async def test_the_result_of_an_unknown_goal_is_unknown_at_once(world: World) -> None:
    assert await world.client.result(B) == (S.UNKNOWN, 0)


async def test_cancelling_asks_the_handler_and_ends_as_canceled(world: World) -> None:
    await world.client.send(A)
    world.walk.cancels = False
    assert await world.client.cancel(A) == (CancelCode.REJECTED, [])
    world.walk.cancels = True
    assert await world.client.cancel(A) == (CancelCode.NONE, [A])
    await settle()
    await world.wait_for_states([S.CANCELING])
    world.walk.running[A].set_result(Outcome(S.CANCELED))
    assert await world.client.result(A) == (S.CANCELED, 0)
    assert await world.client.cancel(A) == (CancelCode.GOAL_TERMINATED, [])
    assert await world.client.cancel(B) == (CancelCode.UNKNOWN_GOAL, [])


async def test_a_zero_id_and_time_cancel_all_goals_even_if_there_are_none(world: World) -> None:
    assert await world.client.cancel() == (CancelCode.NONE, [])
    await world.client.send(A)
    await world.client.send(B)
    assert await world.client.cancel() == (CancelCode.NONE, [A, B])


async def test_a_time_cancels_the_goals_accepted_up_to_it(world: World) -> None:
    await world.client.send(A)
    world.now_ns = 5 * 10**9
    await world.client.send(B)
    assert await world.client.cancel(sec=4) == (CancelCode.NONE, [A])
    assert await world.client.cancel(B, sec=4) == (CancelCode.NONE, [A, B])


async def test_a_new_goal_preempts_the_running_one(world: World) -> None:
    await world.client.send(A)
    await world.client.send(B)
    first, second = world.server.goals.get(A), world.server.goals.get(B)
    assert first
    assert second
    assert (first.preempted, second.preempted) == (True, False)
    await settle()
    world.walk.running[A].set_result(Outcome(S.ABORTED))
    assert await world.client.result(A) == (S.ABORTED, 0)
    await world.wait_for_states([S.ABORTED, S.EXECUTING])


async def test_the_states_of_many_goals_are_published_together(world: World) -> None:
    lengths: list[int] = []
    loop = asyncio.get_running_loop()
    world.client.node.subscribe(
        "/navigate_to_pose/_action/status",
        STATUS_TYPE,
        ACTION_STATUS,
        lambda got: lengths.append(len(world.types.decode(STATUS_TYPE, got.payload).status_list)),
    )
    began_s = loop.time()
    for number in range(30):
        await world.client.send(number.to_bytes(16, "big"))
    await until(lambda: lengths[-1] == 30, "all goals on the status topic")
    assert len(lengths) <= 3 + (loop.time() - began_s) / STATUS_INTERVAL_S


async def test_a_large_request_is_not_decoded(world: World) -> None:
    assert await world.client.send(A, behavior_tree="x" * 60_000)
    with pytest.raises(NoAnswer):
        await world.client.send(B, behavior_tree="x" * 70_000)


async def test_an_error_of_the_handler_aborts_the_goal(world: World) -> None:
    await world.client.send(A)
    await settle()
    world.walk.running[A].set_exception(Refused("no map"))
    assert await world.client.result(A) == (S.ABORTED, 0)


async def test_closing_aborts_goals_and_ends_the_services(world: World) -> None:
    await world.client.send(A)
    await settle()
    waiting = asyncio.create_task(world.client.result(A))
    await settle()
    await world.server.close()
    assert await waiting == (S.ABORTED, 0)
    with pytest.raises(NoAnswer):
        await world.client.send(B)


async def test_closing_aborts_a_goal_that_has_not_begun(world: World) -> None:
    await world.client.send(A)
    await world.server.close()
    goal = world.server.goals.get(A)
    assert goal
    assert goal.state == S.ABORTED


async def test_a_malformed_request_gets_no_answer(world: World) -> None:
    with pytest.raises(NoAnswer):
        await world.client.node.call(
            "/navigate_to_pose/_action/send_goal", f"{NAVIGATE}_SendGoal", b"\0\1\0\0x", 60
        )


def test_a_result_is_forgotten_after_its_lifetime() -> None:
    goals = Goals()
    first = goals.accept(A, None, 0)
    goals.end(first, Outcome(S.SUCCEEDED), 0)
    goals.forget(int(RESULT_LIFETIME_S * 1e9))
    assert goals.get(A) is first
    goals.forget(int(RESULT_LIFETIME_S * 1e9) + 1)
    assert goals.get(A) is None


def test_the_number_of_active_goals_is_limited() -> None:
    goals = Goals()
    for number in range(MAX_ACTIVE):
        assert goals.may_accept(bytes([number]))
        goals.accept(bytes([number]), None, 0)
    assert not goals.may_accept(b"x")


def test_canceled_without_a_request_is_an_abort() -> None:
    goals = Goals()
    goal = goals.accept(A, None, 0)
    goals.end(goal, Outcome(S.CANCELED), 0)
    assert goal.state == S.ABORTED
