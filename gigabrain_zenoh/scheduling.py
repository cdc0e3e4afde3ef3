"""What a process asks of the kernel's scheduler: to go before others, or after them."""

import contextlib
import os
from pathlib import Path

FIRST = -10  # as nice(1) counts: nine times the weight of a program that asks for nothing
AUTOGROUP = Path("/proc/self/autogroup")


def go_first() -> None:
    """Have this process run before others, on a busy machine as well, where it may: as root, or
    with a RLIMIT_NICE that allows it.

    Linux shares the time out among sessions first, and niceness counts only within one ("The
    autogroup feature", sched(7)). So it is said of the session, too; it is the supervisor that
    gives each process one of its own.
    """
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, FIRST)
    _session(FIRST)


def start_first() -> None:
    """Have this process go before others until `join_in`, where it may.

    A robot stands still until the part of its brain that has died is back.
    """
    _session(FIRST)


def join_in() -> None:
    """Take the same share as others from now on."""
    _session(0)


def _session(nice: int) -> None:
    if os.getsid(0) == os.getpid():
        with contextlib.suppress(OSError):  # no rights, a kernel without, or another system
            AUTOGROUP.write_text(str(nice))


def step_aside() -> None:
    """Have this thread, and those that it starts, wait where they would push others aside.

    Linux's SCHED_BATCH needs no rights and takes nothing of a process's share: what wakes up does
    not interrupt what runs (sched(7)).
    """
    if hasattr(os, "SCHED_BATCH"):
        with contextlib.suppress(OSError):  # a container may forbid it
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
