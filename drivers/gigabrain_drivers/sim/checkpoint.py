"""Checkpoints of a simulation: a body stays where it is when its driver dies and starts again."""

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

from gigabrain_schemas.sim import Thing
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.errors import ConfigError

log = logging.getLogger(__name__)

HEAD = struct.Struct("<II")  # length of the content, and its CRC-32
BINARY = getattr(os, "O_BINARY", 0)  # on Windows


class Checkpoint(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A simulation at the end of a step; another one goes on from there, at rest."""

    model: bytes  # digest of the MuJoCo model of body and world
    steps: int
    physics: bytes  # float64, MuJoCo's mjSTATE_FULLPHYSICS
    charge_ah: float  # left in the battery
    aims: tuple[float, ...]  # of the arm's servos [rad] or [m]
    limp: bool
    things: tuple[Thing, ...]  # put in by hand
    walked: tuple[float, ...]  # [m], of each person who walks: the world's own come first
    person_stood: int
    contacts: int
    falls: int
    min_clearance_m: float
    distance_m: float


class CheckpointFiles:
    """The newest checkpoints of a run, in two files that are written in turn.

    A process that is killed while it writes leaves the other one. They are not synced to disk: a
    run does not outlive the machine.
    """

    def __init__(self, path: Path) -> None:
        self._paths = [Path(f"{path}.{number}") for number in range(2)]
        self._turns = cycle(self._paths)
        self._saving: asyncio.Future[None] | None = None
        self._ended = False  # a write has failed, or they were discarded

    def read(self) -> Checkpoint | None:
        """Return the newest checkpoint; None for none. Raises OSError.

        Raises ConfigError if both are damaged.
        """
        files = [path.read_bytes() for path in self._paths if path.exists()]
        found = [one for data in files if (one := _decoded(data))]
        if files and not found:
            raise ConfigError("the checkpoint is damaged")
        return max(found, key=lambda one: one.steps, default=None)

    def write(self, checkpoint: Checkpoint) -> None:
        """Write over the older one. Raises OSError."""
        text = msgspec.msgpack.encode(checkpoint)
        file = os.open(next(self._turns), os.O_WRONLY | os.O_CREAT | BINARY, 0o600)
        try:
            os.write(file, HEAD.pack(len(text), zlib.crc32(text)) + text)
        finally:
            os.close(file)

    def save(self, checkpoint: Checkpoint) -> asyncio.Future[None]:
        """Write it in a thread, unless the last one is still being written; return what ends then.

        So a disk that hangs holds up no tick.
        """
        if self._saving is None or self._saving.done():
            self._saving = asyncio.ensure_future(asyncio.to_thread(self._save, checkpoint))
        return self._saving

    async def discard(self) -> None:
        """Remove all checkpoints, also one that is being written."""
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
            log.warning("the simulation will begin at its start after a crash: %s", error)
            self._ended = True
            self.clear()

    def clear(self) -> None:
        """Remove all checkpoints."""
        for path in self._paths:
            with contextlib.suppress(OSError):  # there is none, or the disk fails
                path.unlink()


def _decoded(data: bytes) -> Checkpoint | None:
    if len(data) < HEAD.size:
        return None
    length, crc = HEAD.unpack_from(data)
    text = data[HEAD.size : HEAD.size + length]
    if len(text) != length or zlib.crc32(text) != crc:
        return None
    try:
        return msgspec.msgpack.decode(text, type=Checkpoint)
    except DECODE_ERRORS:
        return None
