"""Workarounds for costs and faults of Zenoh 1.10, each with its reason."""

import contextlib
import ctypes
import os
import socket
import stat
import struct
import threading
import time
from collections.abc import Callable
from typing import TypeVar

_OFF = struct.pack("ii", 0, 0)
OWN_FILES = "/dev/fd"  # what this process has open, on Linux and on macOS


# Zenoh's sockets linger for 10 s: closing one to a lost peer stopped a router for 2.8 of 3 s
def disable_linger() -> int:
    """Let the kernel send what this process's TCP sockets hold when closed; return how many."""
    names = os.listdir(OWN_FILES) if os.path.isdir(OWN_FILES) else ()
    return sum(_changed(int(name)) for name in names)


def _changed(fd: int) -> bool:
    with contextlib.suppress(OSError):  # closed meanwhile
        if not stat.S_ISSOCK(os.fstat(fd).st_mode):
            return False
        with socket.socket(fileno=os.dup(fd)) as same:
            lingers, _ = struct.unpack(
                "ii", same.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8)
            )
            if same.family in (socket.AF_INET, socket.AF_INET6) and lingers:
                same.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _OFF)
                return True
    return False


_here = threading.local()


# a new thread state per callback costs 21 µs: 75 µs a message without this, 54 µs with it
def keep_thread_state() -> None:
    """Keep the thread state of the calling thread until the thread ends. Call it within a callback.

    PyGILState_Ensure counts its calls. The extra call here is never released, so the count returns
    to one and never to zero when the callback ends.
    """
    if not getattr(_here, "stays", False):
        _here.stays = True
        ctypes.pythonapi.PyGILState_Ensure()


CALLBACK_THREAD = "pyo3-closure"  # in the name of a thread that Zenoh starts for a callback
CLOSING_THREAD = "zenoh-close"  # name of a thread of ours that closes a session
CALLBACK_ENDS_S = 0.5  # after its session is closed
CLOSING_ENDS_S = 10.0  # on a link that loses packets


# a thread that comes back to Python from Zenoh during the interpreter's end aborts the process
# ("FATAL: exception not rethrown")
def await_zenoh_threads() -> None:
    """Wait until no thread of this process closes a session or runs a callback."""
    for name, longest_s in ((CLOSING_THREAD, CLOSING_ENDS_S), (CALLBACK_THREAD, CALLBACK_ENDS_S)):
        end_s = time.monotonic() + longest_s
        for thread in threading.enumerate():
            if name in thread.name:
                thread.join(max(0.0, end_s - time.monotonic()))


T = TypeVar("T")
NAP_S = 0.04
LONGEST_S = 0.06  # upper bound of the delay of a message that arrives during a nap
IDLE_S = 0.0003  # since the last message; after that the receiving thread counts as idle


# measured with a nap of 40 ms: recorder 3.7 to 2.2 % of a core, wake-ups 150 to 42 a second
class ReceiveThrottle:
    """Sleeps in the receiving thread, while the kernel's buffer collects messages.

    The thread sleeps only after a message that found it idle. Collected messages are thus processed
    in one batch, and during a flood the thread never sleeps.
    """

    def __init__(
        self,
        nap_s: float,
        now_s: Callable[[], float] = time.monotonic,
        sleep_s: Callable[[float], None] = time.sleep,
    ) -> None:
        self._nap_s, self._now_s, self._sleep_s = nap_s, now_s, sleep_s
        self._done_s = now_s()

    def after_each(self, take: Callable[[T], None]) -> Callable[[T], None]:
        """Wrap `take` for the receiving thread: nap after a call that found the thread idle."""

        def take_and_nap(sample: T) -> None:
            idle_s = self._now_s() - self._done_s
            take(sample)
            if idle_s > IDLE_S:
                self._sleep_s(self._nap_s)
            self._done_s = self._now_s()

        return take_and_nap
