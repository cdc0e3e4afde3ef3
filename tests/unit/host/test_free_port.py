"""A port that was found free stays so until whoever it is meant for listens there."""

import socket
import sys

import pytest
import zenoh

from gigabrain_zenoh.host.network import reserve_port

HOST = "127.0.0.1"
ASKED = 20_000  # times, of some 28,000 ports that there are to give

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux keeps it")


@pytest.mark.long
@on_linux
@pytest.mark.parametrize("reuse", [False, True])
def test_nobody_else_is_given_a_reserved_port(reuse: bool) -> None:
    port, given = reserve_port(HOST), set()
    for _ in range(ASKED):
        with socket.socket() as other:
            other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, reuse)
            other.bind((HOST, 0))
            given.add(other.getsockname()[1])
    assert len(given) > 1
    assert port not in given


def test_a_router_listens_on_a_reserved_port() -> None:
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", f'["tcp/{HOST}:{reserve_port(HOST)}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    zenoh.open(config).close()


def test_a_port_where_somebody_listens_is_not_free() -> None:
    with socket.create_server((HOST, 0)) as server, pytest.raises(OSError, match="in use"):
        reserve_port(HOST, server.getsockname()[1])


def test_ipv6() -> None:
    try:
        port = reserve_port("::1")
    except OSError:
        pytest.skip("no IPv6 here")
    with socket.create_server(("::1", port), family=socket.AF_INET6) as server:
        assert server.getsockname()[1] == port
