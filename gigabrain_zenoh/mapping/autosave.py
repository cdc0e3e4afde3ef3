"""Saves the growing map every few seconds, so that it outlives its process.

Two files are written in turn: if one is damaged, the other remains. They are valid for one start of
the driver: before the next the robot may be moved.
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
    from gigabrain_zenoh.mapping.slam_map import MapSnapshot  # imports gtsam: for slam only

log = logging.getLogger(__name__)

PERIOD_TICKS = 200  # shortest time between saves
BYTES_PER_TICK = 100_000  # 5 MB/s: maps of more than 20 MB are saved less often
KEEP_FREE_BYTES = 200_000_000  # on the disk, for others
STALLED_TICKS = 1500  # a longer write is reported
MOVED_M, MOVED_RAD = 0.3, 0.3  # an unchanged map is saved only after this motion
HEADER = "head"

Triple = tuple[Finite, Finite, Finite]


class SaveHeader(Struct, frozen=True, kw_only=True):
    """Time and place of a save."""

    boot: Count  # start of the driver
    tick: Count
    odometry: Triple  # x, y [m] and yaw [rad] of the robot
    place: Triple | None  # the same in the map, as far as odometry knows it
    lost: bool = False  # the robot was searched for
    changes: tuple[int, int, int]  # see MapSnapshot


class Autosave:
    """Saves in a thread of its own. Call it from one thread."""

    def __init__(self, folder: Path) -> None:
        self._slots = [folder / f"map_{number}.npz" for number in (0, 1)]  # next to write first
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="autosave")
        self._job: Future[int] | None = None
        self._attempted: SaveHeader | None = None  # last attempt
        self._saved: SaveHeader | None = None  # last success
        self._began_tick = self._next_tick = 0
        self.problem: Cause | None = None
        self.saves = 0
        self.bytes = 0  # of the last save

    def found(self, boot: int) -> Iterator[tuple[SaveHeader, Arrays]]:
        """Yield the maps that were saved in start `boot` of the driver, the newest first."""
        headers = {path: header for path in self._slots if (header := _read_header(path))}
        good = [path for path, header in headers.items() if header.boot == boot]
        for path in sorted(good, key=lambda path: headers[path].tick, reverse=True):
            try:
                arrays = map_file.read_arrays(path, "the map")
            except ConfigError as error:
                refuse(str(error))
                continue
            arrays.pop(HEADER)
            if path == self._slots[0]:  # it is replaced last
                self._slots.reverse()
            yield headers[path], arrays

    def due(self, boot: int, tick: int) -> bool:
        """Return whether it is time to save."""
        self._finish(tick)
        first_of_boot = self._attempted is None or self._attempted.boot != boot
        return self._job is None and (first_of_boot or tick >= self._next_tick)

    def save(self, boot: int, tick: int, odometry: Floats, snapshot: "MapSnapshot") -> None:
        """Start to save a map as it was at `tick`, if it changed since the last save."""
        place = None if snapshot.pose is None else _as_tuple(snapshot.pose)
        header = SaveHeader(
            boot=boot,
            tick=tick,
            odometry=_as_tuple(odometry),
            place=place,
            lost=snapshot.lost,
            changes=snapshot.changes,
        )
        if self._job:
            return
        self._next_tick = tick + PERIOD_TICKS
        if self._saved and _is_unchanged(self._saved, header):
            return
        self._began_tick = tick
        self._attempted = header
        self._job = self._pool.submit(_write, self._slots[0], header, snapshot)

    def discard(self) -> None:
        """Remove the saved files: another map replaces this one."""
        self._saved = None
        try:
            for path in self._slots:
                path.unlink(missing_ok=True)
        except OSError as error:
            self.problem = _unsaved_cause(f"{error.filename}: {error.strerror}")

    def report(self) -> dict[str, float]:
        """Return counters for health reports."""
        return {"saves": self.saves, "saved_mb": round(self.bytes / 1e6, 1)}

    def close(self) -> None:
        """Stop saving; a running save may or may not end."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _finish(self, tick: int) -> None:
        """Collect the result of a save, if it is done."""
        if self._job is None:
            return
        if not self._job.done():
            if tick > self._began_tick + STALLED_TICKS:
                self.problem = _unsaved_cause(f"{self._slots[0]}: saving takes too long")
            return
        job, self._job, failed = self._job, None, ""
        try:
            self.bytes = job.result()
        except OSError as error:
            failed = f"{error.filename or self._slots[0]}: {error.strerror or error}"
        except ValueError as error:
            failed = f"{self._slots[0]}: {error}"
        else:
            self._saved, self.saves = self._attempted, self.saves + 1
            self._slots.reverse()
        self.problem = _unsaved_cause(failed) if failed else None
        self._next_tick = tick + max(PERIOD_TICKS, self.bytes // BYTES_PER_TICK)


def refuse(why: str) -> None:
    """Log that a saved map is not continued."""
    log.warning("a saved map is refused: %s", why, extra={"data": {"event": "map"}})


def _as_tuple(pose: Floats) -> Triple:
    x, y, yaw = pose.tolist()
    return x, y, yaw


def _read_header(path: Path) -> SaveHeader | None:
    """Return the header of a file, or None if it cannot be read."""
    if not path.exists():
        return None
    try:
        content = map_file.read_arrays(path, "the map", only=HEADER)[HEADER].tobytes()
        return msgspec.json.decode(content, type=SaveHeader)
    except (ConfigError, *DECODE_ERRORS) as error:
        refuse(str(error))
        return None


def _write(path: Path, header: SaveHeader, snapshot: "MapSnapshot") -> int:
    """Write the file and return its size [bytes]. Raises OSError and ValueError."""
    make_folder(path.parent)
    arrays = snapshot.freeze()
    needed = sum(values.nbytes for values in arrays.values()) + KEEP_FREE_BYTES
    if shutil.disk_usage(path.parent).free < needed:
        raise ValueError(f"less than {needed / 1e6:.0f} MB are free")
    arrays[HEADER] = np.frombuffer(msgspec.json.encode(header), np.uint8)
    with replacing(path) as file:
        map_file.write_arrays(file, arrays, compress=False)
    return path.stat().st_size


def _unsaved_cause(why: str) -> Cause:
    return Cause(
        code="map_unsaved",
        text=f"the map is not saved; it is lost if perception ends: {why}"[:500],
        remedy="make room on the disk, and check that the folder is writable",
    )


def _is_unchanged(saved: SaveHeader, present: SaveHeader) -> bool:
    """Return whether neither the map nor the robot's pose changed much."""
    if (saved.changes, saved.boot, saved.lost) != (present.changes, present.boot, present.lost):
        return False
    place_changed = present.place is not None and (
        saved.place is None or _has_moved(saved.place, present.place)
    )
    return not place_changed and not _has_moved(saved.odometry, present.odometry)


def _has_moved(before: Triple, after: Triple) -> bool:
    x, y, yaw = (b - a for a, b in zip(before, after, strict=True))
    return math.hypot(x, y) > MOVED_M or abs(math.remainder(yaw, math.tau)) > MOVED_RAD
