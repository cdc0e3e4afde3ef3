"""Which robots run on this machine, so that tools and scripts find them by themselves."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.errors import BusError, ConfigError
from gigabrain_zenoh.settings import Endpoint
from gigabrain_zenoh.zenoh_config import secured

SOCKET = "unixsock-stream"

Pid = Annotated[int, Meta(ge=1, le=2**31 - 1)]  # no group, and nobody's by default


class Running(Struct, frozen=True, kw_only=True):
    """One robot on this machine."""

    pid: Pid  # of its supervisor
    label: str  # for people
    endpoint: Endpoint


def folder() -> Path:
    """Where each supervisor leaves a note for as long as it runs."""
    runtime = (
        os.environ.get("XDG_RUNTIME_DIR") or f"{tempfile.gettempdir()}/gigabrain-{os.getuid()}"
    )
    return Path(runtime) / "gigabrain"


def local_socket() -> str:
    """The Zenoh endpoint by which only this user reaches the router of this supervisor."""
    return f"{SOCKET}/{folder() / str(os.getpid())}.sock"


@contextmanager
def announced(label: str, endpoint: Endpoint) -> Iterator[Path]:
    """Leave a note while the block runs; its path."""
    note = folder() / f"{os.getpid()}.json"
    robot = Running(pid=os.getpid(), label=label, endpoint=endpoint)
    try:
        note.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if note.parent.stat().st_uid != os.getuid():
            raise ConfigError(f"{note.parent} is somebody else's; set XDG_RUNTIME_DIR")
        fresh = note.with_suffix(".new")  # nobody finds half a note
        fresh.write_bytes(msgspec.json.encode(robot))
        fresh.replace(note)
    except OSError as error:
        raise ConfigError(f"cannot write {note}: {error.strerror}; set XDG_RUNTIME_DIR") from None
    try:
        yield note
    finally:
        _forget(note)


def _forget(note: Path) -> None:
    """Take away a note, and the socket that a router beside it may have left."""
    for path in (note, note.with_suffix(".sock"), note.with_suffix(".sock.lock")):
        path.unlink(missing_ok=True)


def running() -> list[Running]:
    """The robots whose supervisors are alive; notes of dead ones are taken away."""
    found = []
    for note in sorted(folder().glob("*.json")):
        try:
            robot = msgspec.json.decode(note.read_bytes(), type=Running)
            os.kill(robot.pid, 0)
        except (OSError, *DECODE_ERRORS):
            _forget(note)
        else:
            found.append(robot)
    return found


def find_endpoint(connect: str | None, namespace: str = "", keys: str = "") -> Endpoint:
    """Where the robot is: as told, or the only one on this machine. Raises BusError.

    `keys` is the folder of the asker's identity, for a router that wants one.
    """
    if connect:
        folder = str(Path(keys).expanduser().absolute()) if keys else ""
        return secured(Endpoint(connect=(connect,), namespace=namespace, keys=folder))
    robots = [r for r in running() if not namespace or r.endpoint.namespace == namespace]
    if not robots:
        raise BusError("no robot runs here; start one with `gigabrain demo`, or name its router")
    nearest = {_place(robot): robot for robot in sorted(robots, key=_ways)}
    if len(nearest) > 1:
        where = ", ".join(f"{r.endpoint.connect[-1]} ({r.label})" for r in nearest.values())
        raise BusError(f"several robots run here; choose one with --connect: {where}")
    return next(iter(nearest.values())).endpoint


def _place(robot: Running) -> tuple[str, str]:
    """What two hosts of one robot have in common, where both are this machine."""
    return robot.endpoint.connect[-1], robot.endpoint.namespace


def _ways(robot: Running) -> int:
    return len(robot.endpoint.connect)
