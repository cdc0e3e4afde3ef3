"""`gigabrain record`: what a robot says, into a file."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from gigabrain_zenoh.cli.checked import above_zero, checked
from gigabrain_zenoh.cli.where import HERE, Which
from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.host.signals import run_async


def record(
    *,
    output: Annotated[Path | None, Parameter(alias="-o")] = None,
    topics: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    at: Which = HERE,
    seconds: float | None = None,
    split_size: float | None = None,
    split_time: float | None = None,
    raw_only: bool = False,
    keep_free: float = 200.0,
) -> int:
    """Record what a robot says into an MCAP file, until Ctrl-C.

    Example: gigabrain record -o drive.mcap --topics scan state cmd_vel

    Ends with 1 where messages were lost on the way to the disk.

    Parameters
    ----------
    output
        The file; without it, one named by the time, in this folder.
    topics
        Names, such as scan, or key expressions, such as "robot/image/*"; all without.
    seconds
        End after this long [s].
    split_size
        Begin a new file after so much [MB].
    split_time
        Begin a new file after so long [s].
    raw_only
        Leave out what Foxglove, Lichtblick and Rerun draw: half the size.
    keep_free
        Stop writing while less than this is free on the disk [MB].
    """
    from gigabrain_zenoh.recording.node import file_name
    from gigabrain_zenoh.recording.node import record as run

    limits = {"seconds": seconds, "split-size": split_size, "split-time": split_time}
    for name, value in limits.items():
        above_zero(name, value)
    values = {
        "file": str(output or file_name()),
        "topics": topics or (),
        "viewers": not raw_only,
        "split_mb": split_size,
        "split_s": split_time,
        "keep_free_mb": keep_free,
    }
    return run_async(run(checked(values, RecorderConfig), at.where(), seconds))
