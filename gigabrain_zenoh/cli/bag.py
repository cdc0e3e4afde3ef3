"""`gigabrain bag`: what can be done with a recording."""

import math
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter

from gigabrain_zenoh.cli.where import HERE, Which
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.signals import run_async


def info(file: Path, *, json: bool = False) -> int:
    """Show what is in a recording: duration, and per topic counts, rates, gaps and size.

    Example: gigabrain bag info drive.mcap --json

    Parameters
    ----------
    file
        The recording.
    json
        For programs instead of people.
    """
    from gigabrain_zenoh.recording.bag_info import print_info
    from gigabrain_zenoh.recording.bag_info import read_info as read

    found = read(file)
    if json:
        print(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
    else:
        print_info(found)
    return 0


def check(file: Path) -> int:
    """Check a recording: checksums, its end, and gaps in what was sent.

    Example: gigabrain bag check drive.mcap

    Ends with 0 where it is whole, with 1 where it is not.

    Parameters
    ----------
    file
        The recording.
    """
    from gigabrain_zenoh.recording.bag_info import faults
    from gigabrain_zenoh.recording.bag_info import read_info as read

    found = read(file)
    wrong = faults(found)
    for fault in wrong:
        print(f"{file}: {fault}")
    if found.damages or not found.finished:
        print(f"mend it with: gigabrain bag recover {file}")
    if not wrong:
        print(f"{file}: whole, {found.messages} messages in {found.seconds:g} s")
    return 1 if wrong else 0


def recover(file: Path, *, output: Annotated[Path | None, Parameter(alias="-o")] = None) -> int:
    """Write all that can be read of a damaged or unfinished recording into a new one.

    Example: gigabrain bag recover drive.mcap -o mended.mcap

    Parameters
    ----------
    file
        The recording.
    output
        The new file; without it, beside the old one with `_recovered` in its name.
    """
    from gigabrain_zenoh.recording.bag_recovery import recover as mend

    done = mend(file, output or file.with_name(f"{file.stem}_recovered{file.suffix}"))
    for damage in done.damages:
        print(f"{file}: byte {damage.offset}: {damage.text}")
    if not done.messages:
        done.path.unlink()
        print(f"{file}: nothing could be recovered")
        return 1
    print(f"{done.path}: {done.messages} messages")
    return 0


def play(
    file: Path,
    *,
    rate: float = 1.0,
    start: float = 0.0,
    loop: bool = False,
    topics: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    remap: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    beside_robot: bool = False,
    at: Which = HERE,
) -> int:
    """Send a recording again, the last map first.

    Example: gigabrain bag play drive.mcap --rate 2 --start 30 --remap robot/scan=old/scan

    Parameters
    ----------
    file
        The recording.
    rate
        Times the recorded pace.
    start
        Where to begin, from its first message [s].
    loop
        Again and again, until Ctrl-C.
    topics
        Names, such as scan, or key expressions, such as "robot/image/*"; all without.
    remap
        Send a key on another: robot/scan=old/scan.
    beside_robot
        Even where a driver runs. Its gate refuses recorded commands; its brain is confused.
    """
    from gigabrain_zenoh.recording.player import PlayOptions
    from gigabrain_zenoh.recording.player import play as run

    if not 0.01 <= rate <= 100:
        raise ConfigError(f"--rate: expected a number from 0.01 to 100, got {rate:g}")
    if not 0 <= start < math.inf:
        raise ConfigError(f"--start: expected seconds from 0 on, got {start:g}")
    options = PlayOptions(
        rate=rate, start_s=start, loop=loop, topics=tuple(topics or ()), remap=_pairs(remap or [])
    )
    return run_async(run(file, options, at.where(), beside_robot=beside_robot))


def _pairs(texts: list[str]) -> dict[str, str]:
    pairs = dict(text.split("=", 1) for text in texts if text.count("=") == 1)
    for text in texts:
        old, _, new = text.partition("=")
        if pairs.get(old) != new or not old or not new:
            raise ConfigError(f"--remap: expected old/key=new/key, got {text!r}")
    return pairs


def plot(
    file: Path,
    fields: Annotated[list[str], Parameter(negative="")],
    *,
    output: Annotated[Path | None, Parameter(alias="-o")] = None,
) -> int:
    """Draw numbers of a recording over time, as a PNG.

    Example: gigabrain bag plot drive.mcap state.velocity.linear_x cmd_vel.linear_x

    Parameters
    ----------
    file
        The recording.
    fields
        Topic and field: cmd_vel.linear_x, state.joints.0.position, robot/state.pose.x.
    output
        The file to write; without it, beside the recording.
    """
    from gigabrain_zenoh.recording.message_tables import plot as draw

    print(draw(file, fields, output or file.with_suffix(".png")))
    return 0


def convert(file: Path, *, csv: Path | None = None, lerobot: Path | None = None) -> int:
    """Write a recording as tables, one per topic, or as a LeRobot dataset.

    Example: gigabrain bag convert drive.mcap --csv tables

    Parameters
    ----------
    file
        The recording.
    csv
        The folder for the tables.
    lerobot
        A new folder for the dataset.
    """
    from gigabrain_zenoh.recording.lerobot import convert as write_lerobot
    from gigabrain_zenoh.recording.message_tables import write_csv

    if csv is None and lerobot is None:
        raise ConfigError("say into what: --csv FOLDER or --lerobot FOLDER")
    for path in write_csv(file, csv) if csv else ():
        print(path)
    if lerobot:
        print(write_lerobot(file, lerobot))
    return 0
