"""Checks the files of an identity, and the processes that a host may run with it."""

import logging
import os
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec

from gigabrain_schemas.topics import Role
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import BusError, ConfigError
from gigabrain_zenoh.host.files import (
    cannot_read,
    create_file,
    expanded,
    file_problem,
    open_regular,
    read_bounded,
    replace_file,
)
from gigabrain_zenoh.host.network import host_and_port
from gigabrain_zenoh.host.posix import fcntl
from gigabrain_zenoh.security.acl import common_name

log = logging.getLogger(__name__)
CA, CA_KEY = "ca.crt", "ca.key"
CERTIFICATE, KEY = "identity.crt", "identity.key"
MAX_SECRET_BYTES = 65_536  # of a file of `made_once`
REMEDY = "copy the whole folder that `gigabrain keys issue` made"


def check_files(folder: Path) -> None:
    """Check that all files of an identity exist and its key is private. Raises ConfigError."""
    path = folder
    try:
        if not folder.is_dir():
            raise ConfigError(
                f"{folder}: no folder with keys; make an identity with `gigabrain keys issue ROLE` "
                "and copy its folder here"
            )
        for path in (folder / name for name in (CA, CERTIFICATE, KEY)):
            if not path.is_file():
                raise ConfigError(f"{folder}: {path.name} is missing; {REMEDY}")
            if not os.access(path, os.R_OK):
                raise PermissionError
    except PermissionError:
        raise unreadable(path) from None
    check_private(folder / KEY)


def check_private(path: Path) -> None:
    """Check that only its owner may read a key. Raises ConfigError."""
    mode = stat.S_IMODE(path.stat().st_mode)
    if os.name == "posix" and mode & 0o077:
        raise ConfigError(f"{path} is open to others (mode {mode:04o}); chmod 600 {path}")


def made_once(path: Path, content: bytes) -> tuple[bytes, bool]:
    """Read a private file, or create it with `content`; return the content, and if it is new.

    If several processes create it, one succeeds, and all read the complete file. An empty file, as
    after a crash, is replaced. Raises ConfigError.
    """
    try:
        if path.exists() and (found := read_bounded(path, MAX_SECRET_BYTES)):
            check_private(path)
            return found, False
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            create_file(path, content)
            return content, True
        except FileExistsError:
            check_private(path)
        with open_regular(path, MAX_SECRET_BYTES) as old:
            fcntl.flock(old, fcntl.LOCK_EX)  # only one process replaces it
            found = read_bounded(path, MAX_SECRET_BYTES)
            if not found:
                log.warning("%s was empty; replaced it", path)
                replace_file(path, content, 0o600)
            return found or content, not found
    except OSError as error:
        raise ConfigError(f"cannot read or write {path}: {file_problem(error)}") from None


def unreadable(path: Path) -> ConfigError:
    """Return the error for a file that this user may not read."""
    return ConfigError(f"{path} cannot be read by this user; run as its owner, or chown it")


def identity_folder(keys: str, host: str = "") -> Path:
    """Return the folder of the identity: `keys`, or its subfolder for `host`."""
    folder = expanded(keys)
    of_host = folder / host
    if host and not os.path.exists(folder / CERTIFICATE) and os.path.isdir(of_host):
        return of_host
    return folder


if TYPE_CHECKING:
    from gigabrain_zenoh.security.authority import Identity
INSTALL = "keys need more: pip install 'gigabrain-zenoh[keys]'"


def identity_in(folder: Path) -> "Identity":
    """Return the identity in a folder. Raises ConfigError if it cannot be used."""
    try:  # takes 150 ms, and only certificates need it
        from gigabrain_zenoh.security.authority import load
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}; {INSTALL}") from None
    return load(folder)


def check_identity(
    folder: Path, processes: Mapping[str, Sequence[Role]], namespace: str, router: str
) -> None:
    """Check that a host with this identity may run `processes` of the robot `namespace`.

    `processes` contains the roles that may run each process. Raises ConfigError, which names the
    required identity.
    """
    identity = identity_in(folder)
    for process, roles in processes.items():
        if identity.role not in roles:
            wanted = " or ".join(common_name(role, namespace) for role in roles)
            raise ConfigError(f"{folder} is the identity of {identity.name}; {process} "
                              f"needs that of {wanted}")  # fmt: skip
    if identity.robot != namespace and (identity.robot or identity.role in ("robot", "brain")):
        wanted = common_name(identity.role, namespace)
        raise ConfigError(f"{folder} is the identity of {identity.name}; expected {wanted}")
    host, _ = host_and_port(router)
    names = map(str.lower, identity.hosts)
    if "router" in processes and host and host.lower() not in names:
        raise ConfigError(
            f"{folder} is for a router at {', '.join(identity.hosts)}, not at {host}; "
            f"issue one with --host {host}"
        )


def check_own_identity(folder: Path, process: str, namespace: str) -> None:
    """Check that `folder` is the identity of the user's own process. Raises ConfigError."""
    wanted = common_name("process", namespace, process=process)
    if not folder.is_dir():
        robot = f" --robot {namespace}" if namespace else ""
        raise ConfigError(
            f"{process} needs an identity of its own; make one with `gigabrain keys issue process "
            f"--process {process}{robot}`, and copy its folder to {folder}"
        )
    identity = identity_in(folder)
    name = common_name(identity.role, identity.robot, process=identity.process)
    if name != wanted:
        raise ConfigError(f"{folder} is the identity of {identity.name}; expected {wanted}")


def no_router(endpoint: Endpoint) -> BusError:
    """Return the error for a router that does not answer. Raises ConfigError for invalid keys."""
    where, doubt = endpoint.connect[-1], "is the robot running without keys?"
    if endpoint.keys:
        identity = identity_in(Path(endpoint.keys))
        doubt = f"is the robot running with keys of the fleet {identity.fleet!r}?"
    return BusError(f"no router answers at {where}; {doubt}")


def may_not_ask(keys: str) -> str:
    """Return the missing right as a possible reason for no reply; routers do not report denials."""
    return f"; or {identity_in(Path(keys)).name} may not request it" if keys else ""


LIST = "generations.json"
MAX_GENERATION = 10_000
MAX_LIST_BYTES = 1_000_000


def generations_in(folder: Path) -> dict[str, int]:
    """Return the generation by common name; empty without a list. Raises ConfigError."""
    path = folder / LIST
    try:
        return msgspec.json.decode(
            read_bounded(path, MAX_LIST_BYTES),
            type=dict[str, Annotated[int, msgspec.Meta(ge=1, le=MAX_GENERATION)]],
        )
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise cannot_read(path, error) from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {error}; copy it from the fleet's folder again") from None


def find_fleet(folder: Path | None) -> Path:
    """Return `folder`, or the only fleet in the working folder. Raises ConfigError."""
    if folder:
        try:
            (folder / CA_KEY).stat()
        except PermissionError:
            raise unreadable(folder) from None
        except OSError:
            text = f"{folder}: no {CA_KEY}; create a fleet with `gigabrain keys new`"
            raise ConfigError(text) from None
        return folder
    try:
        places = (Path(), *sorted(Path().iterdir()))
    except OSError as error:
        remedy = "name the fleet's folder with --dir"
        raise ConfigError(f"cannot list this folder: {file_problem(error, remedy)}") from None
    fleets = [place for place in places if os.path.exists(place / CA_KEY)]
    if not fleets:
        raise ConfigError("no fleet in this folder; create one with `gigabrain keys new`, "
                          "or name its folder with --dir")  # fmt: skip
    if len(fleets) > 1:
        names = ", ".join(map(str, fleets))
        raise ConfigError(f"several fleets in this folder; choose one with --dir: {names}")
    return fleets[0]
