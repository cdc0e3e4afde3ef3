"""Common mistakes with ROS 2: compares settings of this shell with those of the gateway. Pure.

Problems that the gateway itself finds in the ROS graph are in its health.
"""

import os
import socket
from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

import psutil
from msgspec import Struct

from gigabrain_schemas.requests import Description

VARIABLES = (
    "ROS_DISTRO", "ROS_DOMAIN_ID", "RMW_IMPLEMENTATION", "ROS_LOCALHOST_ONLY",
    "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DISCOVERY_SERVER",
)  # fmt: skip
RMW_ZENOH = "rmw_zenoh_cpp"


class Shell(Struct, frozen=True, kw_only=True):
    """Settings of this shell and computer that affect ROS nodes started here."""

    variables: Mapping[str, str] = {}  # the set ones of VARIABLES
    host: str = ""
    multicast: tuple[str, ...] = ()  # network interfaces with multicast, without the loopback


class Point(NamedTuple):
    """Result of one check."""

    grade: Literal["ok", "hint", "bad"]
    text: str
    cure: str = ""


def inspect_shell() -> Shell:
    """Return the state of this shell."""
    multicast = (
        name
        for name, one in psutil.net_if_stats().items()
        if {"up", "multicast"} <= set(one.flags.split(",")) and "loopback" not in one.flags
    )
    return Shell(
        variables={name: os.environ[name] for name in VARIABLES if os.environ.get(name)},
        host=socket.gethostname(),
        multicast=tuple(multicast),
    )


def check_ros2(gateway: Description, shell: Shell) -> Iterator[Point]:
    """Compare a running gateway with the settings for nodes of this shell; yield the results."""
    report = gateway.report
    transport, domain = report.get("transport"), report.get("domain")
    others = report.get("other_nodes")
    known = f"node {report.get('node')} on {transport}, domain {domain}"
    if others:
        yield Point("ok", f"{known}, other nodes: {others}")
    else:
        yield Point("hint", f"{known}, no other node is found", str(report.get("to_check", "")))
    if shell.variables:  # without them, no ROS nodes are started here
        yield from _domain(domain, shell)
        yield from _middleware(transport, shell)
        yield from _distribution(transport, report.get("distro"), shell)
    if transport == "dds":
        yield from _reach(gateway, shell)


def _domain(domain: object, shell: Shell) -> Iterator[Point]:
    here = shell.variables.get("ROS_DOMAIN_ID", "0")
    if here != str(domain):
        text = f"ROS_DOMAIN_ID is {here} in this shell, and {domain} in the gateway"
        yield Point("bad", text, f"export ROS_DOMAIN_ID={domain}, or set domain: {here}")


def _middleware(transport: object, shell: Shell) -> Iterator[Point]:
    here = shell.variables.get("RMW_IMPLEMENTATION", "DDS by default")
    if (here == RMW_ZENOH) == (transport == "rmw_zenoh"):
        return
    text = f"nodes of this shell use {here}, the gateway {transport}"
    if transport == "rmw_zenoh":
        yield Point("bad", text, f"export RMW_IMPLEMENTATION={RMW_ZENOH}, or set transport: dds")
    else:
        yield Point("bad", text, "unset RMW_IMPLEMENTATION, or set transport: rmw_zenoh")


def _distribution(transport: object, distro: object, shell: Shell) -> Iterator[Point]:
    here = shell.variables.get("ROS_DISTRO", distro)
    if (here == "humble") == (distro == "humble"):
        return
    text = f"ROS here is {here}, the gateway is set to {distro}: Humble has no type hashes"
    # over DDS this only loses the names of nodes
    yield Point("bad" if transport == "rmw_zenoh" else "hint", text, f"set distro: {here}")


def _reach(gateway: Description, shell: Shell) -> Iterator[Point]:
    """Yield settings that keep DDS from finding nodes, on one machine or between two."""
    here, variables = gateway.host == shell.host, shell.variables
    local = next((text for name, value in variables.items() if (text := _local(name, value))), "")
    if variables.get("ROS_AUTOMATIC_DISCOVERY_RANGE") == "OFF":
        yield Point("bad", f"{local}: nodes of this shell find no other", f"unset {_name(local)}")
    elif local and not here:
        text = f"{local}: nodes of this shell do not find the gateway on {gateway.host}"
        yield Point("bad", text, f"unset {_name(local)}")
    if gateway.report.get("localhost") and not here:
        text = f"the gateway finds nodes of its own machine only, {gateway.host}"
        yield Point("bad", text, "set localhost: false")
    if server := variables.get("ROS_DISCOVERY_SERVER"):
        text = f"nodes of this shell use the discovery server {server}, the gateway does not"
        yield Point("bad", text, "unset ROS_DISCOVERY_SERVER")
    if here and not shell.multicast and not gateway.report.get("localhost"):
        cure = "sudo ip link set dev INTERFACE multicast on; or set localhost: true"
        yield Point("hint", "no network interface has multicast: DDS finds no other machine", cure)


def _local(name: str, value: str) -> str:
    """Return a setting that limits nodes to their machine; empty for other settings."""
    only = {"ROS_LOCALHOST_ONLY": ("1",), "ROS_AUTOMATIC_DISCOVERY_RANGE": ("LOCALHOST", "OFF")}
    return f"{name}={value}" if value in only.get(name, ()) else ""


def _name(setting: str) -> str:
    return setting.partition("=")[0]
