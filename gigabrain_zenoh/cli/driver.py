"""`gigabrain driver` and `emulate`: tools for authors of drivers."""

import logging
import os
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Literal, Self

from gigabrain_zenoh.cli.options import (
    Body,
    Seed,
    World,
    check_positive,
    checked,
    print_line,
)
from gigabrain_zenoh.config.settings import EmulatorConfig, LinkName
from gigabrain_zenoh.host.signals import run_async


class _WarningCounter(logging.Handler):
    """Counts the warnings of the driver under test inside `with`, instead of printing them."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: Counter[str] = Counter()

    def emit(self, record: logging.LogRecord) -> None:
        self.texts[record.getMessage()] += 1

    def __enter__(self) -> Self:
        logging.getLogger().addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        logging.getLogger().removeHandler(self)

    def __str__(self) -> str:
        return "; ".join(
            f"{text} ({times} times)" if times > 1 else text for text, times in self.texts.items()
        )


def test(
    name: Body,
    *,
    link: Literal["sim", "emulated"] | None = None,  # noqa: PT028
    repeat: int = 1,  # noqa: PT028
) -> int:
    """Run the conformance checks on a driver. Exit code 1 if one fails.

    Example: gigabrain driver test mycustombot --link emulated

    A check that does not apply to a link is shown as skipped, with the reason.

    Args:
        link: Link to test over. Default: emulated if the robot has it, as it checks more.
        repeat: Number of times to try each stop; the table shows the worst and the median.
    """
    from rich.console import Console
    from rich.table import Table

    from gigabrain_drivers.driver.catalog import load_robot, robot_links
    from gigabrain_zenoh.diagnostics.discovery import plain
    from gigabrain_zenoh.qa.conformance import kit
    from gigabrain_zenoh.qa.judging import coloured

    check_positive(repeat=repeat)
    links = robot_links(load_robot(name))
    chosen: LinkName = link or ("emulated" if "emulated" in links else "sim")
    table = Table(title=f"{name}, link {chosen}")
    for title in ("check", "criterion", "measured", "verdict"):
        table.add_column(title)
    console = Console()
    warnings = _WarningCounter()
    place = tempfile.TemporaryDirectory(prefix="gigabrain-")
    with warnings, place as folder, console.status("") as status:
        results = run_async(kit.check(name, chosen, Path(folder), status.update, repeat))
    for result in results:
        table.add_row(*map(plain, result[:-1]), coloured(result.verdict))
    if warnings.texts:
        console.print(f"warnings during the checks: {warnings}", markup=False, soft_wrap=True)
    console.print(table)
    return int(any(result.verdict == "FAILED" for result in results))


def trace(
    name: Body,
    *,
    link: Literal["emulated", "real"] = "emulated",
    part: Literal["base", "scan"] = "base",
    seconds: float = 2.0,
    linear_x: float = 0.0,
    linear_y: float = 0.0,
    angular_z: float = 0.0,
) -> int:
    """Print the bytes on a robot's line in both directions, each frame with its meaning.

    Example: gigabrain driver trace mycustombot --seconds 0.5 --linear-x 0.1

    It runs the driver itself: on an emulator, or on the real port, which no
    other process may have open. A real robot gets the command zero only.
    A running driver logs the same lines with
    `gigabrain driver run NAME --link real --level debug`.

    Exit code 1 if nothing was received.

    Args:
        link: Emulated or real line.
        part: Line of the base, or of its lidar.
        seconds: Duration [s].
        linear_x: Command to an emulated robot, forward [m/s].
        linear_y: Command to an emulated robot, to its left [m/s].
        angular_z: Command to an emulated robot, counter-clockwise [rad/s].
    """
    check_positive(seconds=seconds)
    speeds = {"linear_x": linear_x, "linear_y": linear_y, "angular_z": angular_z}
    received = _print_trace(name, link, part, seconds, speeds)
    if not received:
        print("nothing was received", file=sys.stderr)
    return int(not received)


def bringup(name: Body, *, link: Literal["emulated", "real"] = "real", seconds: float = 5.0) -> int:
    """Compare a ROS 2 robot with its file: topics, types, QoS, rates, stamps and frames.

    Example: gigabrain driver bringup turtlebot3_ros2 --link emulated

    It only listens, and sends the robot nothing. Each line that is not ok
    says what to do. Exit code 1 if one is an error.

    Args:
        link: The robot itself, or its emulator.
        seconds: Time to listen [s].
    """
    from rich.console import Console
    from rich.table import Table

    from gigabrain_zenoh.diagnostics.discovery import plain
    from gigabrain_zenoh.qa.conformance import ros2_bringup

    check_positive(seconds=seconds)
    with tempfile.TemporaryDirectory(prefix="gigabrain-") as folder:
        found = run_async(ros2_bringup.check(name, link, Path(folder), seconds))
    table = Table(title=f"{name}, link {link}")
    for title in ("topic", "verdict", "found", "to do"):
        table.add_column(title)
    for one in found:
        colour = {"ok": "green", "warning": "yellow", "error": "red"}[one.verdict]
        verdict = f"[{colour}]{one.verdict}[/{colour}]"
        table.add_row(plain(one.what), verdict, plain(one.text), plain(one.remedy))
    Console().print(table)
    return int(any(one.verdict == "error" for one in found))


def calibrate(
    name: Body, *, port: str | None = None, file: Path | None = None, leader: bool = False
) -> None:
    """Calibrate an arm: its motors switch off, and a person moves each joint by hand.

    Example: gigabrain driver calibrate so101 --port /dev/ttyACM0

    It asks before each step. Only if you agree, it writes the middle and the
    limits of each joint into the servos. No process may drive the arm meanwhile.

    Args:
        port: Port of the arm. Default: the one in the robot's file.
        file: File to write. Default: the one in the robot's file, or one in the state folder.
        leader: Calibrate a second arm that leads the robot's: `gigabrain teleop --leader`.
    """
    from msgspec.structs import replace

    from gigabrain_drivers.bodies.feetech.calibrate import calibrate as make
    from gigabrain_drivers.bodies.feetech.calibration import calibration_path
    from gigabrain_drivers.bodies.feetech.driver import FeetechOptions
    from gigabrain_drivers.bodies.feetech.leader import LEADER, leader_file
    from gigabrain_drivers.driver.catalog import load_link
    from gigabrain_drivers.driver.robot import Run
    from gigabrain_zenoh.cli.calibrating import Terminal
    from gigabrain_zenoh.errors import ConfigError

    robot, _, options, folder = load_link(name, Run(folder=Path(), link="real"))
    if not isinstance(options, FeetechOptions):
        raise ConfigError(f"{robot.robot_type} needs no calibration: its driver is none of servos")
    options = replace(options, port=port) if port else options
    path = calibration_path(robot.robot_type, options.calibration, folder)
    if leader:
        if name != LEADER or not port:
            raise ConfigError(f"--leader: expected {LEADER} --port PORT, as only an SO-101 leads")
        robot, options, path = leader_file(port)
    run_async(make(robot, options, path := file or path, Terminal(), leader=leader))
    print(f"{path}: the calibration of {'the leader' if leader else robot.robot_type}")


def _print_trace(
    name: str, link: LinkName, part: str, seconds: float, speeds: dict[str, float]
) -> bool:
    """Print the bytes; return True if the robot sent any, or if the reader closed the pipe."""
    from gigabrain_schemas.base import Velocity
    from gigabrain_zenoh.qa.conformance import authoring

    with tempfile.TemporaryDirectory(prefix="gigabrain-") as folder:
        tracing = authoring.trace_line(
            name,
            link,
            Path(folder),
            part=part,
            seconds=seconds,
            wanted=Velocity(**speeds),
            print_line=print_line,
        )
        try:
            return bool(run_async(tracing))
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return True


def new(name: str, *, folder: Path = Path()) -> None:
    """Create the package of a new driver, which passes `gigabrain driver test` as it is.

    Example: gigabrain driver new myrobot

    Existing files are not overwritten.

    Args:
        name: Name of the robot and its driver: lower-case letters, digits, underscores.
        folder: Where to create the package's folder.
    """
    from gigabrain_zenoh.qa.conformance.authoring import write_package

    path = write_package(name, folder)
    print(f"{path}: edit robot.yaml and driver.py; README.md describes the next steps")


def emulate(
    name: Body, *, world: World = "arena", seed: Seed = 0, ports: Path | None = None
) -> None:
    """Emulate a robot's hardware on serial and TCP ports, with MuJoCo, until Ctrl-C.

    Example: gigabrain emulate mycustombot --world house

    In another terminal: gigabrain driver run mycustombot --link emulated

    Type faults, one per line: `silence`, `bit_errors=0.001`, `scan unplugged`, `off`.

    Args:
        ports: Folder in which its ports appear.
    """
    from gigabrain_drivers.driver.catalog import ports_folder
    from gigabrain_drivers.emulators.process import emulate as run

    folder = ports or ports_folder(name)
    values = {"body": name, "world": world, "seed": seed, "folder": str(folder.absolute())}
    run_async(run(checked(values, EmulatorConfig), print_line))
