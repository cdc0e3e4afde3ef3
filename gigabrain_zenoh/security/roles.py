"""The roles, and the name under which a router knows somebody: `operator`, `robot@red`.

`operator~2` is the second generation of operators: those of the first were called back.
"""

import re
from typing import Literal, get_args

from gigabrain_zenoh.errors import ConfigError, unknown

Role = Literal["robot", "brain", "operator", "viewer", "router"]
ROLES: tuple[Role, ...] = get_args(Role)
SERVERS: tuple[Role, ...] = ("robot", "router")  # only they may be a router

LONGEST = 64  # characters of a common name (RFC 5280, ub-common-name)
NAMESPACE = re.compile(r"[\w.-]+(/[\w.-]+)*", re.ASCII)


def common_name(role: Role, robot: str = "", generation: int = 1) -> str:
    """What the certificate says, and all that the router goes by.

    Raises ConfigError for a robot that cannot be one.
    """
    if not robot:
        return of_generation(role, generation)
    name = of_generation(f"{role}@{robot}", generation)
    if not NAMESPACE.fullmatch(robot) or len(name) > LONGEST:
        most = LONGEST - len(name) + len(robot)
        raise ConfigError(
            f"robot {robot!r}: expected its namespace, letters, digits, '_', '-' and '.', "
            f"of at most {most} characters"
        )
    return name


def of_generation(name: str, generation: int) -> str:
    """A common name of the first generation as it is in another."""
    return name if generation == 1 else f"{name}~{generation}"


def parse(name: str) -> tuple[Role, str, int]:
    """Role, robot and generation in a common name. Raises UnknownName for a role that is none."""
    name, _, generation = name.partition("~")
    role, _, robot = name.partition("@")
    return known(role), robot, int(generation) if generation.isdecimal() else 1


def known(role: str) -> Role:
    """The role of that name. Raises UnknownName."""
    for one in ROLES:
        if one == role:
            return one
    raise unknown("role", role, ROLES)
