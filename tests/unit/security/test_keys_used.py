"""Keys in a deployment: TLS on all links, and the identities that a host or process may use."""

import shutil
from pathlib import Path

import pytest

from gigabrain_zenoh.bus.zenoh.config import session_config
from gigabrain_zenoh.cli.faults import proxy
from gigabrain_zenoh.cli.processes import HostOptions, router
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import (
    Deployment,
    check_keys,
    client_endpoint,
    load_deployment,
    local_endpoint,
)
from gigabrain_zenoh.launch.processes import grants, names_by_role
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.runtime.running import find_endpoint

ROOT = Path(__file__).parents[3]
APART = {"robot": ("router", "driver"), "brain": ("decision",)}


def test_with_keys_everything_is_tls_and_without_nothing_is(fleet: Path) -> None:
    keys = str(fleet / "robot@red")
    config = session_config(Endpoint(connect=("tcp/10.0.0.1:7447",), keys=keys))
    assert config["connect/endpoints"] == ["tls/10.0.0.1:7447"]
    assert config["transport/link/tls"]["enable_mtls"] is True
    with pytest.raises(ConfigError, match=r"'udp/10\.0\.0\.1:1': with keys, expected one like tls"):
        session_config(Endpoint(connect=("udp/10.0.0.1:1",), keys=keys))
    with pytest.raises(ConfigError, match=r"tls/10\.0\.0\.1:1 needs keys"):
        session_config(Endpoint(connect=("tls/10.0.0.1:1",)))


@pytest.mark.parametrize("at", ["tls/[fd00::1]:7447", "tcp/[FD00:0::1]:7447"])
def test_an_ipv6_address_that_zenoh_would_wait_for_is_refused(fleet: Path, at: str) -> None:
    refusal = r"\]:7447': with keys, Zenoh connects to no IPv6 address; give the host's name"
    with pytest.raises(ConfigError, match=refusal):
        session_config(Endpoint(connect=(at,), keys=str(fleet / "operator")))
    with pytest.raises(ConfigError, match=refusal):
        check_keys(Deployment(router=at, keys=str(fleet / "brain@red"), hosts=APART), "brain")
    named = Endpoint(connect=("tls/robot.lan:7447",), keys=str(fleet / "operator"))
    assert session_config(named)["connect/endpoints"] == ["tls/robot.lan:7447"]
    assert session_config(Endpoint(connect=("tcp/[fd00::1]:7447",)))["mode"] == "client"


def test_a_router_with_keys_may_listen_on_all_ipv6_addresses(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[Endpoint] = []

    def run_at(*_: object) -> int:
        found.append(find_endpoint(None))
        return 0

    monkeypatch.setattr(HostOptions, "run_at", run_at)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    router(listen=("tls/[::]:7447",), fleet=("red",), process=HostOptions(keys=fleet / "router"))
    assert [one.connect for one in found] == [("tls/localhost:7447",)]


def test_beside_its_router_no_process_needs_the_ipv6_address_of_it(fleet: Path) -> None:
    keys, at = str(fleet / "robot@red"), "tls/[fd00::1]:7447"
    near = local_endpoint(Deployment(router=at, keys=keys, hosts=APART), "robot")
    assert session_config(near)["connect/endpoints"][1:] == [at]


def test_a_router_with_keys_may_listen_on_one_ipv6_address(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[Endpoint] = []

    def run_at(_: object, endpoint: Endpoint, *__: object) -> int:
        found.append(endpoint)
        return 0

    monkeypatch.setattr(HostOptions, "run_at", run_at)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    router(listen=("tcp/[fd00::5]:7447",), process=HostOptions(keys=fleet / "router"))
    assert [one.listen for one in found] == [("tls/[fd00::5]:7447",)]


@pytest.mark.parametrize(
    "host",
    ["192.168.1.10", "0.0.0.0", "[::]", "127.evil.lan", "localhost.evil", "127.0.0.1.evil.lan"],
)
def test_beyond_loopback_a_router_wants_keys_or_to_be_called_insecure(host: str) -> None:
    at = f"tcp/{host}:7447"
    with pytest.raises(ValueError, match=r"^router: .* can be reached .*`gigabrain keys new`"):
        Deployment(router=at)
    assert Deployment(router=at, insecure=True).router == at
    assert Deployment(router=at, keys="keys").router == at
    with pytest.raises(ConfigError, match=r"^--listen: .*--insecure"):
        router(listen=("tcp/127.0.0.1:0", at))
    with pytest.raises(ConfigError, match=r"^--listen: .*--insecure"):
        proxy("tcp/127.0.0.1:7447", listen=at)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "[::1]", "localhost"])
def test_on_loopback_a_router_wants_neither(host: str) -> None:
    assert Deployment(router=f"tcp/{host}:7447").router == f"tcp/{host}:7447"


def test_keys_lie_beside_their_file_one_folder_for_all_hosts_or_one_each(
    fleet: Path, tmp_path: Path
) -> None:
    path = tmp_path / "site.yaml"
    path.write_text("keys: home\nnamespace: red\nhosts:\n  robot@red: [router, driver]\n")
    shutil.copytree(fleet, tmp_path / "home")
    deployment = load_deployment(path)
    assert client_endpoint(deployment, "robot@red").keys == str(tmp_path / "home" / "robot@red")
    of_one = load_deployment(path, keys=str(fleet / "brain@red"))
    assert client_endpoint(of_one, "robot@red").keys == str(fleet / "brain@red")


def test_a_host_is_refused_an_identity_that_is_not_for_it(fleet: Path) -> None:
    def refused(name: str, *processes: str, **values: str) -> str:
        deployment = Deployment(
            keys=str(fleet / name), hosts={"h": processes}, **{"namespace": "red", **values}
        )
        with pytest.raises(ConfigError) as error:
            check_keys(deployment, "h")
        return str(error.value).replace(str(fleet), "F")

    assert refused("brain@red", "perception", "control") == (
        "F/brain@red is the identity of brain@red; control needs that of robot@red"
    )
    assert refused("robot@blue", "control") == (
        "F/robot@blue is the identity of robot@blue; expected robot@red"
    )
    assert refused("robot@red", "router", router="tcp/10.0.0.5:7447") == (
        "F/robot@red is for a router at localhost, 127.0.0.1, ::1, not at 10.0.0.5; "
        "issue one with --host 10.0.0.5"
    )
    for fits in (
        Deployment(keys=str(fleet / "brain@red"), hosts={"h": ("decision",)}, namespace="red"),
        Deployment(
            keys=str(fleet / "robot@red"),
            hosts={"h": ("router",)},
            namespace="red",
            router="tcp/LocalHost:7447",  # names of hosts have no case
        ),
    ):
        check_keys(fits, "h")


def test_the_router_listens_where_it_is_told_and_on_a_socket_of_its_user(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    deployment = Deployment(keys=str(fleet / "robot@red"), namespace="red", fleet=("blue",))
    router = process_specs(deployment, "robot", tmp_path, tmp_path)[0].config
    assert '"listen":["tls/127.0.0.1:7447","unixsock-stream/' in router
    assert '"robot@blue"' in router


@pytest.mark.parametrize("listen", ["tls/0.0.0.0", "tcp/my host:7447", "tls/0.0.0.0:77447"])
def test_a_router_of_a_larger_site_is_refused_an_address_that_is_none(listen: str) -> None:
    from gigabrain_zenoh.bus.zenoh.config import configuration

    with pytest.raises(ConfigError, match=f"'tls/{listen[4:]}' is not a Zenoh endpoint; expected"):
        configuration(Endpoint(listen=(listen,), keys="/etc/gigabrain/keys", fleet=("red",)))


def test_the_committed_router_of_a_larger_site_is_what_the_command_prints() -> None:
    from gigabrain_zenoh.bus.zenoh.config import configuration

    committed = (ROOT / "deploy" / "zenohd" / "zenohd.json5").read_text()
    made = configuration(
        Endpoint(
            listen=("tls/0.0.0.0:7447",),
            keys="/etc/gigabrain/keys",
            fleet=("red", "blue"),
            names=names_by_role(),
            grants=grants(),
        )
    )
    assert committed == made
