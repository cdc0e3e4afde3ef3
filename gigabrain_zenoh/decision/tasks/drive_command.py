"""Commands that tasks give to the navigator, and the outcome of each."""

from enum import StrEnum
from typing import Literal, NamedTuple

from msgspec import Struct

from gigabrain_schemas.tasks import Goal, Task

DriveKind = Literal["goto", "explore", "visit"]  # `visit`: a random reachable place


class DriveCommand(Struct, frozen=True):
    """A request to drive somewhere."""

    number: int  # a new number is a new command, even for the same goal
    kind: DriveKind
    goal: Goal | None = None  # of `goto`


class Outcome(Struct, frozen=True, kw_only=True):
    """Result of one step of a behaviour, and progress of the command that it carries out."""

    number: int = 0  # of the command; 0 without one
    state: Literal["running", "done", "failed"] = "running"
    activity: str = ""  # short name of what the robot does; each change is logged
    reason: str = ""  # for people
    held: bool = False  # the body does not follow: the gate or an operator has it
    progress: float = 0.0
    distance: float | None = None  # [m] left along the path
    eta: float | None = None  # [s]
    goal: Goal | None = None  # present destination
    path: tuple[tuple[float, float], ...] = ()  # [m] in the map, for drawing
    position_error: float | None = None  # [m] from the requested place
    heading_error: float | None = None  # [rad] from the requested heading


class Idle(NamedTuple):
    """Why the robot stands: a short name, whose changes are logged, and a text for people."""

    activity: str
    reason: str


class WaitReason(StrEnum):
    """Why the robot cannot drive by its map yet; the value is the text for people."""

    STARTING = "starting up"
    PERCEPTION_STARTING = "perception is starting up"
    NO_LOCALIZATION = (
        "nobody says yet where in a map the robot is; perception: {mapping: slam} would"
    )
    NOT_LOCALIZED = "the pose in the map is uncertain"
    NO_ODOMETRY_OF_POSE = "no odometry for the last pose in the map"
    NO_ODOMETRY_OF_SCAN = "no odometry for the scan"
    NO_MAP = "no map yet"


def describe_goal(goal: Goal) -> str:
    """Return a goal as text: `(x, y)` or `(x, y, yaw rad)`."""
    turned = "" if goal.yaw is None else f", {goal.yaw:.2f} rad"
    return f"({goal.x:.2f}, {goal.y:.2f}{turned})"


def describe_end(task: Task) -> str:
    """Return how a task ended as text, with its reason and errors."""
    if task.state == "cancelled":
        return f"{task.id} was {task.reason or task.state}"  # its reason names the source
    errors = []
    if task.position_error is not None:
        errors.append(f"position error {task.position_error:.2f} m")
    if task.heading_error is not None:
        errors.append(f"heading error {task.heading_error:.2f} rad")
    measured = f" ({', '.join(errors)})" if errors else ""
    return f"{task.id} has {task.state}{f': {task.reason}' if task.reason else ''}{measured}"
