"""Settings of a shell in which nodes of ROS would not find the gateway."""

from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import Description
from gigabrain_zenoh.diagnostics.ros2_check import Point, Shell, check_ros2

REPORT: dict[str, Any] = {
    "transport": "dds", "domain": 0, "node": "/gigabrain", "distro": "jazzy", "localhost": 0,
    "other_nodes": 2, "to_check": "",
}  # fmt: skip
GATEWAY = replace(example(Description), process="ros2", host="robot", report=REPORT)
SOURCED = {"ROS_DISTRO": "jazzy"}
HERE = Shell(variables=SOURCED, host="robot", multicast=("eth0",))
AWAY = replace(HERE, host="laptop")


def found(shell: Shell = HERE, **report: Any) -> list[Point]:
    gateway = replace(GATEWAY, report=REPORT | report)
    return [one for one in check_ros2(gateway, shell) if one.grade != "ok"]


def with_variables(shell: Shell, **variables: str) -> Shell:
    return replace(shell, variables=SOURCED | variables)


def test_a_shell_that_fits_the_gateway_has_only_good_results() -> None:
    (one,) = check_ros2(GATEWAY, HERE)
    assert one == Point("ok", "node /gigabrain on dds, domain 0, other nodes: 2")
    assert found(AWAY) == []


def test_where_no_other_node_is_found_the_gateway_says_what_to_check() -> None:
    (one,) = found(other_nodes=0, to_check="is the domain 0?")
    assert (one.grade, one.cure) == ("hint", "is the domain 0?")
    assert one.text.endswith("no other node is found")


@pytest.mark.parametrize(
    ("variables", "report", "words", "cure"),
    [
        ({"ROS_DOMAIN_ID": "7"}, {}, "ROS_DOMAIN_ID is 7", "export ROS_DOMAIN_ID=0"),
        ({}, {"domain": 3}, "ROS_DOMAIN_ID is 0", "set domain: 0"),
        ({"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}, {}, "the gateway dds", "transport: rmw_zenoh"),
        ({}, {"transport": "rmw_zenoh"}, "use DDS by default", "RMW_IMPLEMENTATION=rmw_zenoh_cpp"),
        ({"ROS_DISCOVERY_SERVER": "a:11811"}, {}, "a:11811", "unset ROS_DISCOVERY_SERVER"),
        (
            {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, {},
            "ROS_AUTOMATIC_DISCOVERY_RANGE=OFF", "unset ROS_AUTOMATIC_DISCOVERY_RANGE",
        ),
        (
            {"ROS_DISTRO": "humble", "RMW_IMPLEMENTATION": "rmw_zenoh_cpp"},
            {"transport": "rmw_zenoh"}, "ROS here is humble", "set distro: humble",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_shell_is_found(
    variables: dict[str, str], report: dict[str, Any], words: str, cure: str
) -> None:
    (one,) = found(with_variables(HERE, **variables), **report)
    assert one.grade == "bad"
    assert words in one.text
    assert cure in one.cure


@pytest.mark.parametrize(
    "variables", [{"ROS_LOCALHOST_ONLY": "1"}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}]
)
def test_a_shell_for_its_own_machine_finds_the_gateway_there_only(
    variables: dict[str, str],
) -> None:
    assert found(with_variables(HERE, **variables)) == []
    (one,) = found(with_variables(AWAY, **variables))
    assert (one.grade, one.cure) == ("bad", f"unset {next(iter(variables))}")
    assert "do not find the gateway on robot" in one.text


def test_a_gateway_for_its_own_machine_is_not_found_elsewhere() -> None:
    assert found(localhost=1) == []
    (one,) = found(AWAY, localhost=1)
    assert (one.grade, one.cure) == ("bad", "set localhost: false")


def test_an_interface_without_multicast_is_named_where_dds_needs_it() -> None:
    alone = replace(HERE, multicast=())
    (one,) = found(alone)
    assert one.grade == "hint"
    assert "multicast on" in one.cure
    assert found(alone, localhost=1) == []
    assert found(replace(alone, host="laptop")) == []
    over_zenoh = with_variables(alone, RMW_IMPLEMENTATION="rmw_zenoh_cpp")
    assert found(over_zenoh, transport="rmw_zenoh") == []


def test_humble_over_dds_is_a_hint() -> None:
    (one,) = found(with_variables(HERE, ROS_DISTRO="humble"))
    assert (one.grade, one.cure) == ("hint", "set distro: humble")
    assert found(with_variables(HERE, ROS_DISTRO="humble"), distro="humble") == []


def test_a_shell_without_ros_is_not_compared() -> None:
    assert found(replace(HERE, variables={}), domain=9, transport="rmw_zenoh") == []
