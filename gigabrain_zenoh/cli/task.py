"""`gigabrain goto`, `explore`, `patrol`, `mission` and `task`: send and control tasks."""

import asyncio
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from gigabrain_schemas.tasks import TaskStatus
from gigabrain_zenoh.cli.options import LOCAL, RobotAddress, on_bus, print_line
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.host.escaping import printable

if TYPE_CHECKING:
    from gigabrain_zenoh.client.tasks import Tasks

Coordinate = Annotated[float, Parameter(allow_leading_hyphen=True)]
Mode = Annotated[
    Literal["replace", "queue", "preempt"],
    Parameter(
        help="Replace all tasks, append to the queue, or run now and resume the others later."
    ),
]
Wait = Annotated[
    bool,
    Parameter(negative="--no-wait", help="Wait for the end; Ctrl-C then cancels the task."),
]
TaskName = Annotated[str, Parameter(help="Name of the task. Default: the current one.")]
TaskNameOrAll = Annotated[
    str, Parameter(help="Name of the task, or `all`. Default: the current one.")
]


def goto(
    place: Annotated[str, Parameter(allow_leading_hyphen=True)] = "",
    y: Annotated[float | None, Parameter(allow_leading_hyphen=True)] = None,
    yaw: Annotated[float | None, Parameter(allow_leading_hyphen=True)] = None,
    /,
    *,
    object: str = "",
    tag: int | None = None,
    mode: Mode = "replace",
    wait: Wait = True,
    at: RobotAddress = LOCAL,
) -> None:
    """Send the robot to a place, a thing or a tag, and wait for it.

    Example: gigabrain goto 3.0 1.5 1.57

    Example: gigabrain goto kitchen

    Example: gigabrain goto --object can

    Exit code 0 on arrival.

    Args:
        place: Place in the map: x [m], or the name of a place; see `gigabrain place list`.
        y: Place in the map [m], if x is given.
        yaw: Heading on arrival [rad]. Default: any, or that of the named place.
        object: Class of a thing: go to the nearest one. If none is known, look for one.
        tag: Number of an AprilTag: go to a place in front of it.
    """
    from gigabrain_zenoh.client.tasks import check_goal, check_object, check_place

    if object or tag is not None:
        if place or (object and tag is not None):
            raise ConfigError("goto: expected a place, --object or --tag; got more than one")
        check_object(object, tag)
        send(at, lambda tasks: tasks.go_to_object(object, tag=tag, how=mode), wait)
        return
    if not place:
        raise ConfigError("goto: expected a place, --object CLASS or --tag NUMBER")
    if y is None:
        if _is_number(place):
            raise ConfigError(f"goto: Y is missing: expected two numbers, or a name; got {place!r}")
        check_place(place)
        send(at, lambda tasks: tasks.go_to_place(place, how=mode), wait)
        return
    if not _is_number(place):
        raise ConfigError(f"goto: expected two numbers, or the name of a place; got {place!r}")
    x = float(place)
    check_goal(x, y, yaw)
    send(at, lambda tasks: tasks.go_to(x, y, yaw, how=mode), wait)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def explore(*, mode: Mode = "replace", wait: Wait = True, at: RobotAddress = LOCAL) -> None:
    """Explore until the map is complete.

    Example: gigabrain explore
    """
    send(at, lambda tasks: tasks.explore(how=mode), wait)


def patrol(
    file: Path,
    /,
    *,
    loops: int | None = None,
    mode: Mode = "replace",
    wait: Wait = True,
    at: RobotAddress = LOCAL,
) -> None:
    """Visit the places of a file in turn.

    Example: gigabrain patrol round.yaml --loops 3

    Args:
        file: YAML file: `points: [[1, 2], [3, 0.5, 1.57]]`, or names of its `places`.
        loops: Number of rounds. Default: no limit.
    """
    from gigabrain_zenoh.decision.tasks.mission import MAX_LOOPS, patrol_mission
    from gigabrain_zenoh.decision.tasks.mission_files import load_patrol

    if loops is not None and not 1 <= loops <= MAX_LOOPS:
        raise ConfigError(f"--loops: expected 1 to {MAX_LOOPS}, got {loops}")
    text = patrol_mission(load_patrol(file), loops)
    send(at, lambda tasks: tasks.carry_out(text, how=mode, label=file.stem), wait)


def mission(
    file: Path,
    /,
    *,
    check: bool = False,
    mode: Mode = "replace",
    wait: Wait = True,
    at: RobotAddress = LOCAL,
) -> None:
    """Run a mission from a file.

    Example: gigabrain mission evening.yaml

    Args:
        file: YAML file; docs/how-to/missions.md describes it.
        check: Only check the file; no robot is needed.
    """
    from gigabrain_zenoh.decision.tasks.mission import map_places
    from gigabrain_zenoh.decision.tasks.mission_files import load

    loaded, _ = load(file)  # raises for a wrong file, before connecting
    if check:
        needs = ", ".join(sorted(set(map_places(loaded))))
        print_line(f"{file}: valid{f'; the map must have the places {needs}' if needs else ''}")
        return
    send(at, lambda tasks: tasks.carry_out(file, how=mode), wait)


def list_(*, at: RobotAddress = LOCAL) -> None:
    """List the current task, the queue and the last tasks.

    Example: gigabrain task list
    """

    async def show(tasks: "Tasks") -> None:
        status = await tasks.status()
        rows = (*((status.current,) if status.current else ()), *status.queue, *status.done)
        for task in rows:
            about = f"{task.id:<12} {task.state:<10} {task.source:<14} {task.label}"
            print_line(f"{about}  {task.reason}")
        if not rows:
            print_line("no tasks")

    _with_tasks(at, show)


def cancel(task: TaskNameOrAll = "", /, *, at: RobotAddress = LOCAL) -> None:
    """Cancel the current task, or another one.

    Example: gigabrain task cancel goal-7
    """
    _change(at, task, lambda tasks: tasks.cancel(task))


def pause(task: TaskName = "", /, *, at: RobotAddress = LOCAL) -> None:
    """Pause a task.

    Example: gigabrain task pause
    """
    _change(at, task, lambda tasks: tasks.pause(task))


def resume(task: TaskName = "", /, *, at: RobotAddress = LOCAL) -> None:
    """Resume a paused task, or open the gripper of an arm that hands something over.

    Example: gigabrain task resume
    """
    _change(at, task, lambda tasks: tasks.resume(task))


def _change(at: RobotAddress, task: str, request: "Callable[[Tasks], Awaitable[str]]") -> None:
    from gigabrain_zenoh.client.tasks import check_task

    async def ask(tasks: "Tasks") -> None:
        print_line(await request(tasks))

    check_task(task)
    _with_tasks(at, ask)


def _with_tasks(at: RobotAddress, do: "Callable[[Tasks], Awaitable[None]]") -> None:
    from gigabrain_zenoh.client.tasks import Tasks
    from gigabrain_zenoh.host.this_process import user_name

    name = f"{user_name()}-cli"
    on_bus(at, lambda bus: do(Tasks(bus, at.folder, on_wait=print_line)), name)


def send(at: RobotAddress, give: "Callable[[Tasks], Awaitable[str]]", wait: bool) -> None:
    """Send a task to a robot, and show its progress until its end. Raises Refused if it fails."""

    async def run(tasks: "Tasks") -> None:
        from gigabrain_zenoh.decision.behaviours import describe_end

        name = await give(tasks)
        if not wait:
            return print_line(f"{name}: accepted")
        line = ProgressLine()
        try:
            ended = await tasks.result(name, lambda status: line.show(name, status))
        except asyncio.CancelledError:  # Ctrl-C
            line.clear()
            await tasks.cancel(name)
            print_line(f"{name}: cancelled")
            raise
        line.clear()
        if ended.state != "succeeded":
            raise Refused(describe_end(ended))
        print_line(describe_end(ended))

    _with_tasks(at, run)


class ProgressLine:
    """Shows the progress of a task: in one line of a terminal, or in a pipe one line per step."""

    def __init__(self) -> None:
        self._terminal = sys.stdout.isatty()
        self._step: str | None = None  # the last one printed

    def show(self, name: str, status: TaskStatus) -> None:
        """Show the progress of the task `name`."""
        text = progress(name, status)
        if self._terminal:
            print(f"\r\x1b[K{printable(text)}", end="", flush=True)
        elif status.doing != self._step:
            self._step = status.doing
            print_line(text)

    def clear(self) -> None:
        """Clear the line of the terminal."""
        if self._terminal:
            print("\r\x1b[K", end="", flush=True)


def progress(name: str, status: TaskStatus) -> str:
    """Return the progress of the task `name`, in a line."""
    current = status.current
    if current is None or current.id != name:
        queued = [task.id for task in status.queue]
        position = queued.index(name) + 1 if name in queued else 0
        return f"{name}: waiting, {position} in the queue" if position else f"{name}: accepted"
    if current.state == "paused":
        return f"{name}: paused, {current.reason}"
    if not status.doing:
        return f"{name}: accepted, {current.reason}" if current.reason else f"{name}: accepted"
    parts = [f"{name}: {status.doing}", f"{100 * status.progress:.0f} %"]
    if status.distance_remaining is not None:
        parts.append(f"{status.distance_remaining:.1f} m")
    if status.eta is not None:
        parts.append(f"{status.eta:.0f} s")
    if current.reason != status.doing:
        parts.append(current.reason)
    return ", ".join(parts)
