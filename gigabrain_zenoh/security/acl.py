"""The roles, and the router's access rules that follow from the table of topics.

The router that a message enters checks its right. Every identity may subscribe to all of its own
robot; without an identity there is no session.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, get_args

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import (
    DESCRIBE,
    ESTOP_SAID,
    HEALTH,
    LOG,
    PARAM,
    SERVICES,
    TOPICS,
    Role,
    Service,
    Topic,
)
from gigabrain_zenoh.errors import ConfigError, unknown

ROLES: tuple[Role, ...] = get_args(Role)
SERVERS: tuple[Role, ...] = ("robot", "router")  # only they may be a router
MAX_NAME_LENGTH = 64  # characters of a common name (RFC 5280, ub-common-name)
NAMESPACE = re.compile(r"[\w.-]+(/[\w.-]+)*", re.ASCII)


PROCESS_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}", re.ASCII)


def common_name(role: Role, robot: str = "", generation: int = 1, process: str = "") -> str:
    """Return the common name of a certificate, from which a router derives all rights.

    A process of one's own has an identity of its own, such as process.lamp@red. Raises ConfigError
    for an invalid name of a robot or a process.
    """
    if (role == "process") != bool(process):
        raise ConfigError("an identity of role process, and no other, takes --process NAME")
    if process and not PROCESS_NAME.fullmatch(process):
        raise ConfigError(
            f"process {process!r}: expected a lower-case letter, then lower-case letters, digits "
            "and '_', at most 32 characters"
        )
    who = f"{role}.{process}" if process else role
    if not robot:
        return of_generation(who, generation)
    name = of_generation(f"{who}@{robot}", generation)
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


class CommonName(NamedTuple):
    """The parts of a common name."""

    role: Role
    robot: str
    generation: int
    process: str  # of the role process; else empty


def parse(name: str) -> CommonName:
    """Return the parts of a common name. Raises UnknownName."""
    name, _, generation = name.partition("~")
    who, _, robot = name.partition("@")
    role, _, process = who.partition(".")
    number = int(generation) if generation.isdecimal() else 1
    return CommonName(role_named(role), robot, number, process)


def role_named(role: str) -> Role:
    """Return the role of that name. Raises UnknownName."""
    for one in ROLES:
        if one == role:
            return one
    raise unknown("role", role, ROLES)


EVERYTHING = "robot/**"  # all keys of one robot
# beside these, what Open-RMF's free_fleet adapter uses of it: an identity of the role dispatcher
FLEET_ACTION = "navigate_to_pose/_action/*"
FLEET_KEYS = ("tf", "battery_state", FLEET_ACTION)
TO_LISTENERS = ("put", "query", "reply", "declare_queryable")
FIRST: Mapping[str, int] = {}  # no identity is revoked
LOCAL = "local"  # clients of the router's Unix socket, which only this user can open


FLEET_WIDE: tuple[Role, ...] = ("operator", "viewer", "dispatcher")  # where no robot is named
OF_ONE_ROBOT: tuple[Role, ...] = ("robot", "brain", "operator", "viewer", "dispatcher")
PUBLISHED: tuple[Topic[Any], ...] = (*TOPICS, ESTOP_SAID)
Rule = dict[str, Any]


Grants = Mapping[str, Sequence[str]]  # keys that a process of one's own writes, by its name
NO_GRANTS: Grants = {}
OWN_KEY_BYTES = 1024 * 1024


def check_write(key: str) -> None:
    """Raise ValueError for a key that no process of one's own can be granted."""
    if key in FLEET_KEYS:
        return
    first, *rest = key.removeprefix("robot/").split("/")
    if not key.startswith("robot/") or not all(OWN_PART.fullmatch(part) for part in rest):
        raise ValueError(
            f"expected a key below robot/, such as robot/lamp or robot/lamp/**, got {key!r}"
        )
    if not PROCESS_NAME.fullmatch(first):
        raise ValueError(f"expected a name after robot/, got {key!r}")
    one = _of_table(key)
    fits = one is None or (len(rest) == 1 and rest[0] != "**" if one.many else not rest)
    if not fits:
        below = f"{one.key}/NAME" if one and one.many else f"robot/{first}"
        raise ValueError(f"expected {below}, got {key!r}")


OWN_PART = re.compile(r"[\w-]+|\*|\*\*", re.ASCII)


def _of_table(key: str) -> Topic[Any] | Service[Any, Any] | None:
    """Return the topic or service that a key belongs to; None for another key."""
    table: tuple[Topic[Any] | Service[Any, Any], ...] = (*PUBLISHED, *SERVICES)
    return next((one for one in table if _covers(one, key)), None)


def _covers(one: Topic[Any] | Service[Any, Any], key: str) -> bool:
    return key == one.key or key.startswith(f"{one.key}/")


def own_topics(grants: Grants) -> tuple[Topic[Any], ...]:
    """Return the keys outside the table that processes write, with the limits of ordinary data."""
    keys = {key for keys in grants.values() for key in keys if _of_table(key) is None}
    return tuple(
        Topic(key.removesuffix("/**"), Message, 10, max_bytes=OWN_KEY_BYTES) for key in sorted(keys)
    )


@dataclass(frozen=True)
class Table:
    """The topics and services whose rights a router grants, and the names of processes by role."""

    names: Mapping[str, Sequence[str]]  # where a key ends in the name of a process
    topics: Sequence[Topic[Any]] = PUBLISHED
    services: Sequence[Service[Any, Any]] = SERVICES
    grants: Grants = field(default_factory=dict)

    @property
    def holders(self) -> tuple[tuple[Role, str], ...]:
        """Return each role that has rights at one robot, with the process where it is of one."""
        own: tuple[tuple[Role, str], ...] = tuple(("process", name) for name in self.grants)
        return (*((role, "") for role in OF_ONE_ROBOT), *own)

    def keys_of_process(self, name: str) -> tuple[list[str], list[str], list[str]]:
        """Return the keys on which a process of one's own may publish, query, and answer.

        It reports on itself, and beyond that does only what it declares to write.
        """
        puts, queries = [HEALTH.at(name), LOG.key], [DESCRIBE.at("*"), *self._kept()]
        served = [PARAM.at(name), DESCRIBE.at(name)]
        for key in self.grants[name]:
            topics = [one for one in self.topics if _covers(one, key)]
            services = [one for one in self.services if _covers(one, key)]
            other = not topics and not services
            puts += [key] if topics or other else []
            queries += [key] if services or other else []
            served += [key] if other or any(one.keep for one in topics) else []
        return puts, queries, served

    def _kept(self) -> list[str]:
        """Return the keys that late joiners ask for."""
        return [topic.key for topic in self.topics if topic.keep]

    def keys(self, role: Role) -> tuple[list[str], list[str], list[str]]:
        """Return the keys on which a role may publish, query, and answer.

        The robot itself may do everything below its own name.
        """
        if role == "robot":
            every = [EVERYTHING, *FLEET_KEYS]
            return every, every, every
        if role == "dispatcher":
            return [], [FLEET_ACTION], []
        kept = self._kept()
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
        common_name(role, robot, process=process): list(_rules(role, robot, table, process))
        for robot in robots
        for role, process in table.holders
    }
    rules = [FLEET_LISTENS, *(rule for each in of.values() for rule in each)]
    subjects, policies = [], []
    for name, own_names in _known(robots, table.grants):
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


def known_names(
    robots: Sequence[str], generations: Mapping[str, int] = FIRST, grants: Grants = NO_GRANTS
) -> tuple[str, ...]:
    """Return the common names that have rights at a router of these robots."""
    return tuple(_good(name, generations) for name, _ in _known(robots, grants))


def _good(name: str, generations: Mapping[str, int]) -> str:
    return of_generation(name, generations.get(name, 1))


def _known(robots: Sequence[str], grants: Grants) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each common name with those of one robot whose rights it combines."""
    for role in OF_ONE_ROBOT:
        if role in FLEET_WIDE:
            yield role, tuple(common_name(role, robot) for robot in robots)
        for robot in robots:
            if robot or role not in FLEET_WIDE:
                yield common_name(role, robot), (common_name(role, robot),)
    for process in grants:
        for robot in robots:
            name = common_name("process", robot, process=process)
            yield name, (name,)


def _rules(role: Role, robot: str, table: Table, process: str) -> Iterator[Rule]:
    """Yield one role's rules for one robot."""
    who = common_name(role, robot, process=process)
    everything = under(robot, FLEET_KEYS if role == "dispatcher" else (EVERYTHING, *FLEET_KEYS))
    puts, queries, replies = table.keys_of_process(process) if process else table.keys(role)
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
