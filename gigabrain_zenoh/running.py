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


@contextmanager
def announced(label: str, endpoint: Endpoint) -> Iterator[None]:
    """Leave a note while the block runs."""
    note = folder() / f"{os.getpid()}.json"
    robot = Running(pid=os.getpid(), label=label, endpoint=endpoint)
    try:
        note.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        fresh = note.with_suffix(".new")  # nobody finds half a note
        fresh.write_bytes(msgspec.json.encode(robot))
        fresh.replace(note)
    except OSError as error:
        raise ConfigError(f"cannot write {note}: {error.strerror}; set XDG_RUNTIME_DIR") from None
    try:
        yield
    finally:
        note.unlink(missing_ok=True)


def running() -> list[Running]:
    """The robots whose supervisors are alive; notes of dead ones are taken away."""
    found = []
    for note in sorted(folder().glob("*.json")):
        try:
            robot = msgspec.json.decode(note.read_bytes(), type=Running)
            os.kill(robot.pid, 0)
        except (OSError, *DECODE_ERRORS):
            note.unlink(missing_ok=True)
        else:
            found.append(robot)
    return found


def find_endpoint(connect: str | None, namespace: str = "") -> Endpoint:
    """Where the robot is: as told, or the only one on this machine. Raises BusError."""
    if connect:
        return Endpoint(connect=(connect,), namespace=namespace)
    robots = [r for r in running() if not namespace or r.endpoint.namespace == namespace]
    if not robots:
        raise BusError("no robot runs here; start one with `gigabrain demo`, or name its router")
    if len(robots) > 1:
        where = ", ".join(f"{r.endpoint.connect[0]} ({r.label})" for r in robots)
        raise BusError(f"several robots run here; choose one with --connect: {where}")
    return robots[0].endpoint
