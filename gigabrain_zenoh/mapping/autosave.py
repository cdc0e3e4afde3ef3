"""Saves the growing map every few seconds, so that it outlives its process.

Two files take turns, so that a damaged one leaves the one before it. They are good for the same
start of the driver only: after another start the robot may have been moved.
"""

import logging
import math
import shutil
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from msgspec import Struct

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Cause, Count, Finite
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import make_folder, replacing
from gigabrain_zenoh.mapping import map_file
from gigabrain_zenoh.mapping.map_file import Arrays

if TYPE_CHECKING:
    from gigabrain_zenoh.mapping.slam_map import MapSnapshot  # and gtsam: only who makes maps pays

log = logging.getLogger(__name__)

PERIOD_TICKS = 200  # from one save to the next, at least
BYTES_A_TICK = 100_000  # 5 MB/s: a map of more than 20 MB is saved less often
KEEP_FREE_BYTES = 200_000_000  # of the disk, for others
STALLED_TICKS = 1500  # of a write, then it is reported
MOVED_M, MOVED_RAD = 0.3, 0.3  # a robot that moved less in a map that is as it was saves nothing
HEAD = "head"

Triple = tuple[Finite, Finite, Finite]


class SaveHead(Struct, frozen=True, kw_only=True):
    """Time and place of a save."""

    boot: Count  # which start of the driver
    tick: Count
    odometry: Triple  # x, y [m] and yaw [rad] of the robot
    place: Triple | None  # the same in the map, as far as odometry knows it
    lost: bool = False  # it was looked for
    changes: tuple[int, int, int]  # see MapSnapshot


class Autosave:
    """Saves in a thread of its own. All else is called from one thread."""

    def __init__(self, folder: Path) -> None:
        self._slots = [folder / f"map_{number}.npz" for number in (0, 1)]  # the next one first
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="autosave")
        self._job: Future[int] | None = None
        self._doing: SaveHead | None = None  # of the last attempt
        self._done: SaveHead | None = None  # of what was saved last
        self._began_tick = self._next_tick = 0
        self.problem: Cause | None = None
        self.saves = 0
        self.bytes = 0  # of the last one

    def found(self, boot: int) -> Iterator[tuple[SaveHead, Arrays]]:
        """Yield the maps saved in one start of the driver, the newest first."""
        heads = {path: head for path in self._slots if (head := _head(path))}
        good = [path for path, head in heads.items() if head.boot == boot]
        for path in sorted(good, key=lambda path: heads[path].tick, reverse=True):
            try:
                arrays = map_file.read_arrays(path, "the map")
            except ConfigError as error:
                refuse(str(error))
                continue
            arrays.pop(HEAD)
            if path == self._slots[0]:  # it is replaced last
                self._slots.reverse()
            yield heads[path], arrays

    def due(self, boot: int, tick: int) -> bool:
        """Return whether it is time to save."""
        self._finish(tick)
        new = self._doing is None or self._doing.boot != boot
        return self._job is None and (new or tick >= self._next_tick)

    def save(self, boot: int, tick: int, odometry: Floats, still: "MapSnapshot") -> None:
        """Begin to save a map as of one tick, unless it has not changed since the last save."""
        place = None if still.pose is None else _triple(still.pose)
        head = SaveHead(
            boot=boot,
            tick=tick,
            odometry=_triple(odometry),
            place=place,
            lost=still.lost,
            changes=still.changes,
        )
        if self._job:
            return
        self._next_tick = tick + PERIOD_TICKS
        if self._done and _alike(self._done, head):
            return
        self._began_tick = tick
        self._doing = head
        self._job = self._pool.submit(_write, self._slots[0], head, still)

    def discard(self) -> None:
        """Remove what was saved: another map takes its place."""
        self._done = None
        try:
            for path in self._slots:
                path.unlink(missing_ok=True)
        except OSError as error:
            self.problem = _unsaved(f"{error.filename}: {error.strerror}")

    def report(self) -> dict[str, float]:
        """Return counters for health reports."""
        return {"saves": self.saves, "saved_mb": round(self.bytes / 1e6, 1)}

    def close(self) -> None:
        """Save no more; what is under way may end or not."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _finish(self, tick: int) -> None:
        """Collect the result of a save, if it is done."""
        if self._job is None:
            return
        if not self._job.done():
            if tick > self._began_tick + STALLED_TICKS:
                self.problem = _unsaved(f"{self._slots[0]}: the disk does not take it")
            return
        job, self._job, failed = self._job, None, ""
        try:
            self.bytes = job.result()
        except OSError as error:
            failed = f"{error.filename or self._slots[0]}: {error.strerror or error}"
        except ValueError as error:
            failed = f"{self._slots[0]}: {error}"
        else:
            self._done, self.saves = self._doing, self.saves + 1
            self._slots.reverse()
        self.problem = _unsaved(failed) if failed else None
        self._next_tick = tick + max(PERIOD_TICKS, self.bytes // BYTES_A_TICK)


def refuse(why: str) -> None:
    """Log that a saved map is not gone on with."""
    log.warning("a saved map is refused: %s", why, extra={"data": {"event": "map"}})


def _triple(pose: Floats) -> Triple:
    x, y, yaw = pose.tolist()
    return x, y, yaw


def _head(path: Path) -> SaveHead | None:
    """Return the header of a file, or None without a readable file."""
    if not path.exists():
        return None
    try:
        content = map_file.read_arrays(path, "the map", only=HEAD)[HEAD].tobytes()
        return msgspec.json.decode(content, type=SaveHead)
    except (ConfigError, *DECODE_ERRORS) as error:
        refuse(str(error))
        return None


def _write(path: Path, head: SaveHead, still: "MapSnapshot") -> int:
    """Write the file and return its size [bytes]. Raises OSError and ValueError."""
    make_folder(path.parent)
    arrays = still.freeze()
    wanted = sum(values.nbytes for values in arrays.values()) + KEEP_FREE_BYTES
    if shutil.disk_usage(path.parent).free < wanted:
        raise ValueError(f"less than {wanted / 1e6:.0f} MB are free")
    arrays[HEAD] = np.frombuffer(msgspec.json.encode(head), np.uint8)
    with replacing(path) as file:
        map_file.write_arrays(file, arrays, compress=False)
    return path.stat().st_size


def _unsaved(why: str) -> Cause:
    return Cause(
        code="map_unsaved",
        text=f"the map is not saved, and would be lost with perception: {why}"[:500],
        remedy="make room on the disk, and see that the folder can be written",
    )


def _alike(one: SaveHead, other: SaveHead) -> bool:
    """Return whether neither the map nor the robot's place has changed much."""
    if (one.changes, one.boot, one.lost) != (other.changes, other.boot, other.lost):
        return False
    found = other.place is not None and (one.place is None or _moved(one.place, other.place))
    return not found and not _moved(one.odometry, other.odometry)


def _moved(before: Triple, after: Triple) -> bool:
    x, y, yaw = (b - a for a, b in zip(before, after, strict=True))
    return math.hypot(x, y) > MOVED_M or abs(math.remainder(yaw, math.tau)) > MOVED_RAD
