"""Time that threads spent waiting for a core, from Linux's per-thread scheduler statistics.

A thread waits while it is runnable and others hold the cores. Sleeping, blocking and computing do
not count, so this distinguishes a busy machine from a slow program. 0 on systems without these
statistics.
"""

import os
from pathlib import Path

PROC = Path("/proc")
OWN = PROC / "thread-self/schedstat"
STOLEN = 8  # field of a core's line in /proc/stat (proc_stat(5))


def waited_ms() -> float:
    """Return how long the threads of this process have waited in total [ms]."""
    return sum(by_thread("self").values()) / 1e6


def own_waited_ms() -> float:
    """Return how long the calling thread has waited in total [ms]."""
    return _waited_ns(OWN) / 1e6


def by_thread(process: int | str) -> dict[str, int]:
    """Return how long each thread of `process` has waited in total [ns], by thread id."""
    files = (PROC / str(process) / "task").glob("*/schedstat")
    return {file.parent.name: _waited_ns(file) for file in files}


def stolen() -> dict[str, int]:
    """Return how long the host of a virtual machine has withheld each core in total [ns], by core.

    The kernel usually counts in ticks of 10 ms.
    """
    try:
        lines = (PROC / "stat").read_text().splitlines()
    except OSError:
        return {}
    tick_ns = 1_000_000_000 // os.sysconf("SC_CLK_TCK")
    cores = (line.split() for line in lines if line.startswith("cpu") and line[3].isdigit())
    return {core[0]: int(core[STOLEN]) * tick_ns for core in cores if len(core) > STOLEN}


def _waited_ns(schedstat: Path) -> int:
    """Return a schedstat file's second number (kernel, Documentation/scheduler/sched-stats.rst)."""
    try:
        return int(schedstat.read_text().split()[1])
    except OSError:  # the thread has just ended, or the system has no statistics
        return 0
