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
# in place of all that there is to do; after it; or before it, which goes on afterwards
TaskState = Literal["queued", "active", "paused", "succeeded", "failed", "cancelled"]
MAX_REQUEST_BYTES = 96 * 1024  # of a request as text: a mission of the longest, quoted
MAX_POINTS = 256  # of a path that is only drawn


class Goal(Record, frozen=True, kw_only=True):
    """A place to be, in the map."""

    x: Coordinate  # [m]
    y: Coordinate  # [m]
    yaw: Angle | None = None  # [rad]; None for any


class GoalRequest(Message, frozen=True, kw_only=True):
    """Go there: to coordinates, a named place of the map, before an object or a tag."""

    x: Coordinate | None = None  # [m], in the map
    y: Coordinate | None = None  # [m]
    yaw: Angle | None = None  # [rad]; None for any, or for that of the place
    place: Name = ""  # instead of x and y; see robot/zones
    object: Name = ""  # the class of one, such as can; see robot/objects
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
    goal: Name = ""  # the task's name, to follow and to cancel it by


class MissionRequest(Message, frozen=True, kw_only=True):
    """Carry out a mission."""

    mission: Annotated[str, Meta(max_length=MAX_REQUEST_BYTES)]  # the YAML text
    how: How = "replace"
    source: Name = "anonymous"
    label: Name = "mission"  # what people call it; stands for the file's name in errors


class MissionReply(Message, frozen=True, kw_only=True):
    """The answer to a mission: accepted or refused, with a text."""

    ok: bool
    text: Text
    task: Name = ""  # the task's name, to follow and to cancel it by


class TaskRequest(Message, frozen=True, kw_only=True):
    """Change what the robot is at."""

    do: Literal["cancel", "pause", "resume"]
    task: Name = ""  # which one; without, the present one; "all" to cancel whatever there is
    source: Name = "anonymous"


class TaskReply(Message, frozen=True, kw_only=True):
    """The result of a change."""

    ok: bool
    text: Text
    task: Name = ""


class Task(Record, frozen=True, kw_only=True):
    """One thing that the robot was sent to do."""

    id: Name
    kind: Literal["goal", "mission"]
    label: Name
    source: Name  # who wanted it
    state: TaskState
    reason: Text = ""  # in words: why it waits, what became of it
    position_error: NonNegative | None = None  # [m] from the goal where it ended; None if unknown
    heading_error: NonNegative | None = None  # [rad]; None where the goal has no heading


class TaskStatus(Message, frozen=True, kw_only=True):
    """The current task, the queue, and the last tasks."""

    current: Task | None = None  # active or paused
    doing: Text = ""  # the step that it is at, in words
    drives: bool = False  # whether that step wants the robot to drive
    progress: Fraction = 0.0  # of that step
    distance_remaining: Distance | None = None  # [m] along the path; None while none is known
    eta: NonNegative | None = None  # [s] until the step is done
    goal: Goal | None = None  # where it drives to now
    path: Annotated[tuple[tuple[Coordinate, Coordinate], ...], Meta(max_length=MAX_POINTS)] = ()
    # [m] in the map, from here to the goal, for drawing
    queue: Annotated[tuple[Task, ...], Meta(max_length=32)] = ()
    done: Annotated[tuple[Task, ...], Meta(max_length=16)] = ()  # the last ones, newest first
