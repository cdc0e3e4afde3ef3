"""The roles, and the router's access rules that follow from the table of topics.

The router that a message enters checks its right. Every identity may subscribe to all of its own
robot; without an identity there is no session.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from gigabrain_schemas.topics import ESTOP_SAID, SERVICES, TOPICS, Role, Service, Topic
from gigabrain_zenoh.errors import ConfigError, unknown

ROLES: tuple[Role, ...] = get_args(Role)
SERVERS: tuple[Role, ...] = ("robot", "router")  # only they may be a router
MAX_NAME_LENGTH = 64  # characters of a common name (RFC 5280, ub-common-name)
NAMESPACE = re.compile(r"[\w.-]+(/[\w.-]+)*", re.ASCII)


def common_name(role: Role, robot: str = "", generation: int = 1) -> str:
    """Return the common name of a certificate, from which a router derives all rights.

    Raises ConfigError for an invalid name of a robot.
    """
    if not robot:
        return of_generation(role, generation)
    name = of_generation(f"{role}@{robot}", generation)
    if not NAMESPACE.fullmatch(robot) or len(name) > MAX_NAME_LENGTH:
        most = MAX_NAME_LENGTH - len(name) + len(robot)
        raise ConfigError(
            f"robot {robot!r}: expected its namespace, letters, digits, '_', '-' and '.', "
            f"of at most {most} characters"
        )
    return name


def of_generation(name: str, generation: int) -> str:
    """Return a common name of the first generation in another one."""
    return name if generation == 1 else f"{name}~{generation}"


def parse(name: str) -> tuple[Role, str, int]:
    """Return role, robot and generation of a common name. Raises UnknownName."""
    name, _, generation = name.partition("~")
    role, _, robot = name.partition("@")
    return role_named(role), robot, int(generation) if generation.isdecimal() else 1


def role_named(role: str) -> Role:
    """Return the role of that name. Raises UnknownName."""
    for one in ROLES:
        if one == role:
            return one
    raise unknown("role", role, ROLES)


EVERYTHING = "robot/**"  # all keys of one robot
TO_LISTENERS = ("put", "query", "reply", "declare_queryable")
FIRST: Mapping[str, int] = {}  # no identity is revoked
LOCAL = "local"  # clients of the router's Unix socket, which only this user can open


FLEET_WIDE: tuple[Role, ...] = ("operator", "viewer")  # where no robot is named
OF_ONE_ROBOT: tuple[Role, ...] = ("robot", "brain", "operator", "viewer")
PUBLISHED: tuple[Topic[Any], ...] = (*TOPICS, ESTOP_SAID)
Rule = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """The topics and services whose rights a router grants, and the names of processes by role."""

    names: Mapping[str, Sequence[str]]  # where a key ends in the name of a process
    topics: Sequence[Topic[Any]] = PUBLISHED
    services: Sequence[Service[Any, Any]] = SERVICES

    def keys(self, role: Role) -> tuple[list[str], list[str], list[str]]:
        """Return the keys on which a role may publish, query, and answer.

        The robot itself may do everything below its own name.
        """
        if role == "robot":
            return [EVERYTHING], [EVERYTHING], [EVERYTHING]
        kept = [topic.key for topic in self.topics if topic.keep]  # asked for by late joiners
        puts = [k for one in self.topics if role in one.publishers for k in self._own(one, role)]
        queries = [*kept, *(one.at("*") for one in self.services if role in one.callers)]
        served = [k for one in self.services if role in one.servers for k in self._own(one, role)]
        return puts, queries, [*(key for key in puts if key in kept), *served]

    def _own(self, one: Topic[Any] | Service[Any, Any], role: Role) -> list[str]:
        return [one.at(name) for name in self.names.get(role, ())] if one.many else [one.key]


def access_control(
    robots: Sequence[str],
    table: Table,
    own: str = "",
    generations: Mapping[str, int] = FIRST,
) -> dict[str, Any]:
    """Return Zenoh's `access_control` for a router of these robots (namespaces); deny by default.

    Of each name only one generation has rights: that in `generations`, else the first. A client of
    the Unix socket has the rights of the robot `own`: only the user who runs it can connect, and
    could read its key as well. At a router of no robot it is an operator of all.
    """
    of = {
        common_name(role, robot): list(_rules(role, robot, table))
        for robot in robots
        for role in OF_ONE_ROBOT
    }
    rules = [FLEET_LISTENS, *(rule for each in of.values() for rule in each)]
    subjects, policies = [], []
    for name, own_names in _known(robots):
        ids = [rule["id"] for own_name in own_names for rule in of[own_name]]
        if name in FLEET_WIDE:
            ids.append(FLEET_LISTENS["id"])
        subjects.append({"id": name, "cert_common_names": [_good(name, generations)]})
        policies.append({"subjects": [name], "rules": ids})
    subjects.append({"id": LOCAL, "link_protocols": ["unixsock-stream"]})
    near = [common_name("operator", robot) for robot in robots]
    if own in robots:
        near = [common_name("robot", own)]
    ids = [rule["id"] for name in near for rule in of[name]]
    policies.append({"subjects": [LOCAL], "rules": ids})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def known_names(robots: Sequence[str], generations: Mapping[str, int] = FIRST) -> tuple[str, ...]:
    """Return the common names that have rights at a router of these robots."""
    return tuple(_good(name, generations) for name, _ in _known(robots))


def _good(name: str, generations: Mapping[str, int]) -> str:
    return of_generation(name, generations.get(name, 1))


def _known(robots: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each common name with those of one robot whose rights it combines."""
    for role in OF_ONE_ROBOT:
        if role in FLEET_WIDE:
            yield role, tuple(common_name(role, robot) for robot in robots)
        for robot in robots:
            if robot or role not in FLEET_WIDE:
                yield common_name(role, robot), (common_name(role, robot),)


def _rules(role: Role, robot: str, table: Table) -> Iterator[Rule]:
    """Yield one role's rules for one robot."""
    who, everything = common_name(role, robot), under(robot, [EVERYTHING])
    puts, queries, replies = table.keys(role)
    yield _rule(f"{who} hears", "egress", TO_LISTENERS, everything)
    # subscriptions are no secret: a fleet's operator may subscribe to `**`
    yield _rule(f"{who} is heard", "egress", ["declare_subscriber"], ["**"])
    yield _rule(f"{who} listens", "ingress", ["declare_subscriber"], everything)
    for verb, messages, keys in (
        ("says", ["put"], puts),
        ("asks", ["query"], queries),
        ("answers", ["declare_queryable", "reply"], replies),
    ):
        if keys:
            yield _rule(f"{who} {verb}", "ingress", messages, under(robot, keys))


def _rule(name: str, flow: str, messages: Sequence[str], keys: Sequence[str]) -> Rule:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": sorted(keys),
    }


FLEET_LISTENS = _rule("the fleet listens", "ingress", ["declare_subscriber"], ["**"])


def under(robot: str, keys: Iterable[str]) -> list[str]:
    """Return the keys as the router has them."""
    return [f"{robot}/{key}" if robot else key for key in keys]
