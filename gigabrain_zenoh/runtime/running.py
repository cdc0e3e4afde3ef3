"""Registry of the robots that run on this machine, so that tools and scripts can find them."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, BinaryIO

import msgspec
from msgspec import Meta, Struct, structs

from gigabrain_zenoh.bus.zenoh.config import SECURE, secured
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import Ambiguous, BusError, ConfigError, listed
from gigabrain_zenoh.host.files import cannot_write, expanded, open_regular
from gigabrain_zenoh.host.posix import fcntl
from gigabrain_zenoh.security.identity_files import check_files

SOCKET = "unixsock-stream"
MAX_NOTE_BYTES = 65536

Pid = Annotated[int, Meta(ge=1, le=2**31 - 1)]  # 0 and negative pids address process groups


class Running(Struct, frozen=True, kw_only=True):
    """A robot that runs on this machine."""

    pid: Pid  # of its supervisor, or of a router that was started by hand
    label: str  # name shown to users
    endpoint: Endpoint
    run_dir: str = ""  # folder of its logs


def folder() -> Path:
    """Return the folder in which each supervisor keeps a note while it runs."""
    runtime = (
        os.environ.get("XDG_RUNTIME_DIR") or f"{tempfile.gettempdir()}/gigabrain-{os.getuid()}"
    )
    return Path(runtime) / "gigabrain"


def local_socket() -> str:
    """Return the Zenoh endpoint of this supervisor's router that only this user can reach."""
    return f"{SOCKET}/{folder() / str(os.getpid())}.sock"


@contextmanager
def announced(label: str, endpoint: Endpoint, run_dir: Path | None = None) -> Iterator[Path]:
    """Keep a note on disk while the block runs, and yield its path. Raises ConfigError.

    The note stays locked while this process lives, because its pid may be reused afterwards.
    """
    note = folder() / f"{os.getpid()}.json"
    run = str(run_dir) if run_dir else ""
    robot = Running(pid=os.getpid(), label=label, endpoint=endpoint, run_dir=run)
    try:
        for directory in (note.parent.parent, note.parent):
            directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        _check_private(note.parent)
        file = _write_locked(note, msgspec.json.encode(robot))
    except OSError as error:
        raise cannot_write(note, error, "set XDG_RUNTIME_DIR") from None
    with file:
        try:
            yield note
        finally:
            _remove(note)


def _write_locked(note: Path, text: bytes) -> BinaryIO:
    """Write and lock the note, and return its open file. The note appears atomically."""
    fresh = note.with_suffix(".new")
    file = fresh.open("wb")
    try:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.write(text)
        file.flush()
        fresh.replace(note)
    except OSError:
        file.close()
        raise
    return file


def _check_private(place: Path) -> None:
    """Raise ConfigError where another user could put notes into the folder, or replace it."""
    for path in (place, place.parent):
        with contextlib.suppress(FileNotFoundError):
            try:  # a symbolic link of another user may point to a folder of this user
                owners = {path.lstat().st_uid, path.stat().st_uid}
            except PermissionError:  # this user may not enter its parent, so another user owns it
                owners = set()
            if owners != {os.getuid()} or path.stat().st_mode & 0o022:
                raise ConfigError(
                    f"{path} belongs to another user, or others may write it, so it cannot show "
                    "which robots run; set XDG_RUNTIME_DIR to a folder of your own, of mode 0700"
                )


def _remove(note: Path) -> None:
    """Remove a note, and the socket that its router may have left behind."""
    for path in (note, note.with_suffix(".sock"), note.with_suffix(".sock.lock")):
        path.unlink(missing_ok=True)


def running() -> list[Running]:
    """Return the robots whose supervisors are alive, and remove the notes of dead ones.

    Raises ConfigError where other users may have written the notes.
    """
    _check_private(folder())
    notes = sorted(folder().glob("*.json"))
    return [robot for note in notes if (robot := _read(note)) is not None]


def _read(note: Path) -> Running | None:
    """Return the robot of a note. If the note is invalid or its process is dead, remove it."""
    try:
        with open_regular(note) as file:
            if _locked(file):
                return msgspec.json.decode(file.read(MAX_NOTE_BYTES), type=Running)
    except (OSError, ConfigError, *DECODE_ERRORS):
        pass
    _remove(note)
    return None


def _locked(file: BinaryIO) -> bool:
    """Return whether the process that wrote the file still has it open."""
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    return False


def find_endpoint(connect: str | None, namespace: str = "", keys: str = "") -> Endpoint:
    """Return the endpoint given by `connect`, or that of the only robot on this machine.

    Raises BusError without a robot, Ambiguous for several robots, and ConfigError.
    `keys` is the folder of the client's identity, for a router that requires one. A client that
    names its identity is limited to its role. It does not use the local socket, which has the
    robot's rights.
    """
    identity = str(expanded(keys).absolute()) if keys else ""
    if connect:
        return secured(Endpoint(connect=(connect,), namespace=namespace, keys=identity))
    if identity and not os.path.isdir(identity):
        check_files(Path(identity))  # reports a mistyped path, also where no keys are needed
    endpoint = find_running(namespace).endpoint
    if identity and endpoint.connect[-1].startswith(SECURE):
        return structs.replace(endpoint, connect=endpoint.connect[-1:], keys=identity)
    return endpoint


def find_running(namespace: str = "") -> Running:
    """Return the only robot on this machine. Raises BusError for none, Ambiguous for several."""
    here = running()
    robots = [r for r in here if not namespace or r.endpoint.namespace == namespace]
    if here and not robots:
        names = listed(sorted({r.endpoint.namespace or "none" for r in here}))
        raise BusError(
            f"no robot runs here with namespace {namespace!r}; known: {names}; "
            "for one of another router, use --connect (in a script connect=)"
        )
    if not robots:
        raise BusError(
            "no robot runs here; start one with `gigabrain demo`, "
            "or use --connect (in a script connect=)"
        )
    by_address = {_address(robot): robot for robot in sorted(robots, key=_endpoint_count)}
    if len(by_address) > 1:
        where = ", ".join(f"{r.endpoint.connect[-1]} ({r.label})" for r in by_address.values())
        raise Ambiguous(f"several robots run here; choose one with --connect: {where}")
    return next(iter(by_address.values()))


def _address(robot: Running) -> tuple[str, str]:
    """Return the address and namespace, which two hosts of one robot on this machine share."""
    return robot.endpoint.connect[-1], robot.endpoint.namespace


def _endpoint_count(robot: Running) -> int:
    return len(robot.endpoint.connect)
