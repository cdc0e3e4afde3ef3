"""`gigabrain replay`: a recording through one process again."""

from pathlib import Path
from typing import Literal

from gigabrain_zenoh.host.signals import run_async


def replay(
    *,
    check: Path,
    process: Literal["perception", "decision", "control", "safety"],
    deployment: str | None = None,
) -> int:
    """Feed what was recorded to a process in fake time, and compare what it sends with the record.

    Example: gigabrain replay --check drive.mcap --process decision

    Ends with 1 where the process does something else than it did then; the first difference is
    shown with its message.

    Parameters
    ----------
    check
        The recording, made from the start of the run.
    process
        Which process.
    deployment
        A deployment file for its settings; without it, those that the recording holds.
    """
    from gigabrain_zenoh.launch.processes import node_of
    from gigabrain_zenoh.recording.process_replay import replay_file

    return run_async(replay_file(check, process, deployment, node_of))
