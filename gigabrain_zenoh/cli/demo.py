"""`gigabrain demo`: a whole robot on this machine, watched."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from gigabrain_zenoh.cli.checked import above_zero, checked
from gigabrain_zenoh.config.settings import LinkName, Resume
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.signals import run_async
from gigabrain_zenoh.runtime.deployment import Deployment, recorded


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Drive:
    """What drives, where and how."""

    body: str = "turtlebot3_waffle"
    "Which robot; see `gigabrain robots`."
    link: LinkName = "sim"
    "How to reach it."
    world: str = "arena"
    "Where it drives; see `gigabrain worlds`."
    seconds: float | None = None
    "End after this much simulated time [s]."
    seed: int = 0
    "For the start pose and the noise of the sensors."
    speed: float = 1.0
    "Simulated over real time; other than 1, time waits for the brain."
    lockstep_timeout: float = 0.15
    "How long [s] time waits for the brain there; longer for a slow machine."
    behaviour: str = "navigate"
    "What it does: `navigate`, or `avoid`, which makes no map."
    set: tuple[str, ...] = ()
    "A setting of the behaviour, as NAME=VALUE; may be repeated."
    resume: Resume | None = None
    "Whether it goes on by itself after a stop that has passed; a real body never does."

    def check(self) -> None:
        """Raises ConfigError, and UnknownName, for what can be told before anything starts."""
        from gigabrain_drivers.driver.catalog import load_robot
        from gigabrain_drivers.sim.worlds import load_world

        behaviours.load(self.behaviour)
        load_robot(self.body)
        load_world(self.world, 0)

    def values(self) -> dict[str, object]:
        """The deployment, raw."""
        demo = behaviours.load(self.behaviour).DEMO
        settings = {**demo, **behaviours.parse_settings(self.set)}
        values: dict[str, object] = {
            "body": self.body,
            "link": self.link,
            "world": self.world,
            "seed": self.seed,
            "speed": self.speed,
            "lockstep_timeout_s": self.lockstep_timeout,
            "resume": self.resume or ("manual" if self.link == "real" else "auto"),
            "router": "tcp/127.0.0.1:0",
        }
        if behaviours.needs_map(self.behaviour):
            values["perception"] = {"mapping": "slam"}
        return values | {"decision": {"behaviour": self.behaviour, "settings": settings}}


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Shown:
    """What is to be seen of it, and what stays."""

    headless: bool = False
    "Progress in a line instead of the live view."
    report: Path | None = None
    "Write what the run came to, as JSON, into this file."
    record: Path | None = None
    "Record the run from its very start into this file, for `gigabrain replay`."
    page: bool | None = None
    "Serve the operator page; as a rule where there is a live view too."
    port: int = 8080
    "Where the page is; another free one where that is taken."
    login: bool = False
    "Have the page want a token, which is in the address that is printed; for a shared machine."
    keep_stuck: Annotated[bool, Parameter(negative=())] = False
    "Leave a process alone that makes no progress, for a debugger."


DRIVE, SHOWN = Drive(), Shown()


def demo(*, drive: Drive = DRIVE, shown: Shown = SHOWN) -> int:
    """Drive a simulated robot round its world, until Ctrl-C: it makes a map, then visits places.

    Example: gigabrain demo --world house --seconds 60 --speed 5 --headless --report run.json

    Ends with 1 after any contact, without motion, or when a process has died.
    """
    from gigabrain_zenoh.launch.demo import Demo, DemoOptions
    from gigabrain_zenoh.ui.page.node import with_page

    drive.check()
    if shown.record and shown.record.exists():
        raise ConfigError(f"{shown.record} exists; choose another file")
    above_zero("seconds", drive.seconds)
    values = drive.values() | (recorded(shown.record) if shown.record else {})
    deployment, where = checked(values, Deployment), ""
    behaviours.check(deployment.decision)
    if shown.page or (shown.page is None and not shown.headless):
        deployment, where = with_page(deployment, shown.port, login=shown.login)
    options = DemoOptions(
        seconds=drive.seconds,
        headless=shown.headless,
        report=shown.report,
        page=where,
        keep_stuck=shown.keep_stuck,
    )
    return run_async(Demo(deployment, options).run())
