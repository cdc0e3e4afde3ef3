"""`gigabrain goto`, `explore`, `patrol`, `mission` and `task`: what the robot is sent to do."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from gigabrain_zenoh.cli.where import HERE, Which, say
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from gigabrain_schemas.tasks import Task
    from gigabrain_zenoh.client.tasks import Tasks

How = Literal["replace", "queue", "preempt"]
Wait = Annotated[bool, Parameter(help="Wait for the end; Ctrl-C cancels the task meanwhile.")]
HowOption = Annotated[
    How, Parameter(help="In place of all there is to do, after it, or before it.")
]
Named = Annotated[str, Parameter(help="Which one; without, what it is at.")]
NamedOrAll = Annotated[str, Parameter(help="Which one, or `all`; without, what it is at.")]


def goto(
    x: Annotated[float, Parameter(allow_leading_hyphen=True)],
    y: Annotated[float, Parameter(allow_leading_hyphen=True)],
    yaw: Annotated[float | None, Parameter(allow_leading_hyphen=True)] = None,
    /,
    *,
    how: HowOption = "replace",
    wait: Wait = True,
    at: Which = HERE,
) -> int:
    """Send the robot to a place in its map, and wait until it is there.

    Example: gigabrain goto 3.0 1.5 1.57

    Ends with 0 only once it is there.

    Parameters
    ----------
    x
        In the map [m].
    y
        In the map [m].
    yaw
        Which way it should look there [rad]; any without.
    """
    return _send(at, lambda tasks: tasks.go_to(x, y, yaw, how=how), wait)


def explore(*, how: HowOption = "replace", wait: Wait = True, at: Which = HERE) -> int:
    """Have it drive until nothing is left to be seen.

    Example: gigabrain explore
    """
    return _send(at, lambda tasks: tasks.explore(how=how), wait)


def patrol(
    file: Path,
    /,
    *,
    loops: int | None = None,
    how: HowOption = "replace",
    wait: Wait = True,
    at: Which = HERE,
) -> int:
    """Have it go round the places of a file.

    Example: gigabrain patrol round.yaml --loops 3

    Parameters
    ----------
    file
        A YAML file: `points: [[1, 2], [3, 0.5, 1.57]]`, or names out of its `places`.
    loops
        How often; for ever without.
    """
    from gigabrain_zenoh.decision.tasks.mission import MAX_LOOPS, load_patrol, patrol_mission
    from gigabrain_zenoh.errors import ConfigError

    if loops is not None and not 1 <= loops <= MAX_LOOPS:
        raise ConfigError(f"--loops: expected 1 to {MAX_LOOPS}, got {loops}")
    text = patrol_mission(load_patrol(file), loops)
    return _send(at, lambda tasks: tasks.carry_out(text, how=how, label=file.stem), wait)


def mission(
    file: Path,
    /,
    *,
    check: bool = False,
    how: HowOption = "replace",
    wait: Wait = True,
    at: Which = HERE,
) -> int:
    """Have it carry out a mission, which is a file.

    Example: gigabrain mission evening.yaml

    Parameters
    ----------
    file
        A YAML file; docs/missions.md has what may be in it.
    check
        Only say whether the file is right; no robot is needed.
    """
    from gigabrain_zenoh.decision.tasks.mission import load

    load(file)  # better told here than by the robot
    if check:
        say(f"{file} is right")
        return 0
    return _send(at, lambda tasks: tasks.carry_out(file, how=how), wait)


def list_(*, at: Which = HERE) -> int:
    """Show what it is at, what waits, and what was last.

    Example: gigabrain task list
    """

    async def show(tasks: "Tasks") -> None:
        status = await tasks.status()
        rows = (*((status.current,) if status.current else ()), *status.queue, *status.done)
        for task in rows:
            say(f"{task.id:<12} {task.state:<10} {task.source:<14} {task.label}  {task.reason}")
        if not rows:
            say("nothing to do, and nothing done yet")

    return _with(at, show)


def cancel(task: NamedOrAll = "", /, *, at: Which = HERE) -> int:
    """End what it is at, or another task.

    Example: gigabrain task cancel goal-7
    """
    return _with(at, lambda tasks: _told(tasks.cancel(task)))


def pause(task: Named = "", /, *, at: Which = HERE) -> int:
    """Have a task wait.

    Example: gigabrain task pause
    """
    return _with(at, lambda tasks: _told(tasks.pause(task)))


def resume(task: Named = "", /, *, at: Which = HERE) -> int:
    """Have a task go on that waits for a person.

    Example: gigabrain task resume
    """
    return _with(at, lambda tasks: _told(tasks.resume(task)))


async def _told(answer: Awaitable[str]) -> None:
    say(await answer)


def _with(at: Which, do: "Callable[[Tasks], Awaitable[None]]") -> int:
    import getpass

    from gigabrain_zenoh.client.tasks import Tasks
    from gigabrain_zenoh.runtime.connect import joined

    async def run() -> None:
        async with joined(at.where(), f"{getpass.getuser()}-cli") as (bus, _):
            await do(Tasks(bus, at.folder, on_wait=say))

    run_async(run())
    return 0


def _send(at: Which, send: "Callable[[Tasks], Awaitable[str]]", wait: bool) -> int:
    from gigabrain_zenoh.cli.task_line import Line

    async def run(tasks: "Tasks") -> None:
        name = await send(tasks)
        if not wait:
            return say(f"{name}: accepted")
        line = Line()
        try:
            ended = await tasks.result(name, lambda status: line.show(name, status))
        except asyncio.CancelledError:  # Ctrl-C
            line.end()
            await tasks.cancel(name)
            say(f"{name}: cancelled")
            raise
        line.end()
        _tell(ended)

    return _with(at, run)


def _tell(ended: "Task") -> None:
    from gigabrain_zenoh.decision.tasks.drive_command import describe_end

    if ended.state != "succeeded":
        raise Refused(describe_end(ended))
    say(describe_end(ended))
