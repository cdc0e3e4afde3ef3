"""Roles, and the router's access rules, which follow from the table of topics.

The first router on the way of a message checks its rights. Every identity may subscribe to all keys
of its robot; without an identity there is no session.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, get_args

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import (
    DESCRIBE,
    ESTOP_TOPIC,
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
SERVERS: tuple[Role, ...] = ("robot", "router")  # only these may run a router
MAX_NAME_LENGTH = 64  # characters of a common name (RFC 5280, ub-common-name)
NAMESPACE = re.compile(r"[\w.-]+(/[\w.-]+)*", re.ASCII)


PROCESS_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}", re.ASCII)


def common_name(role: Role, robot: str = "", generation: int = 1, process: str = "") -> str:
    """Return the common name of a certificate, from which a router derives all rights.

    Each of the user's own processes has its own identity, such as process.lamp@red. Raises
    ConfigError for an invalid name of a robot or a process.
    """
    if (role == "process") != bool(process):
        raise ConfigError("an identity of role process, and no other, takes --process NAME")
    if process and not PROCESS_NAME.fullmatch(process):
        raise ConfigError(
            f"process {process!r}: expected a lower-case letter, then lower-case letters, digits "
            "and '_', at most 32 characters"
        )
    holder = f"{role}.{process}" if process else role
    if not robot:
        return of_generation(holder, generation)
    name = of_generation(f"{holder}@{robot}", generation)
    if not NAMESPACE.fullmatch(robot) or len(name) > MAX_NAME_LENGTH:
        limit = MAX_NAME_LENGTH - len(name) + len(robot)
        raise ConfigError(
            f"robot {robot!r}: expected its namespace, letters, digits, '_', '-' and '.', "
            f"of at most {limit} characters"
        )
    return name


def of_generation(name: str, generation: int) -> str:
    """Return a common name, given in the first generation, in another generation."""
    return name if generation == 1 else f"{name}~{generation}"


class CommonName(NamedTuple):
    """The parts of a common name."""

    role: Role
    robot: str
    generation: int
    process: str  # for the role `process`; else empty


def parse(name: str) -> CommonName:
    """Return the parts of a common name. Raises UnknownName."""
    name, _, generation = name.partition("~")
    holder, _, robot = name.partition("@")
    role, _, process = holder.partition(".")
    number = int(generation) if generation.isdecimal() else 1
    return CommonName(role_named(role), robot, number, process)


def role_named(role: str) -> Role:
    """Return the role of that name. Raises UnknownName."""
    for known in ROLES:
        if known == role:
            return known
    raise unknown("role", role, ROLES)


EVERYTHING = "robot/**"  # all keys of one robot
# keys outside `robot/` for Open-RMF's free_fleet adapter, which has the role dispatcher
FLEET_ACTION = "navigate_to_pose/_action/*"
FLEET_KEYS = ("tf", "battery_state", FLEET_ACTION)
TO_LISTENERS = ("put", "query", "reply", "declare_queryable")
FIRST: Mapping[str, int] = {}  # no identity is revoked
LOCAL = "local"  # subject of clients on the router's Unix socket, which only this user can open


FLEET_WIDE: tuple[Role, ...] = ("operator", "viewer", "dispatcher")  # if they name no robot
OF_ONE_ROBOT: tuple[Role, ...] = ("robot", "brain", "operator", "viewer", "dispatcher")
PUBLISHED: tuple[Topic[Any], ...] = (*TOPICS, ESTOP_TOPIC)
Rule = dict[str, Any]


Grants = Mapping[str, Sequence[str]]  # keys that the user's own processes write, by process
NO_GRANTS: Grants = {}
OWN_KEY_BYTES = 1024 * 1024


def check_write(key: str) -> None:
    """Raise ValueError for a key that the user's own processes cannot get."""
    if key in FLEET_KEYS:
        return
    first, *rest = key.removeprefix("robot/").split("/")
    if not key.startswith("robot/") or not all(OWN_PART.fullmatch(part) for part in rest):
        raise ValueError(
            f"expected a key below robot/, such as robot/lamp or robot/lamp/**, got {key!r}"
        )
    if not PROCESS_NAME.fullmatch(first):
        raise ValueError(f"expected a name after robot/, got {key!r}")
    known = _in_table(key)
    valid = known is None or (len(rest) == 1 and rest[0] != "**" if known.many else not rest)
    if not valid:
        form = f"{known.key}/NAME" if known and known.many else f"robot/{first}"
        raise ValueError(f"expected {form}, got {key!r}")


OWN_PART = re.compile(r"[\w-]+|\*|\*\*", re.ASCII)


def _in_table(key: str) -> Topic[Any] | Service[Any, Any] | None:
    """Return the topic or service of a key; None for a key outside the table."""
    table: tuple[Topic[Any] | Service[Any, Any], ...] = (*PUBLISHED, *SERVICES)
    return next((entry for entry in table if _covers(entry, key)), None)


def _covers(entry: Topic[Any] | Service[Any, Any], key: str) -> bool:
    return key == entry.key or key.startswith(f"{entry.key}/")


def own_topics(grants: Grants) -> tuple[Topic[Any], ...]:
    """Return topics for the keys outside the table that processes write, with default limits."""
    keys = {key for keys in grants.values() for key in keys if _in_table(key) is None}
    return tuple(
        Topic(key.removesuffix("/**"), Message, 10, max_bytes=OWN_KEY_BYTES) for key in sorted(keys)
    )


@dataclass(frozen=True)
class Table:
    """The topics, services, processes and grants from which a router's access rules follow."""

    names: Mapping[str, Sequence[str]]  # processes by role, for keys that end with a process
    topics: Sequence[Topic[Any]] = PUBLISHED
    services: Sequence[Service[Any, Any]] = SERVICES
    grants: Grants = field(default_factory=dict)

    @property
    def holders(self) -> tuple[tuple[Role, str], ...]:
        """Return each role with rights at one robot; with the process for the role `process`."""
        own: tuple[tuple[Role, str], ...] = tuple(("process", name) for name in self.grants)
        return (*((role, "") for role in OF_ONE_ROBOT), *own)

    def keys_of_process(self, name: str) -> tuple[list[str], list[str], list[str]]:
        """Return the keys on which one of the user's own processes may publish, query, and reply.

        These are the keys about itself, and the keys that it declares to write.
        """
        puts, queries = [HEALTH.at(name), LOG.key], [DESCRIBE.at("*"), *self._kept()]
        served = [PARAM.at(name), DESCRIBE.at(name)]
        for key in self.grants[name]:
            topics = [entry for entry in self.topics if _covers(entry, key)]
            services = [entry for entry in self.services if _covers(entry, key)]
            other = not topics and not services
            puts += [key] if topics or other else []
            queries += [key] if services or other else []
            served += [key] if other or any(entry.keep for entry in topics) else []
        return puts, queries, served

    def _kept(self) -> list[str]:
        """Return the keys whose kept values late subscribers query."""
        return [topic.key for topic in self.topics if topic.keep]

    def keys(self, role: Role) -> tuple[list[str], list[str], list[str]]:
        """Return the keys on which a role may publish, query, and reply.

        The robot itself may use all keys of its namespace.
        """
        if role == "robot":
            all_keys = [EVERYTHING, *FLEET_KEYS]
            return all_keys, all_keys, all_keys
        if role == "dispatcher":
            return [], [FLEET_ACTION], []
        kept = self._kept()
        puts = [
            k for entry in self.topics if role in entry.publishers for k in self._own(entry, role)
        ]
        queries = [*kept, *(entry.at("*") for entry in self.services if role in entry.callers)]
        served = [
            k for entry in self.services if role in entry.servers for k in self._own(entry, role)
        ]
        return puts, queries, [*(key for key in puts if key in kept), *served]

    def _own(self, entry: Topic[Any] | Service[Any, Any], role: Role) -> list[str]:
        return [entry.at(name) for name in self.names.get(role, ())] if entry.many else [entry.key]


def access_control(
    robots: Sequence[str],
    table: Table,
    own: str = "",
    generations: Mapping[str, int] = FIRST,
) -> dict[str, Any]:
    """Return Zenoh's `access_control` for a router of these robots (namespaces); deny by default.

    Only one generation of each name has rights: the one in `generations`, else the first. A client
    of the Unix socket has the rights of the robot `own`, as only its user can connect, who can read
    its key as well. At a router without a robot such a client is an operator of all robots.
    """
    rules_of = {
        common_name(role, robot, process=process): list(_rules(role, robot, table, process))
        for robot in robots
        for role, process in table.holders
    }
    rules = [FLEET_LISTENS, *(rule for each in rules_of.values() for rule in each)]
    subjects, policies = [], []
    for name, own_names in _known(robots, table.grants):
        ids = [rule["id"] for own_name in own_names for rule in rules_of[own_name]]
        if name in FLEET_WIDE:
            ids.append(FLEET_LISTENS["id"])
        subjects.append({"id": name, "cert_common_names": [_current(name, generations)]})
        policies.append({"subjects": [name], "rules": ids})
    subjects.append({"id": LOCAL, "link_protocols": ["unixsock-stream"]})
    local_rights = [common_name("operator", robot) for robot in robots]
    if own in robots:
        local_rights = [common_name("robot", own)]
    ids = [rule["id"] for name in local_rights for rule in rules_of[name]]
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
    return tuple(_current(name, generations) for name, _ in _known(robots, grants))


def _current(name: str, generations: Mapping[str, int]) -> str:
    """Return a common name in the generation that is not revoked."""
    return of_generation(name, generations.get(name, 1))


def _known(robots: Sequence[str], grants: Grants) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each common name, and the common names whose rights it has, each of one robot."""
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
    holder = common_name(role, robot, process=process)
    everything = under(robot, FLEET_KEYS if role == "dispatcher" else (EVERYTHING, *FLEET_KEYS))
    puts, queries, replies = table.keys_of_process(process) if process else table.keys(role)
    yield _rule(f"{holder} hears", "egress", TO_LISTENERS, everything)
    # all may see subscriptions: a fleet's operator may subscribe to `**`
    yield _rule(f"{holder} is heard", "egress", ["declare_subscriber"], ["**"])
    yield _rule(f"{holder} listens", "ingress", ["declare_subscriber"], everything)
    for verb, messages, keys in (
        ("says", ["put"], puts),
        ("asks", ["query"], queries),
        ("answers", ["declare_queryable", "reply"], replies),
    ):
        if keys:
            yield _rule(f"{holder} {verb}", "ingress", messages, under(robot, keys))


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
    """Return the keys with the robot's namespace."""
    return [f"{robot}/{key}" if robot else key for key in keys]
