"""Goals, missions and tasks, and their progress."""

from typing import Annotated, Literal

from msgspec import Meta

from gigabrain_schemas.base import (
    Angle,
    Coordinate,
    Distance,
    Fraction,
    Message,
    Name,
    NonNegative,
    Record,
    Text,
)
from gigabrain_schemas.objects import TagId

How = Literal["replace", "queue", "preempt"]
# instead of all tasks; after them; or before them, and they continue afterwards
TaskState = Literal["queued", "active", "paused", "succeeded", "failed", "cancelled"]
MAX_REQUEST_BYTES = 96 * 1024  # of a request as text, with the longest mission
MAX_POINTS = 256  # of a path that is only drawn


class Goal(Record, frozen=True, kw_only=True):
    """A pose in the map to drive to."""

    x: Coordinate  # [m]
    y: Coordinate  # [m]
    yaw: Angle | None = None  # [rad]; None for any


class GoalRequest(Message, frozen=True, kw_only=True):
    """Drive to coordinates, to a named place of the map, or in front of an object or a tag."""

    x: Coordinate | None = None  # [m], in the map
    y: Coordinate | None = None  # [m]
    yaw: Angle | None = None  # [rad]; None for any, or the heading of the place
    place: Name = ""  # instead of x and y; see robot/zones
    object: Name = ""  # class of an object, such as can; see robot/objects
    tag: TagId | None = None
    how: How = "replace"
    source: Name = "anonymous"

    def __post_init__(self) -> None:
        ways = self.x is not None, bool(self.place), bool(self.object), self.tag is not None
        if (self.x is None) != (self.y is None) or sum(ways) != 1:
            raise ValueError("expected x and y, a place, an object or a tag")


class GoalReply(Message, frozen=True, kw_only=True):
    """The answer to a goal: accepted or refused, with a text."""

    ok: bool
    text: Text
    goal: Name = ""  # id of the task, to follow or cancel it


class MissionRequest(Message, frozen=True, kw_only=True):
    """Carry out a mission."""

    mission: Annotated[str, Meta(max_length=MAX_REQUEST_BYTES)]  # the YAML text
    how: How = "replace"
    source: Name = "anonymous"
    label: Name = "mission"  # name for people; errors show it as the file's name


class MissionReply(Message, frozen=True, kw_only=True):
    """The answer to a mission: accepted or refused, with a text."""

    ok: bool
    text: Text
    task: Name = ""  # id of the task, to follow or cancel it


class TaskRequest(Message, frozen=True, kw_only=True):
    """Cancel, pause or resume a task."""

    do: Literal["cancel", "pause", "resume"]
    task: Name = ""  # id; empty for the present one; "all" to cancel all
    source: Name = "anonymous"


class TaskReply(Message, frozen=True, kw_only=True):
    """The result of a change."""

    ok: bool
    text: Text
    task: Name = ""


class Task(Record, frozen=True, kw_only=True):
    """A goal or mission of the robot."""

    id: Name
    kind: Literal["goal", "mission"]
    label: Name
    source: Name  # of the request
    state: TaskState
    reason: Text = ""  # in words: why it waits, or how it ended
    position_error: NonNegative | None = None  # [m] from the goal at the end; None if unknown
    heading_error: NonNegative | None = None  # [rad]; None if the goal has no heading


class TaskStatus(Message, frozen=True, kw_only=True):
    """The current task, the queue, and the last tasks."""

    current: Task | None = None  # active or paused
    doing: Text = ""  # present step, in words
    drives: bool = False  # the step needs the robot to drive
    progress: Fraction = 0.0  # of that step
    distance_remaining: Distance | None = None  # [m] along the path; None if unknown
    eta: NonNegative | None = None  # [s] until the step is done
    goal: Goal | None = None  # present goal of the drive
    path: Annotated[tuple[tuple[Coordinate, Coordinate], ...], Meta(max_length=MAX_POINTS)] = ()
    # [m] in the map, from the robot to the goal, for drawing
    queue: Annotated[tuple[Task, ...], Meta(max_length=32)] = ()
    done: Annotated[tuple[Task, ...], Meta(max_length=16)] = ()  # the last ones, newest first
