"""Scheduling priorities of processes: ahead of other programs, or after them."""

import contextlib
import os
from pathlib import Path

FIRST = -10  # nice value, see nice(1): nine times the weight of a program at nice 0
AUTOGROUP = Path("/proc/self/autogroup")


def go_first() -> None:
    """Raise the priority of this process permanently, as root or with a sufficient RLIMIT_NICE.

    Linux first shares the CPU among sessions; niceness counts only within one ("The autogroup
    feature", sched(7)). The session's priority is therefore set too. The supervisor gives each
    process its own session.
    """
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, FIRST)
    _session(FIRST)


def start_first() -> None:
    """Raise the priority of this process's session until `join_in`, where permitted.

    The robot is at rest until a crashed part of its brain has restarted, so start-up comes first.
    """
    _session(FIRST)


def join_in() -> None:
    """Return this process's session to normal priority."""
    _session(0)


def _session(nice: int) -> None:
    if os.getsid(0) == os.getpid():
        with contextlib.suppress(OSError):  # no permission, or no autogroups here
            AUTOGROUP.write_text(str(nice))


def step_aside() -> None:
    """Make this thread, and threads it starts, wait rather than preempt others on waking.

    Linux's SCHED_BATCH needs no permission and does not reduce the process's share of the CPU. A
    thread that wakes up does not interrupt a running one (sched(7)).
    """
    if hasattr(os, "SCHED_BATCH"):
        with contextlib.suppress(OSError):  # a container may forbid it
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
