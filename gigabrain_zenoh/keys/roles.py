"""The roles, and the name under which a router knows somebody: `operator`, `robot@red`."""

import re
from typing import Literal, get_args

from gigabrain_zenoh.errors import ConfigError, unknown

Role = Literal["robot", "brain", "operator", "viewer", "router"]
ROLES: tuple[Role, ...] = get_args(Role)

LONGEST = 64  # characters of a common name (RFC 5280, ub-common-name)
NAMESPACE = re.compile(r"[\w.-]+(/[\w.-]+)*", re.ASCII)


def common_name(role: Role, robot: str = "") -> str:
    """What the certificate says, and all that the router goes by.

    Raises ConfigError for a robot that cannot be one.
    """
    if not robot:
        return role
    name = f"{role}@{robot}"
    if not NAMESPACE.fullmatch(robot) or len(name) > LONGEST:
        raise ConfigError(
            f"robot {robot!r}: expected its namespace, letters, digits, '_', '-' and '.', "
            f"of at most {LONGEST - len(role) - 1} characters"
        )
    return name


def parse(name: str) -> tuple[Role, str]:
    """The role and the robot in a common name. Raises UnknownName for a role that is none."""
    role, _, robot = name.partition("@")
    return known(role), robot


def known(role: str) -> Role:
    """The role of that name. Raises UnknownName."""
    for one in ROLES:
        if one == role:
            return one
    raise unknown("role", role, ROLES)
