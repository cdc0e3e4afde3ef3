"""Whether an identity can be used, and for what a host is to run."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from gigabrain_zenoh.config.addresses import host_and_port
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import BusError, ConfigError
from gigabrain_zenoh.security.roles import Role, common_name

if TYPE_CHECKING:
    from gigabrain_zenoh.security.identity import Identity

INSTALL = "keys need more: pip install 'gigabrain-zenoh[keys]'"
NEEDS: Mapping[str, tuple[Role, ...]] = {
    "router": ("robot", "router"),
    "driver": ("robot",),
    "control": ("robot",),
    "safety": ("robot",),
    "perception": ("robot", "brain"),
    "decision": ("robot", "brain"),
}
OTHERS: tuple[Role, ...] = ("robot", "operator")  # for what a person looks at


def identity_in(folder: Path) -> "Identity":
    """The identity in a folder. Raises ConfigError where it cannot be used."""
    try:  # 150 ms, which only those pay who look at certificates
        from gigabrain_zenoh.security.identity import load
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}; {INSTALL}") from None
    return load(folder)


def check_identity(folder: Path, processes: Iterable[str], namespace: str, router: str) -> None:
    """Whether a host with this identity may run `processes` of the robot `namespace`.

    Raises ConfigError, which names the identity that it takes.
    """
    identity, processes = identity_in(folder), tuple(processes)
    for process in processes:
        roles = NEEDS.get(process, OTHERS)
        if identity.role not in roles:
            wanted = " or ".join(common_name(role, namespace) for role in roles)
            raise ConfigError(f"{folder} is the identity of {identity.name}; {process} "
                              f"needs that of {wanted}")  # fmt: skip
    if identity.robot != namespace and (identity.robot or identity.role in ("robot", "brain")):
        wanted = common_name(identity.role, namespace)
        raise ConfigError(f"{folder} is the identity of {identity.name}; expected {wanted}")
    host, _ = host_and_port(router)
    if "router" in processes and host and host not in identity.hosts:
        raise ConfigError(
            f"{folder} is for a router at {', '.join(identity.hosts)}, not at {host}; "
            f"issue one with --host {host}"
        )


def no_router(endpoint: Endpoint) -> BusError:
    """Why no router lets us in. Raises ConfigError where our own keys are at fault."""
    where, doubt = endpoint.connect[-1], "is the robot running, and without keys?"
    if endpoint.keys:
        identity = identity_in(Path(endpoint.keys))
        doubt = f"is the robot running, with keys of the fleet {identity.fleet!r}?"
    return BusError(f"no router answers at {where}; {doubt}")


def may_not_ask(keys: str) -> str:
    """What else may be the reason for silence: a router does not say what it denies."""
    return f"; or {identity_in(Path(keys)).name} may not ask for it" if keys else ""
