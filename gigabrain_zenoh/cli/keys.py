"""`gigabrain keys`: the authority of a fleet, and identities for its hosts and people."""

import contextlib
import os
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from gigabrain_schemas.topics import Role
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.security.identity_files import (
    CA_KEY,
    CERTIFICATE,
    INSTALL,
    LIST,
    find_fleet,
    generations_in,
)

FleetFolder = Annotated[
    Path | None, Parameter(help="Folder of the fleet. Default: the only one in this folder.")
]


def new(fleet: str, *, dir: Path | None = None) -> None:
    """Create the authority of a fleet, which issues identities.

    Example: gigabrain keys new home

    Args:
        fleet: Name of the fleet.
        dir: Folder to create. Default: the name of the fleet.
    """
    with _needs_cryptography():
        from gigabrain_zenoh.security.authority import new_fleet

    folder = dir or Path(fleet)
    new_fleet(fleet, folder)
    print(f"{folder / CA_KEY}: keep it on this machine; with it anybody can issue identities")
    print(f"next: gigabrain keys issue robot --host ADDRESS --dir {_quoted(folder)}")


def issue(
    role: Role,
    *,
    name: str = "",
    host: tuple[str, ...] = (),
    robot: str = "",
    process: str = "",
    days: int = 365,
    dir: FleetFolder = None,
) -> None:
    """Issue an identity: a folder to copy to its host.

    Example: gigabrain keys issue robot --host 192.168.1.10

    Roles: robot: all processes of a robot. brain: perception and decision.
    operator: drive, stop and release. viewer: receive only. router: the router
    of a site, on a host of its own. dispatcher: Open-RMF's adapter: goals of
    robots with free_fleet, and nothing else. process: a process of your own:
    receives all, and sends what it declares.

    Args:
        role: Role of the identity.
        name: Name of its folder. Default: role and robot.
        host: Address or name where others reach its router; may be given again.
        robot: Namespace of the robot. Default: all robots, for an operator, viewer or dispatcher.
        process: Name of the process of your own, for the role process.
        days: Days until it expires.
    """
    with _needs_cryptography():
        from gigabrain_zenoh.security import authority

    folder = authority.issue(
        find_fleet(dir), role, robot=robot, process=process, name=name, hosts=host, days=days
    )
    if process:
        print(f"{folder}: copy it to its host, as `{process}` in the folder of the host's identity")
        return
    print(f"{folder}: copy it to its host, and keep others from reading it")
    print(f"next: {_first_use(role, robot, folder)}")


def revoke(role: Role, *, robot: str = "", process: str = "", dir: FleetFolder = None) -> None:
    """Revoke all identities of a role, such as those of a lost laptop. Later ones stay valid.

    Example: gigabrain keys revoke operator

    Routers refuse them once they have the new list and are restarted.

    Args:
        role: Role of the identities: brain, operator, viewer, dispatcher or process.
        robot: Namespace of the robot, for identities that name one.
        process: Name of the process, for the role process.
    """
    with _needs_cryptography():
        from gigabrain_zenoh.security import authority

    folder = find_fleet(dir)
    lists = authority.revoke(folder, role, robot, process)
    for path in lists:
        print(f"{path}: copy it to that identity's folder on its host, and restart its router")
    if not lists:
        print(f"{folder / LIST}: copy it to the keys of each router on its host, and restart it")
    option = f" --process {process}" if process else ""
    option += f" --robot {robot}" if robot else ""
    print(f"next, for those who keep access: gigabrain keys issue {role}{option}"
          f" --dir {_quoted(folder)}")  # fmt: skip


def identities(*, dir: FleetFolder = None) -> int:
    """List identities, and when they expire. Exit code 1 if one is not valid.

    Example: gigabrain keys list

    Args:
        dir: Folder of a fleet or of one identity. Default: the only fleet in this folder.
    """
    with _needs_cryptography():
        from gigabrain_zenoh.security.authority import list_identities

    folder = dir if dir and os.path.exists(dir / CERTIFICATE) else find_fleet(dir)
    all_valid = True
    for line, valid in list_identities(folder):
        print(line)
        all_valid &= valid
    return 0 if all_valid else 1


def zenohd(
    *,
    robot: tuple[str, ...] = (),
    keys: Path = Path("/etc/gigabrain/keys"),
    listen: str = "tls/0.0.0.0:7447",
    dir: Path | None = None,
) -> None:
    """Print a zenohd configuration for a larger site.

    Example: gigabrain keys zenohd --robot red --robot blue

    Args:
        robot: Namespace of a robot; may be given again.
        keys: Folder of its identity on its host.
        listen: Zenoh endpoint to listen on.
        dir: Folder of the fleet, if identities were revoked.
    """
    with _needs_cryptography():
        from gigabrain_zenoh.bus.zenoh.config import configuration
        from gigabrain_zenoh.config.settings import Endpoint
        from gigabrain_zenoh.launch.processes import grants, names_by_role

    generations = generations_in(find_fleet(dir)) if dir else {}
    endpoint = Endpoint(
        listen=(listen,),
        keys=str(keys),
        fleet=robot or ("",),
        names=names_by_role(),
        grants=grants(),
    )
    print(configuration(endpoint, generations), end="")


def _first_use(role: Role, robot: str, folder: Path) -> str:
    """Return an example of a command that uses a new identity."""
    keys, namespace = _quoted(folder), f" --namespace {robot}" if robot else ""
    if role == "router":
        return f"gigabrain router --listen tls/0.0.0.0:7447 --fleet NAMESPACE --keys {keys}"
    if role in ("operator", "viewer"):
        command = "estop" if role == "operator" else "topic list"
        return f"gigabrain {command} --connect tls/ADDRESS:7447{namespace} --keys {keys}"
    if role == "dispatcher":
        return f"name the three files of {keys} in the Zenoh configuration of Open-RMF's adapter"
    return f"gigabrain up FILE --host HOST --keys {keys}, where FILE has a line `keys:`"


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


@contextlib.contextmanager
def _needs_cryptography() -> Iterator[None]:
    """Raise ConfigError with the pip command if the library is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}; {INSTALL}") from None
