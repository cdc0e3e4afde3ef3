"""How long threads waited for a core while they could run, by Linux's account of each.

A thread waits while others hold the cores; it does not wait while it sleeps, blocks or computes. So
this tells a busy machine from a slow program. 0 on systems that keep no account.
"""

import os
from pathlib import Path

PROC = Path("/proc")
OWN = PROC / "thread-self/schedstat"
STOLEN = 8  # field of a core's line in /proc/stat (proc_stat(5))


def waited_ms() -> float:
    """Return how long the threads of this process have waited in all [ms]."""
    return sum(by_thread("self").values()) / 1e6


def own_waited_ms() -> float:
    """Return how long the calling thread has waited in all [ms]."""
    return _waited_ns(OWN) / 1e6


def by_thread(process: int | str) -> dict[str, int]:
    """Return how long each thread of `process` has waited in all [ns], by thread id."""
    files = (PROC / str(process) / "task").glob("*/schedstat")
    return {file.parent.name: _waited_ns(file) for file in files}


def stolen() -> dict[str, int]:
    """Return how long a virtual machine's host has kept each core from it in all [ns], by core.

    The kernel counts in ticks of 10 ms, as a rule.
    """
    try:
        lines = (PROC / "stat").read_text().splitlines()
    except OSError:
        return {}
    tick_ns = 1_000_000_000 // os.sysconf("SC_CLK_TCK")
    cores = (line.split() for line in lines if line.startswith("cpu") and line[3].isdigit())
    return {core[0]: int(core[STOLEN]) * tick_ns for core in cores if len(core) > STOLEN}


def _waited_ns(schedstat: Path) -> int:
    """Return a file's second number (kernel, Documentation/scheduler/sched-stats.rst)."""
    try:
        return int(schedstat.read_text().split()[1])
    except OSError:  # the thread has just ended, or the system keeps no account
        return 0
