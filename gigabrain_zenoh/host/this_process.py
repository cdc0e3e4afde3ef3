"""Settings and statistics of this process: parent, priority, heap, and waits for a core.

A supervised process calls `set_up` first, so this module imports nothing heavy.
"""

import contextlib
import ctypes
import faulthandler
import getpass
import mmap
import os
import signal
import sys
import threading
import time
from pathlib import Path

SUPERVISOR_VARIABLE = "GIGABRAIN_SUPERVISOR"  # the supervisor puts its pid there
STACK_SIGNAL = getattr(signal, "SIGUSR2", None)  # Windows has none
MAX_USER_CHARS = 48  # of the 64 of a request's source
_PR_SET_PDEATHSIG = 1  # prctl(2)


def set_up() -> None:
    """Set up a supervised process, before it imports anything heavy."""
    die_with_supervisor()
    map_large_blocks()
    multiply_in_one_thread()


def user_name() -> str:
    """Return the user's name for requests, or `user-<uid>` for a user without a name."""
    try:
        name = getpass.getuser()
    except (KeyError, OSError):
        name = f"user-{os.getuid()}"
    return name.encode(errors="replace").decode()[:MAX_USER_CHARS]


def die_with_supervisor() -> None:
    """Die with the supervisor whose pid is in the environment; do nothing without one.

    Removes the variable, so that children of this process do not inherit it.
    """
    pid = os.environ.pop(SUPERVISOR_VARIABLE, "")
    if pid.isdecimal():
        die_with_parent(int(pid))


def die_with_parent(parent_pid: int) -> None:
    """Kill this process when its parent ends, also while it is stopped (Linux).

    On Linux the kernel does so when the parent's thread that started this process ends. On other
    systems a daemon thread watches the parent. If the parent is gone already, this process ends.
    """
    if sys.platform != "linux" or not _kill_on_parent_death():
        watch_parent(parent_pid)
    if os.getppid() != parent_pid:  # it died before this call
        _die()


def watch_parent(parent_pid: int, period_s: float = 0.2) -> threading.Thread:
    """Kill this process, from a daemon thread, once its parent is gone; return the thread."""

    def watch() -> None:
        while os.getppid() == parent_pid:
            time.sleep(period_s)
        _die()

    thread = threading.Thread(target=watch, name="lifeline", daemon=True)
    thread.start()
    return thread


def _kill_on_parent_death() -> bool:
    libc = ctypes.CDLL(None)
    zero = ctypes.c_ulong(0)
    return bool(
        libc.prctl(_PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGKILL), zero, zero, zero) == 0
    )


def show_stack_on_request() -> None:
    """Print the main thread's stack on STACK_SIGNAL, also while it hangs in Python code."""
    if STACK_SIGNAL:
        faulthandler.register(STACK_SIGNAL, all_threads=False)


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


HIGH_PRIORITY_NICE = -10  # nine times the weight of a program at nice 0, see sched(7)
AUTOGROUP = Path("/proc/self/autogroup")


def go_first() -> None:
    """Raise the priority of this process permanently, as root or with a sufficient RLIMIT_NICE.

    Linux first shares the CPU among sessions; niceness counts only within one ("The autogroup
    feature", sched(7)). So this also sets the session's priority. The supervisor gives each process
    its own session.
    """
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, HIGH_PRIORITY_NICE)
    _set_session_nice(HIGH_PRIORITY_NICE)


def start_first() -> None:
    """Raise the priority of this process's session until `join_in`, where permitted.

    The robot stands still until a crashed part of its brain has restarted, so start-up is urgent.
    """
    _set_session_nice(HIGH_PRIORITY_NICE)


def join_in() -> None:
    """Return this process's session to normal priority."""
    _set_session_nice(0)


def _set_session_nice(nice: int) -> None:
    if os.getsid(0) == os.getpid():
        with contextlib.suppress(OSError):  # no permission, or no autogroups here
            AUTOGROUP.write_text(str(nice))


def step_aside() -> None:
    """Keep this thread, and threads that it starts, from preempting others when they wake.

    Linux's SCHED_BATCH needs no permission and does not reduce the process's share of the CPU
    (sched(7)).
    """
    if hasattr(os, "SCHED_BATCH"):
        with contextlib.suppress(OSError):  # a container may forbid it
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


PROC = Path("/proc")
OWN_SCHEDSTAT = PROC / "thread-self/schedstat"
STOLEN_FIELD = 8  # field of a core's line in /proc/stat (proc_stat(5))


def waited_ms() -> float:
    """Return the total time that the threads of this process waited for a core [ms]."""
    return sum(waited_ns_by_thread("self").values()) / 1e6


def own_waited_ms() -> float:
    """Return the total time that the calling thread waited for a core [ms]."""
    return _waited_ns(OWN_SCHEDSTAT) / 1e6


def waited_ns_by_thread(process: int | str) -> dict[str, int]:
    """Return the total time that each thread of `process` waited for a core [ns], by thread id."""
    files = (PROC / str(process) / "task").glob("*/schedstat")
    return {file.parent.name: _waited_ns(file) for file in files}


def stolen_ns_by_core() -> dict[str, int]:
    """Return the total time that a virtual machine's host withheld each core [ns], by core.

    The kernel usually counts in ticks of 10 ms.
    """
    try:
        lines = (PROC / "stat").read_text().splitlines()
    except OSError:
        return {}
    tick_ns = 1_000_000_000 // os.sysconf("SC_CLK_TCK")
    cores = (line.split() for line in lines if line.startswith("cpu") and line[3].isdigit())
    return {
        core[0]: int(core[STOLEN_FIELD]) * tick_ns for core in cores if len(core) > STOLEN_FIELD
    }


def _waited_ns(schedstat: Path) -> int:
    """Return a schedstat file's second number (kernel, Documentation/scheduler/sched-stats.rst)."""
    try:
        return int(schedstat.read_text().split()[1])
    except OSError:  # the thread ended, or the system has no statistics
        return 0


def multiply_in_one_thread() -> None:
    """Make numpy multiply matrices in the calling thread only. Call this before its import.

    By default OpenBLAS uses one thread per core for each product, and these spin for a while
    afterwards. Our matrices are too small for that: in a loop over pictures, contours took 1.6
    times the CPU time. OPENBLAS_NUM_THREADS in the environment is respected.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


GRAPHICS_VARIABLE, CHOSEN_VARIABLE = "MUJOCO_GL", "GIGABRAIN_MUJOCO_GL"
NO_GRAPHICS = "disable"  # value of MUJOCO_GL


def open_no_window() -> None:
    """Keep MuJoCo from importing window libraries (0.2 s, 6 MB). Call this before its import.

    MUJOCO_GL in the environment is respected, unless MuJoCo could not be imported with it. Code
    that draws pictures chooses its own graphics: see `chosen_graphics`.
    """
    chosen = os.environ.get(GRAPHICS_VARIABLE, "")
    if chosen != NO_GRAPHICS and not _can_draw(chosen.lower().strip()):
        os.environ[CHOSEN_VARIABLE] = chosen
        os.environ[GRAPHICS_VARIABLE] = NO_GRAPHICS


def _can_draw(graphics: str) -> bool:
    from ctypes.util import find_library  # calling it starts a program
    from importlib.util import find_spec

    if graphics == "glfw":
        return find_spec("glfw") is not None
    library = {"egl": "EGL", "osmesa": "OSMesa"}.get(graphics)
    return graphics in ("cgl", "wgl") or bool(library and find_library(library))


def chosen_graphics() -> str:
    """Return the value of MUJOCO_GL before `open_no_window`; empty if it was not set."""
    return os.environ.get(CHOSEN_VARIABLE, os.environ.get(GRAPHICS_VARIABLE, ""))


def environment_for_others() -> dict[str, str]:
    """Return the environment for other programs, which may open windows."""
    ours = (GRAPHICS_VARIABLE, CHOSEN_VARIABLE)
    others = {name: value for name, value in os.environ.items() if name not in ours}
    return others | ({GRAPHICS_VARIABLE: chosen_graphics()} if chosen_graphics() else {})


M_MMAP_THRESHOLD, M_TRIM_THRESHOLD = -3, -1  # mallopt(3)
LARGE_BYTES = 4 << 20  # costmaps up to 50 x 50 m stay in the heap


def map_large_blocks() -> None:
    """Return freed blocks of LARGE_BYTES or more to the system at once (glibc).

    By default glibc raises that limit to 32 MiB as blocks are freed, and keeps smaller blocks for
    each thread: 119 MB after planning in a few maps of 140 x 140 m, compared with 1 MB.

    Once that limit is set, glibc keeps only 128 KiB free at the end of a heap. The camera process
    then requested 300 pages for each picture, so LARGE_BYTES are kept free there as well.
    """
    with contextlib.suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, LARGE_BYTES)
        mallopt(M_TRIM_THRESHOLD, LARGE_BYTES)


def trim_heap() -> None:
    """Return free heap memory to the system (glibc). It may take some milliseconds."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


MAPS = Path("/proc/self/maps")


def unmap_code() -> None:
    """Unmap all pages of code (Linux); the kernel maps a page again when it is used.

    Importing gtsam runs 21 MB of its code, but using it runs hardly any. The pages stay in the
    kernel's page cache, which it frees when memory is short.
    """
    if not MAPS.exists():
        return
    madvise = ctypes.CDLL(None).madvise
    for line in MAPS.read_text().splitlines():
        addresses, permissions, _, _, inode, *_ = line.split(maxsplit=5)
        if permissions == "r-xp" and inode != "0":  # read-only code from a file
            start, end = (int(address, 16) for address in addresses.split("-"))
            madvise(ctypes.c_void_p(start), ctypes.c_size_t(end - start), mmap.MADV_DONTNEED)
