"""A brain that falls silent while it carries out a goal of ROS, and comes back."""

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
