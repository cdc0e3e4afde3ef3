"""The computer that safety runs on: disk, processors and memory."""

import shutil
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

import msgspec
import psutil

from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import Thresholds
from gigabrain_zenoh.safety.words import say

PERIOD_NS = 1_000_000_000
CODES = ("disk_low", "cpu_busy", "memory_low")  # of the warnings below
LOOKS = 10  # the processors' share is taken over so many, ten seconds


class Host(msgspec.Struct, frozen=True, kw_only=True):
    """What the computer has left; None where it does not say."""

    disk_mb: float | None = None  # [MB]
    cpu: float | None = None  # [%] of all cores that is in use
    memory: float | None = None  # [%] that is in use


def warnings(limits: Thresholds, host: Host) -> tuple[Cause, ...]:
    """What will hurt if nobody acts; none of it stops the body."""
    found = []
    if host.disk_mb is not None and host.disk_mb < limits.disk_warn:
        found.append(say("disk_low", f"{host.disk_mb:.0f} MB left on the disk"))
    if host.cpu is not None and host.cpu > limits.cpu_warn:
        found.append(say("cpu_busy"))
    if host.memory is not None and host.memory > limits.memory_warn:
        found.append(say("memory_low"))
    return tuple(found)


Look = Callable[[int], Host]  # what the computer has left at a time of the monotonic clock [ns]


class HostWatch:
    """Looks at the computer once a second at most; about 0.2 ms each time.

    `folder` is on the disk that counts: with logs, maps and the latch. A disk may hang,
    so it is asked in a thread; what it said last holds until it answers.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._disk_mb: float | None = None
        self._asking: threading.Thread | None = None
        self._next_ns = 0
        self._busy: deque[float] = deque(maxlen=LOOKS)  # [%] of all cores, since the look before
        psutil.cpu_percent()  # from now on
        self._host = Host()

    def now(self, now_ns: int) -> Host:
        """What it has left at this time of the monotonic clock."""
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + PERIOD_NS
            if self._asking is None or not self._asking.is_alive():
                self._asking = threading.Thread(target=self._ask, name="disk", daemon=True)
                self._asking.start()
            self._busy.append(psutil.cpu_percent())
            cpu = sum(self._busy) / LOOKS if len(self._busy) == LOOKS else None
            memory = psutil.virtual_memory().percent
            self._host = Host(disk_mb=self._disk_mb, cpu=cpu, memory=memory)
        return self._host

    def _ask(self) -> None:
        self._disk_mb = _disk_mb(self._folder)


def _disk_mb(folder: Path) -> float | None:
    """Free space where the folder is, or will be once something is written."""
    for place in (folder, *folder.parents):
        try:
            return shutil.disk_usage(place).free / 1e6
        except FileNotFoundError:
            continue
        except OSError:
            return None
    return None
