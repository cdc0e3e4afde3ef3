"""`gigabrain estop`, `release` and `enable`: requests to the gate; `audit`: shows their log."""

import os
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gigabrain_schemas.requests import GateReply
from gigabrain_zenoh.cli.options import (
    LOCAL,
    JsonLines,
    RobotAddress,
    Take,
    print_line,
    print_progress,
)
from gigabrain_zenoh.client.requests import BY_HAND
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import ConfigError, GigabrainError, NotConfirmed, unknown
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.host.signals import run_async
from gigabrain_zenoh.host.this_process import user_name

if TYPE_CHECKING:
    from gigabrain_schemas.logs import AuditRecord

MAX_ENTRIES = 1000


def estop(*, at: RobotAddress = LOCAL, reason: str = "") -> None:
    """Stop the robot at once, and latch it.

    Example: gigabrain estop --reason "a person is in the way"

    Exit code 3 and NOT CONFIRMED if no robot has confirmed the stop.
    Then press the hardware e-stop or cut the power.

    Args:
        reason: Reason, for the audit log.
    """
    if at.keys and not os.path.isdir(os.path.expanduser(at.keys)):
        print_progress(f"no folder {at.keys}: tried without keys")
        at = replace(at, keys=None)
    confirmed = False

    async def press(robot: Robot) -> GateReply:
        nonlocal confirmed
        reply = await robot.estop(reason)
        confirmed = True
        return reply

    try:
        _ask(at, press, "CONFIRMED by ", wait=False)
    except NotConfirmed:
        raise
    except KeyboardInterrupt:
        if not confirmed:
            print_progress(f"NOT CONFIRMED: ended before a robot answered; {BY_HAND}")
        raise
    except GigabrainError as error:  # any error means that no robot confirmed
        raise NotConfirmed(f"NOT CONFIRMED: {error}; {BY_HAND}") from None


def release(*, at: RobotAddress = LOCAL) -> None:
    """Release a latched robot. It moves only after `gigabrain enable`.

    Example: gigabrain release
    """
    _ask(at, lambda robot: robot.release())


def enable(*, at: RobotAddress = LOCAL, take: Take = False) -> None:
    """Let the robot's brain drive.

    Example: gigabrain enable
    """
    _ask(at, lambda robot: robot.enable(BRAIN, take=take))


def _ask(
    at: RobotAddress,
    request: Callable[[Robot], Awaitable[GateReply]],
    prefix: str = "",
    *,
    wait: bool = True,
) -> None:
    async def run() -> None:
        async with at.robot(f"{user_name()}-cli", wait=wait) as robot:
            start_s = time.perf_counter()
            reply = await request(robot)
            took_ms = (time.perf_counter() - start_s) * 1e3
            print_line(f"{prefix}{reply.robot_type}: {reply.text} ({took_ms:.0f} ms)")

    run_async(run())


def audit(
    robot: str = "",
    /,
    *,
    at: RobotAddress = LOCAL,
    newest: Annotated[int, Parameter(alias="-n")] = 20,
    follow: bool = False,
    json: JsonLines = False,
) -> None:
    """Show who did what to the robot: e-stops, releases, who drove, what stopped it.

    Example: gigabrain audit --newest 50

    Args:
        robot: Folder or name of a robot that does not run. Default: the running robot.
        newest: Number of entries.
        follow: Continue with new entries, until Ctrl-C.
    """
    from gigabrain_zenoh.runtime.audit import as_json, read_audit, readable

    if not 0 < newest <= MAX_ENTRIES:
        raise ConfigError(f"--newest: expected 1 to {MAX_ENTRIES}, got {newest}")
    to_text = as_json if json else readable
    if not robot:
        run_async(_print_live(at, newest, follow, to_text))
        return
    if follow or at.connect:
        raise ConfigError(f"--follow and --connect are for a running robot; leave out {robot!r}")
    for record in read_audit(_audit_folder(robot), newest):
        print_line(to_text(record))


async def _print_live(
    at: RobotAddress, newest: int, follow: bool, to_text: "Callable[[AuditRecord], str]"
) -> None:
    """Print the log of a running robot, and with `follow` new entries until Ctrl-C."""
    async with at.robot(wait=False) as robot:
        new_entries = robot.topic("audit") if follow else None
        for record in await robot.audit(newest):
            print_line(to_text(record))
        if new_entries:
            async for record in new_entries:
                print_line(to_text(record))


def _audit_folder(robot: str) -> Path:
    """Return the folder of a robot that holds its log. Raises UnknownName."""
    from gigabrain_zenoh.host.run_folders import state_dir
    from gigabrain_zenoh.runtime.audit import FOLDER

    robots = state_dir() / "robots"
    logs = robots.glob(f"*/**/{FOLDER}/*.jsonl")  # a namespace may contain slashes
    folders = {path.parent.parent for path in logs}
    known = {folder.relative_to(robots).as_posix(): folder for folder in folders}
    if robot in known:
        return known[robot]
    if (Path(robot) / FOLDER).is_dir():
        return Path(robot)
    raise unknown("robot with an audit log", robot, known)
