"""Loopback addresses, endpoints of Zenoh, and names of hosts."""

import pytest

from gigabrain_zenoh.host.network import exposed, host_and_port, is_host, is_loopback


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.0.0.2", True),
        ("::1", True),
        ("localhost", True),
        ("127.evil.lan", False),
        ("127.0.0.1.evil.lan", False),
        ("localhost.evil", False),
        ("localhost.", False),
        ("0.0.0.0", False),
        ("::", False),
        ("192.168.1.10", False),
        ("127.1", False),
        ("", False),
    ],
)
def test_only_localhost_and_loopback_addresses_are_on_loopback(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback


@pytest.mark.parametrize(
    ("endpoint", "host", "port"),
    [
        ("tcp/127.0.0.1:7447", "127.0.0.1", 7447),
        ("tls/[::1]:0", "::1", 0),
        ("ws/robot-1.example.org:80", "robot-1.example.org", 80),
        ("tcp/192.168.1.10:7447#iface=eth0", "192.168.1.10", 7447),
        ("unixsock-stream//run/x.sock", "", 0),
    ],
)
def test_an_endpoint_has_a_host_and_a_port(endpoint: str, host: str, port: int) -> None:
    assert host_and_port(endpoint) == (host, port)


@pytest.mark.parametrize(
    "endpoint",
    ["tcp/127.0.0.1:99999", "tcp/127.0.0.1", "tcp/bad host!:7447", "tcp/127.0.0.1:80:7447",
     "tcp/[::1]evil:7447", "tcp/999.1.1.1:7447", "http/127.0.0.1:80", "unixsock-stream/", ""],
)  # fmt: skip
def test_what_zenoh_would_wait_for_in_vain_is_no_endpoint(endpoint: str) -> None:
    with pytest.raises(ValueError, match="is not a Zenoh endpoint; expected one like tcp/127"):
        host_and_port(endpoint)


def test_one_endpoint_that_others_can_reach_is_enough() -> None:
    assert exposed(("tcp/127.0.0.1:1", "tcp/[::1]:2", "unixsock-stream//x")) == ""
    assert exposed(("tcp/127.0.0.1:1", "tcp/[::]:2", "tcp/0.0.0.0:3")) == "tcp/[::]:2"


@pytest.mark.parametrize(
    ("text", "good"),
    [
        ("192.168.1.10", True),
        ("fe80::1", True),
        ("robot", True),
        ("robot_1.home.arpa.", True),
        ("3com.example", True),
        ("", False),
        ("bad host!", False),
        ("-robot", False),
        ("robot..lan", False),
        ("1.2.3", False),
        ("tls/1.2.3.4:7447", False),
        ("x" * 64, False),
        ("r\N{LATIN SMALL LETTER E WITH ACUTE}", False),
    ],
)
def test_a_host_is_an_address_or_a_name_that_dns_can_have(text: str, good: bool) -> None:
    assert is_host(text) is good
