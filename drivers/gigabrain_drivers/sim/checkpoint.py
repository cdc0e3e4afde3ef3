"""Checkpoints of a simulation, so that a body keeps its place when its process restarts."""

import asyncio
import contextlib
import logging
import os
import struct
import zlib
from itertools import cycle
from pathlib import Path

import msgspec
from msgspec import Struct

from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.sim import Thing
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.errors import ConfigError

log = logging.getLogger(__name__)

HEADER = struct.Struct("<II")  # length of the content, and its CRC-32
PERIOD_NS = 100_000_000  # of simulated time, between two checkpoints
BINARY = getattr(os, "O_BINARY", 0)  # exists only on Windows


class Checkpoint(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A simulation at the end of a step. Another one continues from it, at rest."""

    model: bytes  # digest of the MuJoCo model of body and world
    steps: int
    physics: bytes  # float64, MuJoCo's mjSTATE_FULLPHYSICS
    charge_ah: float  # remaining in the battery
    aims: tuple[float, ...]  # of the arm's servos [rad] or [m]
    limp: bool
    things: tuple[Thing, ...]  # put in by hand
    walked: tuple[float, ...]  # [m], by each walking person; the world's own come first
    person_stood: int
    contacts: int
    falls: int
    min_clearance_m: float
    distance_m: float


class CheckpointFiles:
    """The newest checkpoints of a run, written to two files in turn.

    A process that is killed while it writes leaves the other file intact. The files are not synced
    to disk, because a run ends with its machine.
    """

    def __init__(self, path: Path) -> None:
        self._paths = [Path(f"{path}.{number}") for number in range(2)]
        self._turns = cycle(self._paths)
        self._saving: asyncio.Future[None] | None = None
        self._ended = False  # a write failed, or the checkpoints were discarded

    def read(self) -> Checkpoint | None:
        """Return the newest checkpoint, or None without files. Raises OSError.

        Raises ConfigError if both are damaged.
        """
        files = [path.read_bytes() for path in self._paths if path.exists()]
        found = [one for data in files if (one := _decoded(data))]
        if files and not found:
            raise ConfigError("the checkpoint is damaged")
        return max(found, key=lambda one: one.steps, default=None)

    def write(self, checkpoint: Checkpoint) -> None:
        """Overwrite the older file. Raises OSError."""
        text = msgspec.msgpack.encode(checkpoint)
        file = os.open(next(self._turns), os.O_WRONLY | os.O_CREAT | BINARY, 0o600)
        try:
            os.write(file, HEADER.pack(len(text), zlib.crc32(text)) + text)
        finally:
            os.close(file)

    def save(self, checkpoint: Checkpoint) -> asyncio.Future[None]:
        """Write it in a thread, unless a write is in progress; return that write's future.

        So a disk that hangs delays no tick.
        """
        if self._saving is None or self._saving.done():
            self._saving = asyncio.ensure_future(asyncio.to_thread(self._save, checkpoint))
        return self._saving

    async def discard(self) -> None:
        """Remove all checkpoints, after a write in progress."""
        self._ended = True
        if self._saving:
            await self._saving
        self.clear()

    def _save(self, checkpoint: Checkpoint) -> None:
        if self._ended:
            return
        try:
            self.write(checkpoint)
        except OSError as error:
            log.warning("the simulation will start from the beginning after a crash: %s", error)
            self._ended = True
            self.clear()

    def clear(self) -> None:
        """Remove all checkpoints."""
        for path in self._paths:
            with contextlib.suppress(OSError):  # no such file, or the disk fails
                path.unlink()


def checkpoint_files(run: Run) -> CheckpointFiles | None:
    """Return the checkpoints of a run; None if it keeps none."""
    return CheckpointFiles(Path(run.checkpoint)) if run.checkpoint else None


def _decoded(data: bytes) -> Checkpoint | None:
    if len(data) < HEADER.size:
        return None
    length, crc = HEADER.unpack_from(data)
    text = data[HEADER.size : HEADER.size + length]
    if len(text) != length or zlib.crc32(text) != crc:
        return None
    try:
        return msgspec.msgpack.decode(text, type=Checkpoint)
    except DECODE_ERRORS:
        return None
