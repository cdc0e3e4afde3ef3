"""What a task wants of whoever drives, and what became of it."""

from typing import Literal

from msgspec import Struct

from gigabrain_schemas.tasks import Goal, Task


class GoTo(Struct, frozen=True):
    """Be at a place."""

    number: int  # of this order; another number is another order, even for the same place
    goal: Goal


class Explore(Struct, frozen=True):
    """See all that there is to see."""

    number: int


class Visit(Struct, frozen=True):
    """Be at some place that can be reached, chosen at random."""

    number: int


Order = GoTo | Explore | Visit


class Outcome(Struct, frozen=True, kw_only=True):
    """How far an order has come."""

    number: int  # of the order
    state: Literal["running", "done", "failed"] = "running"
    reason: str = ""  # in words
    held: bool = False  # the body does not follow now: the gate, or an operator, has it
    progress: float = 0.0
    distance: float | None = None  # [m] that is left along the path
    eta: float | None = None  # [s]
    goal: Goal | None = None  # where it drives to now
    path: tuple[tuple[float, float], ...] = ()  # [m] in the map, for drawing
    position_error: float | None = None  # [m] from the place that was asked for
    heading_error: float | None = None  # [rad] from the heading that was asked for


def where(goal: Goal) -> str:
    """A place as people read it."""
    turned = "" if goal.yaw is None else f", {goal.yaw:.2f} rad"
    return f"({goal.x:.2f}, {goal.y:.2f}{turned})"


def became(task: Task) -> str:
    """How a task ended, as people read it, with the reason."""
    if task.state == "cancelled":
        return f"{task.id} was {task.reason or task.state}"  # its reason says by what or whom
    errors = []
    if task.position_error is not None:
        errors.append(f"position error {task.position_error:.2f} m")
    if task.heading_error is not None:
        errors.append(f"heading error {task.heading_error:.2f} rad")
    measured = f" ({', '.join(errors)})" if errors else ""
    return f"{task.id} has {task.state}{f': {task.reason}' if task.reason else ''}{measured}"
