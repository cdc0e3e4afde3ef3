"""`gigabrain audit`: who did what to the robot, and what came of it."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gigabrain_zenoh.cli.where import HERE, Which
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from gigabrain_schemas.audit import AuditRecord


def audit(
    robot: str = "",
    /,
    *,
    at: Which = HERE,
    newest: Annotated[int, Parameter(alias="-n")] = 20,
    follow: bool = False,
    json: bool = False,
) -> int:
    """Show who did what to the robot: e-stops, releases, who drove, what held it back.

    Example: gigabrain audit --newest 50

    Asks the robot that runs, or reads what a robot has left on this machine.

    Parameters
    ----------
    robot
        The folder of a robot that does not run, or its name; without it, the one that runs.
    newest
        How many entries.
    follow
        Go on with what happens from now on, until Ctrl-C.
    json
        One JSON object per line.
    """

    from gigabrain_zenoh.runtime import audit

    if not 0 < newest <= 1000:
        raise ConfigError(f"--newest: expected 1 to 1000, got {newest}")
    show = audit.as_json if json else audit.readable
    if robot:
        if follow or at.connect:
            raise ConfigError("leave out the name of a robot that runs")
        _print(map(show, audit.read_audit(_folder(robot), newest)))
    else:
        run_async(_ask(at, newest, follow, show))
    return 0


async def _ask(at: Which, newest: int, follow: bool, show: "Callable[[AuditRecord], str]") -> None:
    """Show what a robot that runs has in its log, and with `follow` what comes."""
    from gigabrain_zenoh.client.robot import connect as connect_robot

    async with connect_robot(
        at.connect, namespace=at.namespace, keys=at.folder, wait=False
    ) as found:
        following = found.topic("audit") if follow else None
        _print(map(show, await found.audit(newest)))
        if following:
            async for record in following:
                _print([show(record)])


def _folder(robot: str) -> Path:
    """Where a robot has left its log. Raises ConfigError, and UnknownName."""
    from gigabrain_zenoh.errors import unknown
    from gigabrain_zenoh.host.run_folders import state_dir
    from gigabrain_zenoh.runtime.audit import FOLDER

    known = {path.parent.name: path.parent for path in (state_dir() / "robots").glob(f"*/{FOLDER}")}
    if robot in known:
        return known[robot]
    if (Path(robot) / FOLDER).is_dir():
        return Path(robot)
    raise unknown("robot with an audit log", robot, known)


def _print(lines: Iterable[str]) -> None:
    for line in lines:
        print(line, flush=True)
