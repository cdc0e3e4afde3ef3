"""`gigabrain demo`, `up`, `robots`, `worlds` and `render`: whole robots on this machine."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from gigabrain_zenoh.cli.cameras import check_recognizer, with_cameras
from gigabrain_zenoh.cli.config import (
    Sets,
    SettingsFiles,
    merged_file,
    merged_values,
    rows_of,
)
from gigabrain_zenoh.cli.options import (
    Body,
    KeepStuck,
    Level,
    Seed,
    World,
    check_names,
    check_positive,
    checked,
)
from gigabrain_zenoh.config.loading import beside, located
from gigabrain_zenoh.config.settings import LinkName, PageConfig, Resume
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import check_new_file, check_picture_path
from gigabrain_zenoh.host.signals import run_async
from gigabrain_zenoh.launch.deployment import (
    Deployment,
    deployment_path,
    host_of,
    recorded,
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RobotOptions:
    """Robot, world and behaviour of a demo."""

    body: Body = "turtlebot3_waffle"
    link: LinkName = "sim"
    "How to reach the robot: simulated, emulated or real."
    world: World | None = None
    "Default: that of the robot's file, mostly arena."
    seconds: float | None = None
    "End after this much simulated time [s]."
    seed: Seed = 0
    speed: float = 1.0
    "Real-time factor. If it is not 1, simulated time waits for the brain."
    lockstep_timeout: float = 0.15
    "Longest wait for the brain [s]; increase it on a slow machine."
    behaviour: str = "navigate"
    "Behaviour: `navigate`, or `avoid`, which makes no map."
    map: str = ""
    "Saved map to localize in, instead of mapping; see `gigabrain map list`."
    set: Sets = ()
    settings: SettingsFiles = ()
    cameras: bool = False
    "Use the robot's cameras; see docs/how-to/cameras.md."
    resume: Resume | None = None
    "Resume after a stop once its cause is gone. Default: auto; manual with --link real."

    def check(self) -> None:
        """Raise ConfigError or UnknownName for an invalid value."""
        behaviours.load(self.behaviour)
        check_names([self.body], [self.world] if self.world else [])
        check_positive(seconds=self.seconds)

    def values(self) -> dict[str, object]:
        """Return the fields of a Deployment, unchecked."""
        from gigabrain_drivers.driver.catalog import load_robot, robot_path
        from gigabrain_drivers.driver.robot import Demo as PlainDemo
        from gigabrain_drivers.sim.worlds import mission_file

        robot, settings = load_robot(self.body), dict(behaviours.load(self.behaviour).DEMO)
        mapped = behaviours.needs_map(self.behaviour)
        plan = robot.demo if self.cameras or not robot.demo.cameras else PlainDemo()
        world = self.world or plan.world
        if plan.mission and mapped and world == plan.world and self.link != "real":
            folder = robot_path(self.body).parent
            settings = {"mission": mission_file(plan.mission, folder)}
        values: dict[str, object] = {
            "body": self.body,
            "link": self.link,
            "world": beside(world, Path()),
            "seed": self.seed,
            "speed": self.speed,
            "lockstep_timeout_s": self.lockstep_timeout,
            "cameras": self.cameras,
            "resume": self.resume or ("manual" if self.link == "real" else "auto"),
            "router": "tcp/127.0.0.1:0",
        }
        if mapped and robot.has_base:
            values["perception"] = {"mapping": "slam"}
        if self.map:
            values["perception"] = {"mapping": "localize", "map": checked_map(self.map)}
        return values | {"decision": {"behaviour": self.behaviour, "settings": settings}}


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Display and output of a demo."""

    headless: bool = False
    "Print progress in one line instead of the live view."
    report: Path | None = None
    "Write the results of the run as JSON to this file."
    record: Path | None = None
    "Record the whole run to this file, for `gigabrain replay`."
    page: Annotated[bool | None, Parameter(negative="--no-page")] = None
    "Serve the operator page. Default: with the live view."
    port: int = 8080
    "Port of the page; a free one if it is taken."
    login: bool = False
    "Require a token for the page, for a shared machine. The printed address holds it."
    keep_stuck: KeepStuck = False


ROBOT, VIEW = RobotOptions(), ViewOptions()


def checked_map(name: str) -> str:
    """Return the name of a saved map, or the path of its file. Raises ConfigError."""
    from gigabrain_zenoh.errors import unknown
    from gigabrain_zenoh.mapping import map_file
    from gigabrain_zenoh.mapping.map_list import saved_maps

    path = map_file.path_of(name)
    if not path.is_file():
        raise unknown("map", name, [one.name for one in saved_maps()[0]] or ["none"])
    map_file.load(path)
    return name if path == map_file.saved_map_path(name) else str(path.absolute())


def demo(*, robot: RobotOptions = ROBOT, view: ViewOptions = VIEW) -> int:
    """Run a simulated robot until Ctrl-C: it makes a map, then visits places.

    Example: gigabrain demo --world house --seconds 60 --speed 5 --headless

    Exit code 1 after a contact, if it did not move, or if a process died; 0 after Ctrl-C.
    """
    from gigabrain_zenoh.launch.demo import Demo, DemoOptions, only_host, with_page

    robot.check()
    if view.record:
        check_new_file(view.record)
    values = robot.values() | (recorded(view.record) if view.record else {})
    checked(values, Deployment)
    merged = merged_values(values, robot.settings, robot.set)
    host = only_host(merged.deployment)
    deployment, address = with_cameras(merged.deployment, host), ""
    check_recognizer(deployment, host)
    if view.page or (view.page is None and not view.headless):
        checked({"port": view.port}, PageConfig)
        deployment, address = with_page(deployment, view.port, login=view.login)
    options = DemoOptions(
        seconds=robot.seconds,
        headless=view.headless,
        report=view.report,
        page=address,
        rows=rows_of(merged, deployment),
        keep_stuck=view.keep_stuck,
    )
    return run_async(Demo(deployment, options).run())


def up(
    deployment: str,
    *,
    host: str | None = None,
    map: str = "",
    set: Sets = (),
    settings: SettingsFiles = (),
    keys: Path | None = None,
    level: Level = "info",
    keep_stuck: KeepStuck = False,
    cameras: bool = False,
) -> None:
    """Run the processes of a deployment file on this host, until Ctrl-C.

    Example: gigabrain up deploy/demo.yaml

    A process that dies or hangs is started again.

    Args:
        deployment: Deployment file, or the name of a known one.
        host: Name of this host in the file; required if the file has several.
        map: Saved map to localize in; replaces the file's map settings.
        keys: Folder of this host's identity, instead of the one in the file.
        level: Lowest level to log.
        cameras: Use the robot's cameras, as `cameras: on` in the file does.
    """
    from gigabrain_zenoh.host.terminal import LINES, Display, writer
    from gigabrain_zenoh.launch.up import up as run

    if map:
        quoted = json.dumps(
            checked_map(map), ensure_ascii=False
        )  # quoted, so that a map called 2 is not read as a number
        set = (*set, "perception.mapping=localize", f"perception.map={quoted}")
    set = (*set, "cameras=true") if cameras else set
    merged = merged_file(deployment, settings, set, keys)
    path, loaded = deployment_path(deployment), merged.deployment
    try:
        where = host_of(loaded, host)
        if "decision" in loaded.hosts[where]:
            merged.check_behaviour()
        loaded = with_cameras(loaded, where)
        check_recognizer(loaded, where)
        rows = rows_of(merged, loaded, robot="driver" in loaded.hosts[where])
        with Display(writer(sys.stdout), LINES) as display:

            def put(line: str) -> None:
                display.put(f"{line}\n")

            file, stuck = str(path.absolute()), keep_stuck
            run_async(run(loaded, where, put, level, keep_stuck=stuck, file=file, rows=rows))
    except ConfigError as error:
        raise located(path, error) from None


def robots() -> None:
    """List the known robots, their links and their files.

    Example: gigabrain robots
    """
    from gigabrain_drivers.driver.catalog import load_robot, robot_files, robot_links

    for name, path in robot_files().items():
        robot = load_robot(name)
        links = ", ".join(robot_links(robot))
        print(f"{name:<20} {robot.summary} ({links})  {path}")


def worlds() -> None:
    """List the simulated worlds.

    Example: gigabrain worlds
    """
    from gigabrain_drivers.sim.worlds import world_names

    for name, about in world_names().items():
        print(f"{name:<14} {about}")


def render(
    file: Path, *, body: Body = "turtlebot3_waffle", world: World = "house", seed: Seed = 0
) -> None:
    """Draw a robot in its world to a PNG file.

    Example: gigabrain render waffle.png --world house

    Args:
        file: File to write.
    """
    from gigabrain_drivers.sim.picture import portray

    check_picture_path(file)
    portray(body, world, seed, file)
    print(file)
