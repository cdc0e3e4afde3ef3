"""For how long this machine kept the kit from running: what comes late then says nothing."""

from pathlib import Path

TASKS = Path("/proc/self/task")
OWN = Path("/proc/thread-self/schedstat")


def waited_ms() -> float:
    """How long the threads of this process have waited for a core in all [ms].

    A thread waits while it could run and others do; it does not wait while it sleeps, so a driver
    that sleeps or blocks does not look like a busy machine. 0 where the system does not say.
    """
    return sum(map(_waited_ns, TASKS.glob("*/schedstat"))) / 1e6


def own_waited_ms() -> float:
    """How long the calling thread has waited for a core [ms], as in `waited_ms`."""
    return _waited_ns(OWN) / 1e6


def _waited_ns(schedstat: Path) -> int:
    """The second number of one thread's (kernel, Documentation/scheduler/sched-stats.rst)."""
    try:
        return int(schedstat.read_text().split()[1])
    except OSError:  # it has just ended, or there is no such file here
        return 0
