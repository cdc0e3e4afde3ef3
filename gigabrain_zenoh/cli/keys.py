"""`gigabrain keys`: a fleet's own authority, and identities for its hosts and people."""

import contextlib
import datetime
import shlex
from collections.abc import Iterator
from pathlib import Path

from gigabrain_zenoh.errors import ConfigError, GigabrainError
from gigabrain_zenoh.security.acl import Role, common_name
from gigabrain_zenoh.security.identity_files import CA_KEY, CERTIFICATE, INSTALL, generations_in

SOON_DAYS = 30


def new(fleet: str, *, dir: Path | None = None) -> None:
    """Make a fleet's own authority, which issues identities.

    Example: gigabrain keys new home

    Parameters
    ----------
    fleet
        What it is called.
    dir
        The folder to make; without it, one named after the fleet.
    """
    with _importing():
        from gigabrain_zenoh.security.authority import new_fleet

    folder = dir or Path(fleet)
    new_fleet(fleet, folder)
    print(f"{folder / CA_KEY}: keep it on this machine; whoever has it can be anybody")
    print(f"next: gigabrain keys issue robot --host ADDRESS --dir {_quoted(folder)}")


def issue(
    role: Role,
    *,
    name: str = "",
    host: tuple[str, ...] = (),
    robot: str = "",
    days: int = 365,
    dir: Path | None = None,
) -> None:
    """Make an identity: a folder to copy to its host.

    Example: gigabrain keys issue robot --host 192.168.1.10

    Parameters
    ----------
    role
        robot: all of its own; brain: perception and decision; operator: drive, stop and release;
        viewer: listen; router: a site's router on a host of its own.
    name
        What its folder is called; without it, what the role and the robot are.
    host
        An address or name under which others will reach the router that runs there.
    robot
        The robot's namespace, if it has one; an operator or viewer without one is of all robots.
    days
        For how long it is good.
    dir
        The fleet's folder; without it, the only one here.
    """
    with _importing():
        from gigabrain_zenoh.security import authority

    folder = authority.issue(_fleet(dir), role, robot=robot, name=name, hosts=host, days=days)
    print(f"{folder}: copy it to its host, and let nobody else read it")
    print(f"next: {_use(role, robot, folder)}")


def revoke(role: Role, *, robot: str = "", dir: Path | None = None) -> None:
    """Call back all identities of a role, such as those of a lost laptop. New ones are good again.

    Example: gigabrain keys revoke operator

    Routers refuse them once they have the new list and were started again.

    Parameters
    ----------
    role
        brain, operator or viewer.
    robot
        The robot's namespace, where the identities name one.
    dir
        The fleet's folder; without it, the only one here.
    """
    with _importing():
        from gigabrain_zenoh.security import authority

    folder = _fleet(dir)
    lists = authority.revoke(folder, role, robot)
    for path in lists:
        print(
            f"{path}: copy it into that identity's folder on its host, and start its router again"
        )
    if not lists:
        print("no router's identity here: whoever is issued one from now on has the list")
    of = f" --robot {robot}" if robot else ""
    print(f"next, for those who stay: gigabrain keys issue {role}{of} --dir {_quoted(folder)}")


def identities(*, dir: Path | None = None) -> int:
    """List identities, and when they expire. Ends with 1 where one cannot be used.

    Example: gigabrain keys list

    Parameters
    ----------
    dir
        The fleet's folder, or that of one identity; without it, the only fleet here.
    """
    folder = dir if dir and (dir / CERTIFICATE).exists() else _fleet(dir)
    good = True
    for line, ok in _listed(folder):
        print(line)
        good &= ok
    return 0 if good else 1


def zenohd(
    *,
    robot: tuple[str, ...] = (),
    keys: Path = Path("/etc/gigabrain/keys"),
    listen: str = "tls/0.0.0.0:7447",
    dir: Path | None = None,
) -> None:
    """Print the configuration of a router for a larger site.

    Example: gigabrain keys zenohd --robot red --robot blue

    Parameters
    ----------
    robot
        The namespaces of its robots.
    keys
        The folder of its identity on its host.
    listen
        The Zenoh endpoint to listen on.
    dir
        The fleet's folder, where some of its identities were revoked.
    """
    with _importing():
        from gigabrain_zenoh.bus.zenoh.config import configuration

    generations = generations_in(_fleet(dir)) if dir else {}
    print(configuration(robot or ("",), str(keys), listen, generations), end="")


def _use(role: Role, robot: str, folder: Path) -> str:
    """The command with which an identity is used first."""
    keys, of = _quoted(folder), f" --namespace {robot}" if robot else ""
    if role == "router":
        return f"gigabrain router --listen tls/0.0.0.0:7447 --fleet NAMESPACE --keys {keys}"
    if role in ("operator", "viewer"):
        tool = "estop" if role == "operator" else "topic list"
        return f"gigabrain {tool} --connect tls/ADDRESS:7447{of} --keys {keys}"
    return f"gigabrain up FILE --host HOST --keys {keys}, where FILE has a line `keys:`"


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def _listed(folder: Path) -> Iterator[tuple[str, bool]]:
    """A line for each identity in a fleet's folder, or for the only one, and whether it is good."""
    with _importing():
        from gigabrain_zenoh.security import identity as identities

    places = [folder] if (folder / CERTIFICATE).exists() else sorted(folder.iterdir())
    now, generations = datetime.datetime.now(datetime.UTC), generations_in(folder)
    for place in places:
        if not (place / CERTIFICATE).exists():
            continue
        try:
            identity = identities.load(place, now)
        except GigabrainError as error:
            yield f"{place.name:<20} {error}", False
            continue
        good = generations.get(common_name(identity.role, identity.robot), 1)
        if identity.generation < good:
            yield f"{place.name:<20} {identity.name} was revoked; delete it", False
            continue
        left = identity.days_left(now)
        soon = "  SOON" if left < SOON_DAYS else ""
        of = f"{identity.name} of {identity.fleet}"
        where = f"  ({', '.join(identity.hosts)})" if identity.hosts else ""
        until = f"expires {identity.expires:%Y-%m-%d}, in {left:.0f} days{soon}"
        yield f"{place.name:<20} {of:<28} {until}{where}", True


def _fleet(dir: Path | None) -> Path:
    """The folder of the fleet. Raises ConfigError where there is none, or more than one."""
    if dir:
        if not (dir / CA_KEY).exists():
            raise ConfigError(f"{dir}: no {CA_KEY} of a fleet; make one with `gigabrain keys new`")
        return dir
    here = Path()
    fleets = [place for place in (here, *sorted(here.iterdir())) if (place / CA_KEY).exists()]
    if not fleets:
        raise ConfigError("no fleet here; make one with `gigabrain keys new`, or name its --dir")
    if len(fleets) > 1:
        names = ", ".join(map(str, fleets))
        raise ConfigError(f"several fleets here; choose one with --dir: {names}")
    return fleets[0]


@contextlib.contextmanager
def _importing() -> Iterator[None]:
    """Import what works with certificates. Raises ConfigError where its library is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}; {INSTALL}") from None
