"""`gigabrain demo` and `gigabrain up`: a whole robot."""

import asyncio
import errno
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from gigabrain_zenoh import behaviours
from gigabrain_zenoh.cli.checked import above_zero, checked
from gigabrain_zenoh.config_places import located
from gigabrain_zenoh.deployment import (
    Deployment,
    deployment_path,
    host_of,
    load_deployment,
    recorded,
)
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.process import find
from gigabrain_zenoh.settings import LinkName, Resume


def demo(
    *,
    body: str = "turtlebot3_waffle",
    link: LinkName = "sim",
    world: str = "arena",
    seconds: float | None = None,
    seed: int = 0,
    speed: float = 1.0,
    behaviour: str = "navigate",
    turn: Literal["right", "left", "clearer"] = "right",
    resume: Resume | None = None,
    headless: bool = False,
    report: Path | None = None,
    record: Path | None = None,
    page: bool | None = None,
    port: int = 8080,
) -> int:
    """Drive a simulated robot round its world, until Ctrl-C: it makes a map, then visits places.

    Example: gigabrain demo --world house --seconds 60 --speed 5 --headless --report run.json

    Ends with 1 after any contact, without motion, or when a process has died.

    Parameters
    ----------
    body
        Which robot; see `gigabrain robots`.
    link
        How to reach it.
    world
        Where it drives; see `gigabrain worlds`.
    seconds
        End after this much simulated time [s].
    seed
        For the start pose and the noise of the sensors.
    speed
        Simulated over real time; other than 1, time waits for the brain.
    behaviour
        What it does: `navigate`, or `avoid`, which makes no map.
    turn
        Which way it turns from an obstacle, where it avoids.
    resume
        Whether it goes on by itself after a stop that has passed; a real body never does.
    headless
        Progress in a line instead of the live view.
    report
        Write what the run came to, as JSON, into this file.
    record
        Record the run from its very start into this file, for `gigabrain replay`.
    page
        Serve the operator page; as a rule where there is a live view too.
    port
        Where the page is; another free one where that is taken.
    """
    from gigabrain_zenoh.demo import Demo, DemoOptions
    from gigabrain_zenoh.page.beside import with_page

    behaviours.check(behaviour)
    find("gigabrain_drivers.catalog:load_robot")(body)
    find("gigabrain_drivers.sim.worlds:load_world")(world, 0)
    if record and record.exists():
        raise ConfigError(f"{record} exists; choose another file")
    above_zero("seconds", seconds)
    values: dict[str, object] = {
        "body": body,
        "link": link,
        "world": world,
        "seed": seed,
        "speed": speed,
        "resume": resume or ("manual" if link == "real" else "auto"),
        "router": "tcp/127.0.0.1:0",
        "decision": {"behaviour": behaviour, "turn": turn},
    }
    if behaviour == "navigate":
        values["decision"] = {"behaviour": behaviour, "begin": "roam"}
        values["perception"] = {"mapping": "slam"}
    if record:
        values |= recorded(record)
    deployment, where = checked(values, Deployment), ""
    if page or (page is None and not headless):
        deployment, where = with_page(deployment, port)
    options = DemoOptions(seconds=seconds, headless=headless, report=report, page=where)
    return asyncio.run(Demo(deployment, options).run())


def up(
    deployment: str, *, host: str | None = None, keys: Path | None = None, level: str = "info"
) -> int:
    """Start what a deployment file puts on this host, and keep it running until Ctrl-C.

    Example: gigabrain up deploy/demo.yaml

    Parameters
    ----------
    deployment
        A deployment file.
    host
        Which of the file's hosts this is; needed where it has several.
    keys
        The folder of this host's identity, in place of the one in the file.
    level
        The least level of what is logged: debug, info, warning or error.
    """
    from gigabrain_zenoh.launch import up as run

    path = deployment_path(deployment)
    loaded = load_deployment(path, str(keys.expanduser().absolute()) if keys else "")
    try:
        return asyncio.run(run(loaded, host_of(loaded, host), _printer(), level))
    except ConfigError as error:
        raise located(path, error) from None


def _printer() -> Callable[[str], None]:
    """Prints lines for as long as somebody reads them: a robot goes on without its pager."""
    read = True

    def say(line: str) -> None:
        nonlocal read
        try:
            if read:
                print(line, flush=True)
        except OSError as error:  # the pager has ended, or the terminal; a disk may have room again
            read = error.errno == errno.ENOSPC

    return say
