"""Converts things between the formats of missions, the task file and the arm's planner."""

import math

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.decision.arm_readings import ArmReading
from gigabrain_zenoh.decision.tasks.arm_steps import ArmAction, HeldThing, PlaceThing, Solid
from gigabrain_zenoh.manipulation.arm_planner import Hold
from gigabrain_zenoh.manipulation.collision import Thing, turned


def thing_of(name: str, solid: Solid) -> Thing:
    """Return a mission's thing in the planner's format."""
    assert solid.at
    position, axes = np.array(solid.at), turned(solid.yaw)
    if solid.box:
        return Thing(name=name, kind="box", size=solid.box, position=position, axes=axes)
    if solid.cylinder:
        return Thing(name=name, kind="cylinder", size=solid.cylinder, position=position, axes=axes)
    assert solid.sphere is not None
    return Thing(name=name, kind="sphere", size=(solid.sphere,), position=position, axes=axes)


def solid_of(thing: Thing, at: Floats, yaw: float) -> Solid:
    """Return a thing in a mission's format, at a place (3,) [m]."""
    box, cylinder = thing.kind == "box", thing.kind == "cylinder"
    x, y, z = at.tolist()
    return Solid(
        box=thing.size if box else None,  # type: ignore[arg-type]
        cylinder=thing.size if cylinder else None,  # type: ignore[arg-type]
        sphere=None if box or cylinder else thing.size[0],
        at=(x, y, z),
        yaw=yaw,
    )


def placed(arm: ArmReading, action: ArmAction, hold: Hold) -> tuple[str, Solid]:
    """Return the name and solid of a thing that an arm just let go of."""
    tool, thing = arm.planner.arm.forward(arm.measured_posture), hold.thing
    at, ahead = tool.place(thing.position), tool.axes @ thing.axes[:, 0]
    if isinstance(action, PlaceThing):  # it now stands on something, or on the floor
        at[2] = action.at[2] if len(action.at) == 3 else standing_height(hold, arm.body)
    return thing.name, solid_of(thing, at, math.atan2(ahead[1], ahead[0]))


def standing_height(hold: Hold, body: BodyDescription) -> float:
    """Return the height of a held thing's centre when it stands on the floor [m]."""
    return floor_of(body) + float(hold.thing.half[2])


def floor_of(body: BodyDescription) -> float:
    """Return the height of the floor in the frame of the arm's model [m]."""
    assert body.arm
    return body.arm.floor or 0.0


def held_thing(hold: Hold) -> HeldThing:
    """Return a hold in the format of the task file."""
    return HeldThing(
        name=hold.thing.name,
        solid=solid_of(hold.thing, hold.thing.position, 0.0),
        axes=tuple(hold.thing.axes.ravel().tolist()),
        grip=hold.grip,
        opening=hold.opening,
    )


def hold_of(held: HeldThing) -> Hold:
    """Return a hold of the task file in the planner's format."""
    thing = thing_of(held.name, held.solid)
    axes = np.array(held.axes).reshape(3, 3)
    return Hold(
        thing=Thing(
            name=held.name, kind=thing.kind, size=thing.size, position=thing.position, axes=axes
        ),
        grip=held.grip,
        opening=held.opening,
    )
