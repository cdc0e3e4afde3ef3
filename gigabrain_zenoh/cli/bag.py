"""`gigabrain record`, `bag` and `replay`: recordings."""

import math
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from gigabrain_zenoh.cli.options import (
    LOCAL,
    Output,
    RobotAddress,
    TopicNames,
    check_positive,
    checked,
    print_json,
    print_line,
)
from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.signals import run_async

Recording = Annotated[Path, Parameter(help="MCAP file.")]


def record(
    *,
    output: Output = None,
    topics: TopicNames = None,
    at: RobotAddress = LOCAL,
    seconds: float | None = None,
    split_size: float | None = None,
    split_time: float | None = None,
    pictures: float | None = None,
    raw_only: bool = False,
    keep_free: float = 200.0,
) -> int:
    """Record a robot's messages to an MCAP file, until Ctrl-C.

    Example: gigabrain record -o drive.mcap --topics scan state cmd_vel

    Exit code 1 if messages were lost on the way to the disk.

    Args:
        output: File to write. Default: named by the time, in this folder.
        seconds: End after this time [s].
        split_size: Start a new file after this size [MB].
        split_time: Start a new file after this time [s].
        pictures: Pictures and depth of each camera [Hz]; 0: none. Default: all.
        raw_only: Leave out the drawings for Foxglove, Lichtblick and Rerun: half the size.
        keep_free: Stop writing while less than this is free on the disk [MB].
    """
    from gigabrain_zenoh.recording.node import file_name
    from gigabrain_zenoh.recording.node import record as run

    check_positive(seconds=seconds, split_size=split_size, split_time=split_time)
    values = {
        "file": str(output or file_name()),
        "topics": topics or (),
        "pictures": pictures,
        "viewers": not raw_only,
        "split_mb": split_size,
        "split_s": split_time,
        "keep_free_mb": keep_free,
    }
    return run_async(run(checked(values, RecorderConfig), at.where(), seconds))


def info(file: Recording, *, json: bool = False) -> None:
    """Describe a recording: duration, and count, rate, gaps and size per topic.

    Example: gigabrain bag info drive.mcap --json

    Args:
        json: Print JSON.
    """
    from gigabrain_zenoh.recording.bag_reader import print_info
    from gigabrain_zenoh.recording.bag_reader import read_info as read

    found = read(file)
    if json:
        print_json(found, indent=2)
    else:
        print_info(found)


def check(file: Recording) -> int:
    """Check that a recording is complete: checksums, its end, and gaps between messages.

    Example: gigabrain bag check drive.mcap

    Exit code 1 if it is not complete.
    """
    from gigabrain_zenoh.recording.bag_reader import faults
    from gigabrain_zenoh.recording.bag_reader import read_info as read

    found = read(file)
    problems = faults(found)
    for problem in problems:
        print_line(f"{file}: {problem}")
    if found.damages or not found.finished:
        print(f"repair it with: gigabrain bag recover {file}")
    if not problems:
        print(f"{file}: complete, {found.messages} messages in {found.seconds:g} s")
    return 1 if problems else 0


def recover(file: Recording, *, output: Output = None) -> int:
    """Copy what is readable of a damaged or unfinished recording to a new file.

    Example: gigabrain bag recover drive.mcap -o recovered.mcap

    Args:
        output: File to write. Default: the same name with `_recovered`.
    """
    from gigabrain_zenoh.recording.recovery import recover as run

    done = run(file, output or file.with_name(f"{file.stem}_recovered{file.suffix}"))
    for damage in done.damages:
        print_line(f"{file}: byte {damage.offset}: {damage.text}")
    if not done.messages:
        done.path.unlink()
        print(f"{file}: nothing could be recovered")
        return 1
    print(f"{done.path}: {done.messages} messages")
    return 0


def play(
    file: Recording,
    *,
    rate: float = 1.0,
    start: float = 0.0,
    loop: bool = False,
    topics: TopicNames = None,
    remap: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    beside_robot: bool = False,
    at: RobotAddress = LOCAL,
) -> int:
    """Publish a recording again, its last map first.

    Example: gigabrain bag play drive.mcap --rate 2 --start 30 --remap robot/scan=old/scan

    Args:
        rate: Factor of the recorded pace.
        start: Start this long after its first message [s].
        loop: Repeat until Ctrl-C.
        remap: Publish a key on another: robot/scan=old/scan.
        beside_robot: Play even if a driver runs. Its gate drops recorded commands; its brain
            gets mixed data.
    """
    from gigabrain_zenoh.recording.player import PlayOptions
    from gigabrain_zenoh.recording.player import play as run

    if not 0.01 <= rate <= 100:
        raise ConfigError(f"--rate: expected a number from 0.01 to 100, got {rate:g}")
    if not 0 <= start < math.inf:
        raise ConfigError(f"--start: expected 0 or more seconds, got {start:g}")
    options = PlayOptions(
        rate=rate, start_s=start, loop=loop, topics=tuple(topics or ()), remap=_pairs(remap or [])
    )
    return run_async(run(file, options, at.where(), beside_robot=beside_robot))


def _pairs(texts: list[str]) -> dict[str, str]:
    from gigabrain_zenoh.bus.key_expressions import check_key_expression

    pairs = dict(text.split("=", 1) for text in texts if text.count("=") == 1)
    for text in texts:
        old, _, new = text.partition("=")
        if pairs.get(old) != new or "*" in text:
            raise ConfigError(f"--remap: expected old/key=new/key, got {text!r}")
        check_key_expression(old)
        check_key_expression(new)
    return pairs


def plot(file: Recording, fields: list[str], *, output: Output = None) -> None:
    """Plot values of a recording over time, as a PNG.

    Example: gigabrain bag plot drive.mcap state.velocity.linear_x cmd_vel.linear_x

    Args:
        fields: Topic and field: cmd_vel.linear_x, state.joints.0.position, robot/state.pose.x.
        output: File to write. Default: the recording's name with .png.
    """
    from gigabrain_zenoh.recording.message_tables import plot as draw

    print(draw(file, fields, output or file.with_suffix(".png")))


def convert(file: Recording, *, csv: Path | None = None, lerobot: Path | None = None) -> None:
    """Convert a recording to CSV tables, one per topic, or to a LeRobot dataset.

    Example: gigabrain bag convert drive.mcap --csv tables

    Args:
        csv: Folder for the tables.
        lerobot: New folder for the dataset.
    """
    from gigabrain_zenoh.recording.message_tables import write_csv

    if csv is None and lerobot is None:
        raise ConfigError("no output; add --csv FOLDER or --lerobot FOLDER")
    for path in write_csv(file, csv) if csv else ():
        print_line(str(path))
    if lerobot:
        from gigabrain_zenoh.recording.lerobot import convert as write_lerobot  # needs its extra

        print(write_lerobot(file, lerobot))


def replay(
    *,
    check: Path,
    process: Literal["perception", "decision", "control", "safety"],
    deployment: str | None = None,
) -> int:
    """Feed a recording to a process in fake time, and compare its output with the recorded one.

    Example: gigabrain replay --check drive.mcap --process decision

    Exit code 1 if the output differs; the first difference is printed.

    Args:
        check: Recording, made from the start of the run.
        process: Process to run.
        deployment: Deployment file with its settings. Default: the recorded settings.
    """
    import msgspec
    from rich.console import Console

    from gigabrain_zenoh.launch.deployment import deployment_path, load_deployment
    from gigabrain_zenoh.launch.processes import node_of
    from gigabrain_zenoh.recording.process_replay import replay_file

    settings = None
    if deployment:
        loaded = load_deployment(deployment_path(deployment))
        settings = dict(msgspec.to_builtins(loaded.settings(process)))
    with Console(stderr=True).status(f"replaying {process}; the first time takes a minute"):
        return run_async(replay_file(check, process, settings, node_of))
