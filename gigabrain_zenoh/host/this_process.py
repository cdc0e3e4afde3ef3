"""This process in its operating system: its parent, priority, heap and waits for a core.

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
MAX_USER_CHARS = 48  # of the 64 that a request has for its source
_PR_SET_PDEATHSIG = 1  # prctl(2)


def set_up() -> None:
    """Set up a supervised process, before it imports anything heavy."""
    die_with_supervisor()
    map_large_blocks()
    multiply_in_one_thread()


def user_name() -> str:
    """Return the name of the user, as a text for requests; a number where they have no name.

    A container may run as any number.
    """
    try:
        name = getpass.getuser()
    except (KeyError, OSError):
        name = f"user-{os.getuid()}"
    return name.encode(errors="replace").decode()[:MAX_USER_CHARS]


def die_with_supervisor() -> None:
    """Die with the supervisor whose pid is in the environment; nothing if this has none.

    The variable is taken out, so that what this process starts is not bound to its grandparent.
    """
    pid = os.environ.pop(SUPERVISOR_VARIABLE, "")
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


def show_stack_on_request() -> None:
    """Have STACK_SIGNAL print where the main thread is, also while it hangs in Python code."""
    if STACK_SIGNAL:
        faulthandler.register(STACK_SIGNAL, all_threads=False)


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


FIRST_NICE = -10  # nice value, see nice(1): nine times the weight of a program at nice 0
AUTOGROUP = Path("/proc/self/autogroup")


def go_first() -> None:
    """Raise the priority of this process permanently, as root or with a sufficient RLIMIT_NICE.

    Linux first shares the CPU among sessions; niceness counts only within one ("The autogroup
    feature", sched(7)). The session's priority is therefore set too. The supervisor gives each
    process its own session.
    """
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, FIRST_NICE)
    _session(FIRST_NICE)


def start_first() -> None:
    """Raise the priority of this process's session until `join_in`, where permitted.

    The robot is at rest until a crashed part of its brain has restarted, so start-up comes first.
    """
    _session(FIRST_NICE)


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


PROC = Path("/proc")
OWN_SCHEDSTAT = PROC / "thread-self/schedstat"
STOLEN_FIELD = 8  # field of a core's line in /proc/stat (proc_stat(5))


def waited_ms() -> float:
    """Return how long the threads of this process have waited in total [ms]."""
    return sum(waited_ns_by_thread("self").values()) / 1e6


def own_waited_ms() -> float:
    """Return how long the calling thread has waited in total [ms]."""
    return _waited_ns(OWN_SCHEDSTAT) / 1e6


def waited_ns_by_thread(process: int | str) -> dict[str, int]:
    """Return how long each thread of `process` has waited in total [ns], by thread id."""
    files = (PROC / str(process) / "task").glob("*/schedstat")
    return {file.parent.name: _waited_ns(file) for file in files}


def stolen_ns_by_core() -> dict[str, int]:
    """Return how long the host of a virtual machine has withheld each core in total [ns], by core.

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
    except OSError:  # the thread has just ended, or the system has no statistics
        return 0


def multiply_in_one_thread() -> None:
    """Have numpy multiply matrices in the calling thread; before it is imported.

    By default OpenBLAS shares each product with a thread for every other core, and all of them spin
    for a while afterwards. Our matrices are too small for that: in a loop over pictures, contours
    took 1.6 times the CPU time. OPENBLAS_NUM_THREADS in the environment is respected.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


GRAPHICS, CHOSEN = "MUJOCO_GL", "GIGABRAIN_MUJOCO_GL"
NO_WINDOW = "disable"


def open_no_window() -> None:
    """Have MuJoCo import nothing for windows, which takes 0.2 s and 6 MB; before it is imported.

    MUJOCO_GL in the environment is respected, unless MuJoCo could not be imported with it. What
    draws pictures chooses its own graphics: see `chosen_graphics`.
    """
    chosen = os.environ.get(GRAPHICS, "")
    if chosen != NO_WINDOW and not _can_draw(chosen.lower().strip()):
        os.environ[CHOSEN] = chosen
        os.environ[GRAPHICS] = NO_WINDOW


def _can_draw(graphics: str) -> bool:
    from ctypes.util import find_library  # which starts a program, for those that chose graphics
    from importlib.util import find_spec

    if graphics == "glfw":
        return find_spec("glfw") is not None
    library = {"egl": "EGL", "osmesa": "OSMesa"}.get(graphics)
    return graphics in ("cgl", "wgl") or bool(library and find_library(library))


def chosen_graphics() -> str:
    """Return what MUJOCO_GL was before `open_no_window`; empty if nothing was chosen."""
    return os.environ.get(CHOSEN, os.environ.get(GRAPHICS, ""))


def environment_for_others() -> dict[str, str]:
    """Return the environment for programs of others, which may open windows."""
    found = {name: value for name, value in os.environ.items() if name not in (GRAPHICS, CHOSEN)}
    return found | ({GRAPHICS: chosen_graphics()} if chosen_graphics() else {})


M_MMAP_THRESHOLD, M_TRIM_THRESHOLD = -3, -1  # mallopt(3)
LARGE_BYTES = 4 << 20  # the costs of a map of 50 x 50 m, and less, stay in the heap


def map_large_blocks() -> None:
    """Have blocks of LARGE_BYTES and more go back to the system as soon as they are free.

    By itself glibc raises that limit to 32 MiB as blocks are freed, and then keeps those of each
    thread: 119 MB after planning in a few maps of 140 x 140 m, and 1 MB with this.

    Once that limit is set, glibc keeps only 128 KiB free at the end of a heap. The camera process
    then asked for 300 pages again with each picture, so LARGE_BYTES are kept free there as well.
    """
    with contextlib.suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, LARGE_BYTES)
        mallopt(M_TRIM_THRESHOLD, LARGE_BYTES)


def trim_heap() -> None:
    """Return what is free to the system. It may take some milliseconds."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


MAPS = Path("/proc/self/maps")


def unmap_code() -> None:
    """Unmap the pages of code that were used so far (Linux); those in use are mapped again.

    Importing gtsam runs 21 MB of its code, and working with it hardly any. The kernel keeps these
    pages as any others of files, and frees them where memory is short.
    """
    if not MAPS.exists():
        return
    madvise = ctypes.CDLL(None).madvise
    for line in MAPS.read_text().splitlines():
        addresses, permissions, _, _, inode, *_ = line.split(maxsplit=5)
        if permissions == "r-xp" and inode != "0":  # of a file, and never written to
            start, end = (int(address, 16) for address in addresses.split("-"))
            madvise(ctypes.c_void_p(start), ctypes.c_size_t(end - start), mmap.MADV_DONTNEED)
