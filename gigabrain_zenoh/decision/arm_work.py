"""Plans an action of an arm, and reports its progress while the arm moves."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import Intent
from gigabrain_zenoh.decision.arm_readings import ArmReading, posture_of
from gigabrain_zenoh.decision.behaviours import StepOutcome, StepResult
from gigabrain_zenoh.decision.held_things import standing_height, thing_of
from gigabrain_zenoh.decision.tasks.arm_steps import (
    ArmAction,
    AwaitTaken,
    Gripper,
    HandOver,
    Pick,
    PlaceThing,
    Press,
    Reach,
    Solid,
    TakePosture,
    thing_meant,
)
from gigabrain_zenoh.manipulation.arm_planner import Hold, Plan
from gigabrain_zenoh.manipulation.phases import PhaseRun
from gigabrain_zenoh.manipulation.pick_place import NoWay

Planned = Plan | NoWay


@dataclass(frozen=True, kw_only=True)
class WorkInputs:
    """Inputs for the plan of an action."""

    arm: ArmReading
    things: Mapping[str, Solid]  # around the arm
    hold: Hold | None
    misses: int  # failed grasps of this command
    drives: bool  # the body can drive to a thing out of reach


def work_for(do: ArmAction, now: WorkInputs) -> Callable[[], Planned] | str:
    """Return a function that plans an action, or why it cannot be planned."""
    planner, body, hold = now.arm.planner, now.arm.body, now.hold
    if len(now.arm.state.joints_sent) != len(body.joints):
        return "the joints are limp or not measured"
    name = thing_meant(do)
    if name is not None and hold:
        return f"the gripper holds {hold.thing.name} already"
    if name is not None and name not in now.things:
        return f"the place of {name} is not known"
    posture = now.arm.sent_posture
    others = {other: thing_of(other, solid) for other, solid in now.things.items()}
    thing = others.pop(name) if name is not None else None
    around = [*others.values()]
    gripper_at = now.arm.gripper_place(0.0) if planner.arm.gripper else None
    match do:
        case Reach(at=at, pitch=pitch):
            return lambda: planner.reach(np.array(at), pitch, around, posture, hold, gripper_at)
        case TakePosture(to=to):
            goal = posture_of(body, to) if isinstance(to, str) else to
            return lambda: planner.take_posture(goal, around, posture, hold, gripper_at)
        case Gripper(to=to):
            return lambda: planner.grip(to)
        case Pick():
            assert thing
            return lambda: planner.pick(thing, around, posture, now.misses, drives=now.drives)
        case Press(at=at, pitch=pitch, depth=depth):
            if hold:
                return f"the gripper holds {hold.thing.name}"
            target = thing or np.array(at)
            return lambda: planner.press(target, pitch, depth, around, posture)
        case PlaceThing() | HandOver() if hold is None:
            return "the gripper holds nothing"
        case PlaceThing(at=at):
            assert hold
            target = np.array(at if len(at) == 3 else (*at, standing_height(hold, body)))
            return lambda: planner.place(hold, target, around, posture)
        case HandOver(at=at, pitch=pitch):
            assert hold
            point = None if at is None else np.array(at)
            return lambda: planner.offer(point, pitch, around, posture, hold)
        case AwaitTaken():
            raise AssertionError("nothing is planned for it")


def names_gripper(body: BodyDescription, do: ArmAction) -> bool:
    """Return whether an action is a posture that also moves the gripper's joint."""
    grippers = {joint.name for joint in body.joints if joint.part == "gripper"}
    return isinstance(do, TakePosture) and not isinstance(do.to, str) and bool(grippers & {*do.to})


def moving(run: PhaseRun, tick: int, number: int, behaviour: str) -> StepResult:
    """Return the intent that continues a plan, and the progress of the command."""
    joints, window = run.wish(tick)
    text = run.phase.name if run.phase else "coming to rest"
    outcome = StepOutcome(
        number=number,
        activity=text,
        reason=text,
        progress=run.progress(tick),
        eta=run.left_ticks(tick) * TICK_S,
    )
    intent = Intent(
        joints=joints,
        joint_trajectory=window,
        progress=outcome.progress,
        behaviour=behaviour,
        reason=text,
    )
    return intent, outcome
