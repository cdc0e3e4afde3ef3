"""Steps of a mission that move an arm, and the things around it, in the frame of its base."""

from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from gigabrain_schemas.base import Angle, Name
from gigabrain_schemas.body import BodyDescription, JointDescription
from gigabrain_schemas.objects import Label
from gigabrain_zenoh.errors import Refused, unknown

NEEDED = ("mujoco", "ruckig", "numba")  # packages of the extra `arm`

Metres = Annotated[float, Meta(ge=-10.0, le=10.0)]
Side = Annotated[float, Meta(ge=0.001, le=10.0)]  # [m]
Point3 = tuple[Metres, Metres, Metres]  # x, y, z [m]
# msgspec 0.22 crashes for a union of a fixed-length tuple and a constrained str
PointOrThing = Annotated[tuple[Metres, ...], Meta(min_length=3, max_length=3)] | Name
Spot = Annotated[tuple[Metres, ...], Meta(min_length=2, max_length=3)]  # x, y, and maybe z [m]
JointPlace = Annotated[float, Meta(ge=-100.0, le=100.0)]  # [rad] or [m]
NamedPosture = Literal["home", "carry"]  # of the robot's file
Posture = NamedPosture | Annotated[dict[Name, JointPlace], Meta(min_length=1)]
Cosine = Annotated[float, Meta(ge=-1.001, le=1.001)]
Rotation = Annotated[tuple[Cosine, ...], Meta(min_length=9, max_length=9)]
GripperPlace = Literal["open", "close"] | JointPlace
Depth = Annotated[float, Meta(ge=0.001, le=0.1)]  # [m]
HoldTime = Annotated[float, Meta(ge=0.0, le=5.0)]  # [s]
PressForce = Annotated[float, Meta(ge=1.0, le=50.0)]  # [N]
Patience = Annotated[float, Meta(gt=0.0, le=1e5)]  # [s]


class Solid(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A thing to pick up or to avoid, with one shape, or with a class.

    A thing without a place is located by cameras.
    """

    box: tuple[Side, Side, Side] | None = None  # [m], lengths along its x, y and z
    cylinder: tuple[Side, Side] | None = None  # [m], radius, and length along z
    sphere: Side | None = None  # [m], radius
    label: Label | None = None  # class that cameras recognise
    at: Point3 | None = None  # of its centre
    yaw: Angle = 0.0  # [rad]

    def __post_init__(self) -> None:
        shapes = sum(shape is not None for shape in (self.box, self.cylinder, self.sphere))
        if shapes > 1 or not (shapes or self.label):
            raise ValueError("expected a box, a cylinder or a sphere, or a label that is seen")
        if self.label and self.at:
            raise ValueError("expected a label that is seen, or a place, not both")


class HeldThing(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A thing in the gripper."""

    name: Name
    solid: Solid  # in the frame of the tool
    axes: Rotation  # of the thing in that frame, row by row
    grip: JointPlace  # [rad] or [m], command of the gripper's joint
    opening: JointPlace  # [rad] or [m], position that lets go


Held = HeldThing | JointPlace  # JointPlace: the gripper's command that holds something unknown


class Reach(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Move the tool to a point."""

    at: Point3
    pitch: Angle | None = None  # [rad] down from level; None: any way


class TakePosture(Struct, frozen=True):
    """Move joints to positions [rad] or [m], or the arm to a posture of the robot's file."""

    to: NamedPosture | dict[str, float]


class Gripper(Struct, frozen=True):
    """Move only the gripper."""

    to: GripperPlace


class Pick(Struct, frozen=True):
    """Pick up a thing."""

    thing: str


class PlaceThing(Struct, frozen=True):
    """Put down the held thing with its centre at a point; without a height, on the floor."""

    at: Spot


class Press(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Press a point, or the near side of a thing, with the closed tool until a force is felt."""

    at: PointOrThing  # x, y, z [m], or one of the mission's `things`
    pitch: Angle | None = None  # [rad] down from level; None: any way
    depth: Depth = 0.03  # [m], maximum, behind the point
    force: PressForce = 4.0  # [N]
    seconds: HoldTime = 0.5  # time to keep the force


class HandOver(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Hold out a thing to a person; open the gripper when the person pulls or confirms."""

    at: Point3 | None = None  # [m], of the tool; None: far ahead and high
    pitch: Angle | None = None  # [rad] down from level; None: any way
    seconds: Patience = 60.0  # time limit


class AwaitTaken(Struct, frozen=True):
    """Hold still until a person pulls at the held thing, or takes it."""


ArmAction = Reach | TakePosture | Gripper | Pick | PlaceThing | Press | HandOver | AwaitTaken
NEED_GRIPPER = Gripper | Pick | PlaceThing | Press | HandOver


def action_of(kind: str, value: Any) -> ArmAction | None:
    """Return the action of a mission's step; None for a step that does not move the arm."""
    match kind:
        case "reach":
            return value if isinstance(value, Reach) else Reach(at=value)
        case "posture":
            return TakePosture(value)
        case "gripper":
            return Gripper(value)
        case "pick":
            return Pick(value)
        case "place":
            return PlaceThing(value)
        case "press":
            return value if isinstance(value, Press) else Press(at=value)
        case "hand_over":
            return value if isinstance(value, HandOver) else HandOver(at=value)
    return None


def thing_meant(action: ArmAction | None) -> str | None:
    """Return the name of the thing that an action uses; None if it uses none."""
    if isinstance(action, Pick):
        return action.thing
    return action.at if isinstance(action, Press) and isinstance(action.at, str) else None


def describe(action: ArmAction) -> str:
    """Return an action of the arm as text for users."""
    match action:
        case Reach(at=at):
            return f"reaching for {describe_point(at)}"
        case TakePosture(to=to):
            posture = isinstance(to, str)
            return f"moving to the {to} posture" if posture else f"moving {', '.join(to)}"
        case Gripper(to=to):
            words = {"open": "opening the gripper", "close": "closing the gripper"}
            return words.get(str(to), "moving the gripper")
        case Pick(thing=thing):
            return f"picking up {thing}"
        case PlaceThing(at=at):
            return f"placing at {describe_point(at)}"
        case Press(at=at):
            return f"pressing {at if isinstance(at, str) else describe_point(at)}"
        case HandOver():
            return "handing over"
        case AwaitTaken():
            return "waiting for a person to take it"


def describe_point(point: Sequence[float]) -> str:
    """Return a point as text [m]."""
    return f"({', '.join(f'{value:.3f}' for value in point)})"


def check(
    body: BodyDescription, actions: Iterable[ArmAction], things: Iterable[Solid] = ()
) -> None:
    """Raise Refused or UnknownName for what the body's arm cannot do."""
    if body.arm is None:
        raise Refused(f"{body.robot_type} has no arm")
    for package in NEEDED:
        if find_spec(package) is None:
            raise Refused(f"moving an arm needs {package}; pip install 'gigabrain-zenoh[arm]'")
    has_depth = any(camera.depth for camera in body.cameras)
    if any(thing.at is None for thing in things) and not has_depth:
        raise Refused(
            "things without a place have to be seen, and the robot has no depth camera; "
            "start it with --cameras, or `cameras: on`"
        )
    known = {joint.name: joint for joint in body.joints}
    gripper = next((joint for joint in body.joints if joint.part == "gripper"), None)
    for action in actions:
        if action == TakePosture("carry") and not body.arm.carry:
            raise Refused(
                f"{body.robot_type} has no carry posture; expected arm: carry in its file"
            )
        if isinstance(action, PlaceThing) and len(action.at) == 2 and body.arm.floor is None:
            raise Refused(f"{body.robot_type} reaches no floor; give a height to place at")
        if isinstance(action, TakePosture) and not isinstance(action.to, str):
            for name, position in action.to.items():
                if name not in known:
                    raise unknown("joint", name, known)
                _check_range(known[name], position)
        if isinstance(action, NEED_GRIPPER) and gripper is None:
            raise Refused(f"{body.robot_type} has no gripper")
        if isinstance(action, Gripper) and gripper and not isinstance(action.to, str):
            _check_range(gripper, action.to)


def _check_range(joint: JointDescription, position: float) -> None:
    if not joint.lower <= position <= joint.upper:
        raise Refused(
            f"{joint.name}: expected {joint.lower:g} to {joint.upper:g}, got {position:g}"
        )
