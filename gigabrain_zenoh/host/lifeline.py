"""A process dies with the supervisor that started it, even when that is killed with -9.

The child calls `die_with_supervisor()` first thing. This imports nothing heavy, for it runs before
everything else. Direct children only: a wrapper in between would hold the lifeline itself.
"""

import os
import signal
import sys
import threading
import time

VARIABLE = "GIGABRAIN_SUPERVISOR"  # the supervisor puts its pid there
_PR_SET_PDEATHSIG = 1  # prctl(2)


def die_with_supervisor() -> None:
    """Die with the supervisor whose pid is in the environment; nothing if this has none.

    The variable is taken out, so that what this process starts is not bound to its grandparent.
    """
    pid = os.environ.pop(VARIABLE, "")
    if pid.isdecimal():
        die_with_parent(int(pid))


def die_with_parent(parent_pid: int) -> None:
    """Have this process killed when its parent ends, also while it is stopped (Linux).

    On Linux the kernel does it when the parent's thread that started this process ends; elsewhere
    a daemon thread watches. If the parent is gone already, this process ends here.
    """
    if sys.platform != "linux" or not _kill_on_parent_death():
        watch_parent(parent_pid)
    if os.getppid() != parent_pid:  # it died before we asked
        _die()


def watch_parent(parent_pid: int, period_s: float = 0.2) -> threading.Thread:
    """Watch from a daemon thread whether the parent is still the parent."""

    def watch() -> None:
        while os.getppid() == parent_pid:
            time.sleep(period_s)
        _die()

    thread = threading.Thread(target=watch, name="lifeline", daemon=True)
    thread.start()
    return thread


def _kill_on_parent_death() -> bool:
    import ctypes  # costs 3 ms, which only a supervised process pays

    libc = ctypes.CDLL(None)
    zero = ctypes.c_ulong(0)
    return bool(
        libc.prctl(_PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGKILL), zero, zero, zero) == 0
    )


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)
