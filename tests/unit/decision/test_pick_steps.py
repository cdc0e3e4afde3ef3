"""A body that can drive approaches a thing out of reach, and then picks it up."""

import itertools
from typing import Any

import pytest

from gigabrain_zenoh.decision.behaviours import ArmCommand, DriveCommand, StepOutcome, Target
from gigabrain_zenoh.decision.known_objects import Seek, Sought
from gigabrain_zenoh.decision.tasks.arm_steps import HeldThing, Solid
from gigabrain_zenoh.decision.tasks.leaves import seek_nothing
from gigabrain_zenoh.decision.tasks.mission_files import loads
from gigabrain_zenoh.decision.tasks.task_queue import Saved, TaskQueue

CAN = Target(name="can", x=1.0, y=2.0, radius=0.03, away=0.3)
FAR = {"state": "failed", "reason": "too far", "approach": CAN}
PICK = "things: {can: {label: can}}\ndo: [{pick: can}]"


class Steps:
    """A queue with one mission, and a body that answers each command."""

    def __init__(self, text: str = PICK, seek: Seek = seek_nothing) -> None:
        self.queue = TaskQueue(lambda _topic: None, lambda _script: None, Saved(), seek)  # type: ignore[arg-type, return-value]
        self.queue.add_mission(loads(text, "mission"), "mission", "replace", "test")
        self.command: Any = None
        self.step(None)

    def step(self, outcome: StepOutcome | None) -> None:
        self.command, _ = self.queue.step(0.02, outcome)

    def answer(self, **outcome: Any) -> None:
        """End the current command with `outcome`."""
        self.step(StepOutcome(number=self.command.number, **outcome))


def test_it_drives_to_a_thing_out_of_reach_and_picks_it_up() -> None:
    steps = Steps()
    assert isinstance(steps.command, ArmCommand)
    first = steps.command.number
    steps.answer(**FAR)
    assert steps.command == DriveCommand(first + 1, "approach", target=CAN)
    steps.step(StepOutcome(number=first + 1, reason="on the way"))
    assert steps.command.number == first + 1
    steps.answer(state="done")
    assert isinstance(steps.command, ArmCommand)
    assert steps.command.number == first + 2
    steps.answer(state="done")
    assert steps.queue.status.done[0].state == "succeeded"


def test_it_drives_four_times_and_then_fails_with_the_reason() -> None:
    steps = Steps()
    for _ in range(4):
        steps.answer(**FAR)
        assert isinstance(steps.command, DriveCommand)
        steps.answer(state="done")
    steps.answer(**FAR)
    done = steps.queue.status.done[0]
    assert (done.state, done.reason) == ("failed", "picking up can: too far")


def test_a_failed_approach_is_the_reason_of_the_failure() -> None:
    steps = Steps()
    steps.answer(**FAR)
    steps.answer(state="failed", reason="no free and reachable place in front of can")
    assert steps.queue.status.done[0].reason == "no free and reachable place in front of can"


def test_it_searches_for_an_unseen_thing_and_picks_it_up() -> None:
    known = Sought()
    steps = Steps(seek=lambda wanted, _without, _preferred: known if wanted == "can" else Sought())
    steps.answer(state="failed", reason="can is not seen", seek="can")
    assert (steps.command.kind, steps.command.target) == ("look", None)
    known = Sought(target=CAN, id=3)
    steps.step(None)
    assert (steps.command.kind, steps.command.target) == ("approach", CAN)
    steps.answer(state="done")
    assert isinstance(steps.command, ArmCommand)


def test_a_fixed_arm_that_cannot_reach_fails_at_once() -> None:
    steps = Steps()
    steps.answer(state="failed", reason="too far")
    assert steps.queue.status.done[0].state == "failed"


@pytest.mark.parametrize("given", ["label: can", "sphere: 0.03"])
def test_a_seen_thing_must_be_seen_again_after_it_was_put_down(given: str) -> None:
    steps = Steps(
        f"things: {{can: {{{given}}}}}\ndo: [{{pick: can}}, {{place: [0.2, 0]}}, {{pick: can}}]"
    )
    steps.answer(state="done")
    steps.answer(state="done", placed=("can", Solid(sphere=0.03, at=(0.2, 0.0, 0.03))))
    assert steps.command.things["can"].at is None


def test_a_thing_lost_on_the_way_can_be_seen_and_picked_up_again() -> None:
    steps = Steps("things: {can: {label: can}}\ndo: [{retry: {times: 2, do: [{pick: can}]}}]")
    held = HeldThing(
        name="can", solid=Solid(sphere=0.03, at=(0, 0, 0)), axes=(1, 0, 0, 0, 1, 0, 0, 0, 1),
        grip=0.3, opening=0.9,
    )  # fmt: skip
    steps.step(StepOutcome(number=steps.command.number, holds=held))
    steps.answer(state="failed", reason="can has slipped out of the gripper")
    steps.step(None)
    assert isinstance(steps.command, ArmCommand)
    assert steps.command.things == {"can": Solid(label="can")}


def test_command_numbers_continue() -> None:
    steps = Steps()
    numbers = [steps.command.number]
    for _ in range(3):
        steps.answer(**FAR)
        numbers.append(steps.command.number)
        steps.answer(state="done")
        numbers.append(steps.command.number)
    assert all(a < b for a, b in itertools.pairwise(numbers))
