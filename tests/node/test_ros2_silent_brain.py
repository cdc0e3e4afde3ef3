"""A brain that becomes silent, or answers late, while ROS has a goal for it."""

import asyncio

import pytest

from gigabrain_zenoh.gateway import navigation
from gigabrain_zenoh.gateway.navigation import EndState
from tests.node.test_ros2_navigation import Brain


async def test_a_goal_that_was_aborted_because_of_a_silent_brain_is_cancelled_later():
    brain = Brain()
    brain.navigator._tasks._silent_s = 0.05
    await brain.located()
    goal = brain.begin()
    await brain.settle()
    await brain.publish_task("active")
    outcome = await goal
    assert (outcome.state, outcome.code) == (EndState.ABORTED, 9000)
    assert len(brain.requests) == 1
    await brain.publish_task("active")
    await brain.publish_task("active")
    assert brain.requests[1:] == [("cancel", "goal-1")]
    other = brain.begin()
    await brain.settle()
    await brain.publish_task("active", "goal-2")
    await brain.publish_task("succeeded", "goal-2")
    assert (await other).state is EndState.SUCCEEDED
    assert len(brain.requests) == 3


async def test_a_restarted_brain_may_give_a_new_goal_the_name_of_one_that_was_aborted():
    brain = Brain()
    brain.navigator._tasks._silent_s = 0.05
    await brain.located()
    goal = brain.begin()
    await brain.settle()
    assert (await goal).state is EndState.ABORTED
    brain.count, brain.navigator._tasks._silent_s = 0, 60.0
    other = brain.begin()
    await brain.settle()
    await brain.publish_task("active")
    await brain.publish_task("succeeded")
    assert (await other).state is EndState.SUCCEEDED
    assert [each[0] for each in brain.requests] == [2.0, 2.0]


async def test_a_goal_that_another_client_has_from_a_restarted_brain_is_not_cancelled():
    brain = Brain()
    brain.navigator._tasks._silent_s = 0.05
    await brain.located()
    goal = brain.begin()
    await brain.settle()
    assert (await goal).state is EndState.ABORTED
    await brain.publish_task("active", source="ann")
    assert len(brain.requests) == 1


class SlowBrain(Brain):
    """A brain that answers a goal once `may_answer` is set."""

    def __init__(self):
        super().__init__()
        self.may_answer = asyncio.Event()

    async def _goal(self, request):
        await self.may_answer.wait()
        return await super()._goal(request)


@pytest.mark.parametrize("cancelled", [False, True])
async def test_a_goal_that_is_accepted_after_it_was_aborted_is_cancelled(monkeypatch, cancelled):
    monkeypatch.setattr(navigation, "ACCEPT_S", 0.05)
    brain = SlowBrain()
    await brain.located()
    goal = brain.begin()
    await brain.settle()
    if cancelled:
        goal.cancel()
        await asyncio.wait((goal,))
        assert goal.cancelled()
    else:
        outcome = await goal
        assert (outcome.state, outcome.code) == (EndState.ABORTED, 9000)
        assert "no answer" in outcome.text
    assert brain.requests == []
    brain.may_answer.set()
    await brain.settle()
    assert brain.requests == [(2.0, 1.0, 0.5, "replace"), ("cancel", "goal-1")]
