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
