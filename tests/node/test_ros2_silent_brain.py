"""A brain that falls silent, or answers late, while ROS has a goal for it."""

import asyncio

import pytest

from gigabrain_zenoh.gateway import navigation
from gigabrain_zenoh.gateway.navigation import EndState
from tests.node.test_ros2_navigation import Brain


async def test_a_goal_that_was_aborted_while_the_brain_was_silent_does_not_go_on_later():
    brain = Brain()
    brain.navigator._tasks._silent_s = 0.05
    await brain.located()
    goal = brain.begin()
    await brain.settle()
    await brain.say("active")
    outcome = await goal
    assert (outcome.state, outcome.code) == (EndState.ABORTED, 9000)
    assert len(brain.asked) == 1
    await brain.say("active")
    await brain.say("active")
    assert brain.asked[1:] == [("cancel", "goal-1")]
    other = brain.begin()
    await brain.settle()
    await brain.say("active", "goal-2")
    await brain.say("succeeded", "goal-2")
    assert (await other).state is EndState.SUCCEEDED
    assert len(brain.asked) == 3


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
    await brain.say("active")
    await brain.say("succeeded")
    assert (await other).state is EndState.SUCCEEDED
    assert [one[0] for one in brain.asked] == [2.0, 2.0]


async def test_a_goal_that_another_client_has_from_a_restarted_brain_is_not_cancelled():
    brain = Brain()
    brain.navigator._tasks._silent_s = 0.05
    await brain.located()
    goal = brain.begin()
    await brain.settle()
    assert (await goal).state is EndState.ABORTED
    await brain.say("active", source="ann")
    assert len(brain.asked) == 1


class SlowBrain(Brain):
    """A brain that answers a goal when the test says so."""

    def __init__(self):
        super().__init__()
        self.may_answer = asyncio.Event()

    async def _goal(self, request):
        await self.may_answer.wait()
        return await super()._goal(request)


@pytest.mark.parametrize("cancelled", [False, True])
async def test_a_goal_that_is_accepted_after_it_was_given_up_is_cancelled(monkeypatch, cancelled):
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
    assert brain.asked == []
    brain.may_answer.set()
    await brain.settle()
    assert brain.asked == [(2.0, 1.0, 0.5, "replace"), ("cancel", "goal-1")]
